"""Defences of a public server: slow and many connections, foreign hosts, early refusals, forged addresses."""

from __future__ import annotations

import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from urllib.parse import urlsplit

import httpx2
import pytest

from leaderboard.web.connections import ConnectionCounts
from leaderboard.web.middleware import client_network
from tests.leaderboard.conftest import WriteArchive
from tests.leaderboard.raw_http import read_response, request_head
from tests.leaderboard.serving import RunServer, Server

API = "/api/v1/submissions"
PUBLIC_URL = "https://board.example.org/depth"
MAX_UPLOAD = 1_000_000
PER_ADDRESS = 8


@pytest.fixture(scope="module")
def server(
    tiny_root: Path, tmp_path_factory: pytest.TempPathFactory, running_server: RunServer
) -> Iterator[Server]:
    """Run a server with low limits."""
    state = tmp_path_factory.mktemp("public") / "state"
    with running_server(
        tiny_root,
        state,
        workers=0,
        head_seconds=1,
        max_connections=20,
        max_connections_per_address=PER_ADDRESS,
        max_upload=MAX_UPLOAD,
        title="Low limits",
    ) as started:
        yield started


def connect(server: Server, source: str = "127.0.0.1") -> socket.socket:
    address = urlsplit(server.url)
    return socket.create_connection(
        (str(address.hostname), int(address.port or 0)), timeout=20, source_address=(source, 0)
    )


def is_closed(connection: socket.socket) -> bool:
    """Wait until the server closes a connection; return False if it sends something first."""
    try:
        return connection.recv(1000) == b""
    except ConnectionResetError:
        return True


@pytest.mark.parametrize("sent", [b"", b"G", b"GET / HTTP/1.1\r\nHost: x\r\n"])
def test_connection_without_a_complete_head_is_closed(server: Server, sent: bytes) -> None:
    with closing(connect(server)) as connection:
        connection.sendall(sent)
        start = time.monotonic()
        assert is_closed(connection)
        assert 0.5 < time.monotonic() - start < 10


def test_bytes_that_trickle_do_not_prolong_the_head(server: Server) -> None:
    with closing(connect(server)) as connection:
        start = time.monotonic()
        with suppress(ConnectionError):
            while time.monotonic() - start < 10:
                connection.sendall(b"x")
                time.sleep(0.1)
        assert time.monotonic() - start < 5


def test_second_head_on_a_kept_connection_has_a_limit_too(server: Server) -> None:
    with closing(connect(server)) as connection:
        connection.sendall(request_head("/healthz", (), method="GET"))
        assert read_response(connection).status == 200
        connection.sendall(b"GET / HT")
        assert is_closed(connection)


def test_connections_of_an_address_are_limited(server: Server) -> None:
    with ExitStack() as stack:
        for _ in range(PER_ADDRESS):
            connection = stack.enter_context(closing(connect(server)))
            connection.sendall(request_head("/healthz", (), method="GET"))
            assert read_response(connection).status == 200
        assert is_closed(stack.enter_context(closing(connect(server))))
        other = stack.enter_context(closing(connect(server, "127.0.0.2")))
        other.sendall(request_head("/healthz", (), method="GET"))
        assert read_response(other).status == 200, "other addresses are not affected"
    assert httpx2.get(f"{server.url}/healthz").status_code == 200


def test_flood_of_idle_connections_leaves_the_server_running(server: Server) -> None:
    """The log stays short; once the time for the heads is over, there is room again."""
    lines = len(server.log)
    with ExitStack() as stack:
        for number in range(300):
            stack.enter_context(closing(connect(server, f"127.0.1.{number % 50 + 1}")))
        time.sleep(1.5)
        assert httpx2.get(f"{server.url}/healthz", timeout=10).status_code == 200
    assert len(server.log) - lines < 10
    assert not any("Traceback" in line for line in server.log)


def test_counts_are_correct_after_every_sequence() -> None:
    counts = ConnectionCounts(max_total=3, max_per_address=2)
    assert [counts.open(address) for address in "aaab"] == [True, True, False, True]
    assert not counts.open("c"), "the total is reached"
    counts.close("a")
    assert counts.open("c")
    for address in "abc":
        counts.close(address)
    assert dict(counts.by_address) == {}
    unlimited = ConnectionCounts(max_total=100, max_per_address=0)
    assert all(unlimited.open("proxy") for _ in range(100))


@pytest.mark.parametrize("method", ["PUT", "POST"])
def test_too_large_upload_is_refused_before_its_body(server: Server, method: str) -> None:
    token = server.token(f"large {method}")
    kind = "application/zip" if method == "PUT" else "multipart/form-data; boundary=X"
    headers = (f"Authorization: Bearer {token}", f"Content-Type: {kind}", "Content-Length: 99000000000")
    with closing(connect(server)) as connection:
        connection.sendall(request_head(API, headers, method=method))
        connection.settimeout(2)
        response = ""
        while not response.endswith("}"):
            response += connection.recv(1 << 16).decode()
    assert response.startswith("HTTP/1.1 413 ")
    assert "the limit of this service" in response
    assert "connection: close" in response.lower()


def test_upload_without_a_token_is_refused_before_its_body(server: Server) -> None:
    with closing(connect(server)) as connection:
        connection.sendall(
            request_head(API, ("Content-Length: 900000", "Content-Type: application/zip"), method="PUT")
        )
        connection.sendall(bytes(1000))
        assert read_response(connection).status == 401


def test_curl_uploads_the_raw_archive(server: Server, write_archive: WriteArchive) -> None:
    archive = write_archive("by curl", configs=("lattice-orbit",))
    token = server.token("curl")
    command = ["curl", "-sS", "-H", f"Authorization: Bearer {token}", "-T", str(archive), f"{server.url}{API}"]
    first, second = (subprocess.run(command, capture_output=True, text=True, check=True) for _ in range(2))
    assert '"status":"queued"' in first.stdout
    assert first.stdout == second.stdout, "the same archive is the same submission"


@pytest.mark.parametrize(
    ("address", "network"),
    [
        ("10.1.2.3", "10.1.2.3"),
        ("2001:db8:1:2:3:4:5:6", "2001:db8:1:2::/64"),
        ("2001:db8:1:2::9", "2001:db8:1:2::/64"),
        ("fe80::1%eth0", "fe80::/64"),
    ],
)
def test_clients_are_counted_by_network(address: str, network: str) -> None:
    assert client_network({"client": (address, 1)}) == network


def test_addresses_forged_in_headers_share_one_rate_limit(
    tiny_root: Path, tmp_path: Path, running_server: RunServer
) -> None:
    with running_server(tiny_root, tmp_path / "state", workers=0, read_rate_limit="5/hour") as server:
        statuses = [
            httpx2.get(f"{server.url}/api/v1/token", headers={"X-Forwarded-For": f"10.0.0.{k}"}).status_code
            for k in range(8)
        ]
    assert statuses == [401] * 5 + [429] * 3


@pytest.fixture(scope="module")
def proxied(
    tiny_root: Path, tmp_path_factory: pytest.TempPathFactory, running_server: RunServer
) -> Iterator[Server]:
    """Run a server with a public URL."""
    state = tmp_path_factory.mktemp("proxied") / "state"
    with running_server(tiny_root, state, workers=0, public_url=PUBLIC_URL) as started:
        yield started


def test_host_of_other_machines_without_public_url_is_warned_of(
    proxied: Server, tiny_root: Path, tmp_path: Path, running_server: RunServer
) -> None:
    assert not any("without TLS" in line for line in proxied.log)
    with running_server(tiny_root, tmp_path / "state", workers=0, host="0.0.0.0") as server:
        httpx2.get(f"{server.url}/healthz")
        assert any("tokens are sent without TLS" in line for line in server.log)


def test_public_url_is_used_whatever_the_client_says(proxied: Server, write_archive: WriteArchive) -> None:
    archive = write_archive("linked", configs=("lattice-orbit",))
    response = proxied.submit(archive, proxied.token("alice"))
    assert response.status_code == 202
    assert response.json()["url"] == f"{PUBLIC_URL}/submissions/{response.json()['id']}"
    headers = {"Host": "board.example.org", "Accept": "text/html"}
    page = httpx2.get(f"{proxied.url}/how-to-submit", headers=headers)
    assert f"--url {PUBLIC_URL}" in page.text
    assert 'href="/depth/how-to-submit"' in page.text


@pytest.mark.parametrize(
    ("host", "status"), [("evil.example", 400), ("board.example.org", 200), ("localhost", 200)]
)
def test_requests_for_other_hosts_are_refused(proxied: Server, host: str, status: int) -> None:
    assert httpx2.get(f"{proxied.url}/how-to-submit", headers={"Host": host}).status_code == status


def test_health_tells_of_a_lost_dataset(tiny_root: Path, tmp_path: Path, running_server: RunServer) -> None:
    data = tmp_path / "data"
    data.mkdir()
    for path in tiny_root.iterdir():
        (data / path.name).symlink_to(path)
    with running_server(data, tmp_path / "state", workers=1) as server:
        assert httpx2.get(f"{server.url}/healthz").json()["status"] == "ok"
        (data / "manifest.json").unlink()
        response = httpx2.get(f"{server.url}/healthz")
        assert (response.status_code, response.json()["status"]) == (503, "failing")
        assert response.json()["problems"] == ["the manifest of the dataset cannot be read"]
