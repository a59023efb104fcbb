"""Defences of a public server: many and interrupted connections, WebSockets, foreign hosts."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest

from leaderboard.web.server import MAX_CONNECTIONS
from tests.leaderboard.serving import (
    API,
    END,
    MULTIPART,
    RunServer,
    Server,
    connect,
    distinct_archive,
    multipart_part,
    read_response,
    request_head,
)
from tests.processes import num_open_files, wait_until

PUBLIC_URL = "https://board.example.org/depth"
BEFORE, AFTER = (multipart_part(b"|") + END).split(b"|")
HEALTH = request_head("/healthz", (), method="GET")


@pytest.fixture(scope="module")
def server(running_server: RunServer) -> Iterator[Server]:
    with running_server(workers=0) as started:
        yield started
        assert not any("Traceback" in line or '"error"' in line for line in started.log)


def test_websocket_handshakes_leave_the_server_running(server: Server) -> None:
    key = (
        "Upgrade: websocket",
        "Connection: Upgrade",
        "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: " + "a" * 22,
    )
    handshake = request_head("/", (*key[:3], f"{key[3]}=="), method="GET").replace(b"Connection: close\r\n", b"")
    before = num_open_files(server.process.pid)
    for _ in range(MAX_CONNECTIONS + 100):
        with connect(server.url) as connection:
            connection.sendall(handshake)
            assert connection.recv(100).startswith(b"HTTP/1.1 200 ")
    assert server.get("/healthz").status_code == 200
    wait_until(lambda: num_open_files(server.process.pid) < before + 20, "the connections are closed", 20)


def test_more_connections_than_files_leave_the_server_running(server: Server) -> None:
    """Open connections beyond the limit are answered 503; once they are closed, there is room again."""
    with ExitStack() as stack:
        for _ in range(MAX_CONNECTIONS):
            stack.enter_context(closing(connect(server.url)))
        wait_until(lambda: num_open_files(server.process.pid) > MAX_CONNECTIONS, "the connections are open", 20)
        last = stack.enter_context(closing(connect(server.url)))
        last.sendall(HEALTH)
        assert read_response(last).status == 503
    wait_until(lambda: server.get("/healthz").status_code == 200, "there is room again", 20)


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


def test_long_host_is_refused(server: Server) -> None:
    response = server.call("PUT", API, server.token("host"), headers={"Host": "a" * 3000})
    assert (response.status_code, response.text) == (400, "the Host header is too long")


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
