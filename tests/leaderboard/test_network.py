"""Defences of a public server: slow, many and interrupted connections, foreign hosts, forged addresses."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from leaderboard.settings import read_settings
from leaderboard.web.middleware import client_network
from leaderboard.web.server import ConnectionCounts, listening_socket
from tests.leaderboard.serving import (
    API,
    END,
    MULTIPART,
    RunServer,
    Server,
    connect,
    distinct_archive,
    exchange,
    multipart_part,
    read_response,
    request_head,
)
from tests.processes import memory_bytes, num_open_files, wait_until

PUBLIC_URL = "https://board.example.org/depth"
PER_ADDRESS, IDLE_S = 8, 3
BEFORE, AFTER = (multipart_part(b"|") + END).split(b"|")
HEALTH = request_head("/healthz", (), method="GET")


@pytest.fixture(scope="module")
def server(running_server: RunServer) -> Iterator[Server]:
    """Run a server with low limits."""
    connections = {"max_connections": 20, "max_connections_per_address": PER_ADDRESS}
    with running_server(workers=0, head_seconds=1, upload_idle_seconds=IDLE_S, **connections) as started:
        yield started
        assert not any("Traceback" in line or '"error"' in line for line in started.log)


def connect_from(server: Server, source: str) -> socket.socket:
    address = urlsplit(server.url)
    place = (str(address.hostname), int(address.port or 0))
    return socket.create_connection(place, timeout=20, source_address=(source, 0))


def is_closed(connection: socket.socket) -> bool:
    """Wait until the server closes a connection; return False if it sends something first."""
    try:
        return connection.recv(1000) == b""
    except ConnectionResetError:
        return True


@pytest.mark.parametrize("sent", [b"", b"G", b"GET / HTTP/1.1\r\nHost: x\r\n"])
def test_connection_without_a_complete_head_is_closed(server: Server, sent: bytes) -> None:
    with closing(connect(server.url)) as connection:
        connection.sendall(sent)
        start = time.monotonic()
        assert is_closed(connection)
        assert 0.5 < time.monotonic() - start < 10


def test_bytes_that_trickle_do_not_prolong_the_head(server: Server) -> None:
    with closing(connect(server.url)) as connection:
        start = time.monotonic()
        with suppress(ConnectionError):
            while time.monotonic() - start < 10:
                connection.sendall(b"x")
                time.sleep(0.1)
        assert time.monotonic() - start < 5


def test_second_head_on_a_kept_connection_has_a_limit_too(server: Server) -> None:
    with closing(connect(server.url)) as connection:
        connection.sendall(HEALTH)
        assert read_response(connection).status == 200
        connection.sendall(b"GET / HT")
        assert is_closed(connection)


def test_connections_of_an_address_are_limited(server: Server) -> None:
    with ExitStack() as stack:
        for source in ["127.0.0.1"] * PER_ADDRESS:
            connection = stack.enter_context(closing(connect_from(server, source)))
            connection.sendall(HEALTH)
            assert read_response(connection).status == 200
        assert is_closed(stack.enter_context(closing(connect(server.url))))
        other = stack.enter_context(closing(connect_from(server, "127.0.0.2")))
        other.sendall(HEALTH)
        assert read_response(other).status == 200, "other addresses are not affected"
    assert server.get("/healthz").status_code == 200


def test_flood_of_idle_connections_leaves_the_server_running(server: Server) -> None:
    """The log stays short; once the time for the heads is over, there is room again."""
    lines = len(server.log)
    with ExitStack() as stack:
        for number in range(300):
            stack.enter_context(closing(connect_from(server, f"127.0.1.{number % 50 + 1}")))
        time.sleep(1.5)
        assert server.get("/healthz").status_code == 200
    assert len(server.log) - lines < 10


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


def begin_upload(stack: ExitStack, server: Server, token: str, length: int, sent: bytes) -> socket.socket:
    """Open a connection, and send the head and a part of a body of ``length`` bytes."""
    headers = (f"Authorization: Bearer {token}", f"Content-Type: {MULTIPART}", f"Content-Length: {length}")
    connection = stack.enter_context(connect(server.url))
    connection.sendall(request_head(API, headers) + sent)
    return connection


@pytest.mark.parametrize("is_cut", [False, True], ids=["closed", "reset"])
def test_interrupted_upload_leaves_no_file(server: Server, is_cut: bool) -> None:
    count, token = 10, server.token(f"impatient {is_cut}")
    files_before = num_open_files(server.process.pid)
    for _ in range(count):
        with ExitStack() as stack:
            connection = begin_upload(stack, server, token, 3_000_000, BEFORE + bytes(1 << 20))
            wait_until(lambda: len(server.spool_files()) == 1, "the upload is under way", 20)
            if is_cut:
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        wait_until(lambda: not server.spool_files(), "the file is deleted", 20)
    assert num_open_files(server.process.pid) < files_before + count  # The database may have a new connection.


def test_stalled_uploads_are_ended(server: Server) -> None:
    with ExitStack() as stack:
        stalled = [
            begin_upload(stack, server, server.token(f"stalled {len(sent)}"), 3_000_000, sent)
            for sent in (b"", BEFORE + bytes(1 << 16))
        ]
        for response in map(read_response, stalled):
            assert response.status == 408, response.text
            assert f"nothing was received for {IDLE_S} seconds" in response.text
    assert server.spool_files() == []


def test_uploads_with_one_token_are_received_one_after_the_other(server: Server, small_archive: Path) -> None:
    """Uploads with another token are not affected."""
    contents = [distinct_archive(small_archive, number).read_bytes() for number in range(4)]
    own, other = server.token("own"), server.token("other")
    with ExitStack() as stack:
        connections = []
        for token, content in zip((own, own, own, other), contents, strict=True):
            length = len(BEFORE) + len(content) + len(AFTER)
            connections.append(begin_upload(stack, server, token, length, BEFORE + content[:1000]))
        wait_until(lambda: len(server.spool_files()) == 2, "one upload of each token is received", 20)
        time.sleep(0.5)
        assert len(server.spool_files()) == 2
        for connection, content in zip(connections, contents, strict=True):
            connection.sendall(content[1000:] + AFTER)
        assert [read_response(connection).status for connection in connections] == [202] * 4
    assert server.spool_files() == []


def test_unknown_methods_leave_nothing_in_memory(server: Server) -> None:
    before = memory_bytes(server.process.pid), num_open_files(server.process.pid)
    for number in range(300):
        assert exchange(server.url, request_head("/healthz", (), method=f"WORD{number}")).status == 405
    after = memory_bytes(server.process.pid), num_open_files(server.process.pid)
    assert after[0] - before[0] < 4 << 20
    assert after[1] <= before[1] + 2


def test_small_responses_are_sent_at_once() -> None:
    settings = read_settings(None, {"data": "ROOT", "port": 0})
    with listening_socket(settings) as listener, socket.create_connection(listener.getsockname()):
        accepted, _ = listener.accept()
        with accepted:
            assert accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


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


def test_requests_over_rate_limit_are_429_whatever_their_headers_say(running_server: RunServer) -> None:
    limits = {"read_rate_limit": "5/hour", "write_rate_limit": "2/hour", "host": "0.0.0.0"}
    with running_server(workers=0, **limits) as server:
        forged = [{"X-Forwarded-For": f"10.0.0.{k}"} for k in range(7)]
        reads = [server.get("/api/v1/token", headers=headers).status_code for headers in forged]
        assert reads == [401] * 5 + [429] * 2
        writes = [server.call("POST", API, headers=headers).status_code for headers in forged[:4]]
        assert writes == [401] * 2 + [429] * 2
        assert server.get("/healthz").status_code == 200
        limited = server.get("/", headers={"Accept": "text/html"})
        assert (limited.status_code, limited.headers["retry-after"]) == (429, "60")
        assert "too many requests from this address" in limited.text
        assert "<h1" in limited.text
        assert any("tokens are sent without TLS" in line for line in server.log)


@pytest.fixture(scope="module")
def proxied(running_server: RunServer) -> Iterator[Server]:
    """Run a server with a public URL."""
    with running_server(workers=0, public_url=PUBLIC_URL) as started:
        yield started


def test_public_url_is_used_whatever_the_client_says(proxied: Server, small_archive: Path) -> None:
    assert not any("without TLS" in line for line in proxied.log)
    response = proxied.submit(small_archive, proxied.token("alice"))
    assert response.status_code == 202
    assert response.json()["url"] == f"{PUBLIC_URL}/submissions/{response.json()['id']}"
    headers = {"Host": "board.example.org", "Accept": "text/html"}
    page = proxied.get("/how-to-submit", headers=headers)
    assert f"--url {PUBLIC_URL}" in page.text
    assert 'href="/depth/how-to-submit"' in page.text


@pytest.mark.parametrize(
    ("host", "status"), [("evil.example", 400), ("board.example.org", 200), ("localhost", 200)]
)
def test_requests_for_other_hosts_are_refused(proxied: Server, host: str, status: int) -> None:
    assert proxied.get("/how-to-submit", headers={"Host": host}).status_code == status
