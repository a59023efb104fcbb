"""Rejected uploads: clients that are still sending receive the response instead of a closed connection."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import httpx2
import pytest

from tests import requirements
from tests.leaderboard.conftest import WriteArchive
from tests.leaderboard.raw_http import (
    END,
    MULTIPART,
    RawResponse,
    connect,
    multipart_part,
    read_response,
    request_head,
)
from tests.leaderboard.serving import RunServer, Server

API = "/api/v1/submissions"
MAX_UPLOAD_BYTES = 4_000_000
CHUNK = bytes(1 << 16)


@dataclass(frozen=True)
class RejectedUpload:
    """Upload that is rejected before it is complete: expected response, token, size and encoding of the body."""

    status: int
    words: str
    token: str
    size: int
    is_chunked: bool = False


@dataclass(frozen=True)
class RejectingServer:
    """Server, a token with exhausted quota and a token with remaining quota."""

    server: Server
    spent: str
    fresh: str

    def rejections(self) -> Mapping[str, RejectedUpload]:
        small, large = MAX_UPLOAD_BYTES // 2, 5 * MAX_UPLOAD_BYTES
        too_large = "the archive is larger than 4000000 bytes"
        return {
            "unknown token": RejectedUpload(401, "the token is unknown", "nobody's", small),
            "unknown token, large": RejectedUpload(401, "the token is unknown", "nobody's", large),
            "unknown token, chunked": RejectedUpload(401, "the token is unknown", "nobody's", large, True),
            "too large": RejectedUpload(413, too_large, self.fresh, large),
            "too large, chunked": RejectedUpload(413, too_large, self.fresh, large, True),
            "no quota": RejectedUpload(
                429, "the quota of 1 submissions per day (UTC) is used up", self.spent, small
            ),
            "no quota, large": RejectedUpload(429, "the quota of 1 submissions per day", self.spent, large, True),
        }


REJECTION_KINDS = tuple(RejectingServer.rejections(RejectingServer(None, "", "")))  # type: ignore[arg-type]
Client = Callable[[str, RejectedUpload, Path], RawResponse]


def upload_by_socket(url: str, rejected: RejectedUpload, _: Path) -> RawResponse:
    """Upload with a client that sends the whole body before it reads the response."""
    before, after = (multipart_part(b"|") + END).split(b"|")
    content_length = f"Content-Length: {len(before) + rejected.size + len(after)}"
    length_header = "Transfer-Encoding: chunked" if rejected.is_chunked else content_length
    lines = (f"Authorization: Bearer {rejected.token}", f"Content-Type: {MULTIPART}", length_header)
    pieces = [before, *[CHUNK] * (rejected.size // len(CHUNK)), bytes(rejected.size % len(CHUNK)), after]
    with connect(url) as connection:
        try:
            connection.sendall(request_head(API, lines))
            for piece in pieces:
                connection.sendall(b"%x\r\n%s\r\n" % (len(piece), piece) if rejected.is_chunked else piece)
            connection.sendall(b"0\r\n\r\n" if rejected.is_chunked else b"")
        except ConnectionError:
            pass
        return read_response(connection)


def upload_by_httpx(url: str, rejected: RejectedUpload, _: Path) -> RawResponse:
    before, after = (multipart_part(b"|") + END).split(b"|")
    headers = {"Authorization": f"Bearer {rejected.token}", "Content-Type": MULTIPART}

    def pieces() -> Iterator[bytes]:
        yield before
        yield from [CHUNK] * (rejected.size // len(CHUNK))
        yield bytes(rejected.size % len(CHUNK)) + after

    content = pieces() if rejected.is_chunked else b"".join(pieces())
    response = httpx2.post(url + API, content=content, headers=headers, timeout=60)
    return RawResponse(response.status_code, response.text)


def upload_by_curl(url: str, rejected: RejectedUpload, folder: Path, *more: str) -> RawResponse:
    """Upload with the curl command of the page; curl waits for 100 Continue before a large body."""
    requirements.require("uploads")
    archive, response_file = folder / "a.zip", folder / "said.json"
    with archive.open("wb") as file:
        file.truncate(rejected.size)
    command = ["curl", "-sS", "-o", str(response_file), "-w", "%{http_code}", "-F", f"archive=@{archive}", *more]
    command += ["-H", f"Authorization: Bearer {rejected.token}"]
    command += ["-H", "Transfer-Encoding: chunked"] if rejected.is_chunked else []
    process = subprocess.run([*command, url + API], capture_output=True, text=True, check=False, timeout=60)
    assert process.returncode == 0, process.stderr
    return RawResponse(int(process.stdout), response_file.read_text())


def upload_by_curl_without_expect(url: str, rejected: RejectedUpload, folder: Path) -> RawResponse:
    return upload_by_curl(url, rejected, folder, "-H", "Expect:")


CLIENTS: Mapping[str, Client] = {
    "socket": upload_by_socket,
    "httpx2": upload_by_httpx,
    "curl": upload_by_curl,
    "curl at once": upload_by_curl_without_expect,
}


@pytest.fixture(scope="module")
def rejecting_server(
    tiny_root: Path,
    write_archive: WriteArchive,
    tmp_path_factory: pytest.TempPathFactory,
    running_server: RunServer,
) -> Iterator[RejectingServer]:
    state = tmp_path_factory.mktemp("refusing") / "state"
    often = "100000/minute"
    with running_server(
        tiny_root,
        state,
        workers=0,
        quota=1,
        read_rate_limit=often,
        write_rate_limit=often,
        max_upload=MAX_UPLOAD_BYTES,
    ) as server:
        spent = server.token("spent")
        server.submit_accepted(write_archive("first", configs=("lattice-orbit",)), spent)
        yield RejectingServer(server, spent, server.token("fresh"))


@pytest.mark.parametrize("client", CLIENTS)
@pytest.mark.parametrize("why", REJECTION_KINDS)
def test_rejection_reaches_client_that_is_still_sending(
    rejecting_server: RejectingServer, tmp_path: Path, why: str, client: str
) -> None:
    rejected = rejecting_server.rejections()[why]
    response = CLIENTS[client](rejecting_server.server.url, rejected, tmp_path)
    assert response.status == rejected.status
    assert rejected.words in response.text
    assert list((rejecting_server.server.state / "spool").iterdir()) == []
    assert not any("Traceback" in line for line in rejecting_server.server.log)


def test_rejection_without_100_continue_if_expected(rejecting_server: RejectingServer) -> None:
    lines = ("Authorization: Bearer nobody's", f"Content-Type: {MULTIPART}", "Content-Length: 1000000000")
    with connect(rejecting_server.server.url, timeout_s=30) as connection:
        connection.sendall(request_head(API, (*lines, "Expect: 100-continue")))
        response = read_response(connection)
    assert response.status == 401
    assert "100 Continue" not in response.text


@pytest.mark.parametrize("why", ["unknown token", "no quota"])
def test_slow_client_is_not_cut_off_after_rejection(rejecting_server: RejectingServer, why: str) -> None:
    """Send slowly: many clients report a connection broken while sending and never read the response."""
    rejected = rejecting_server.rejections()[why]
    lines = (
        f"Authorization: Bearer {rejected.token}",
        f"Content-Type: {MULTIPART}",
        f"Content-Length: {rejected.size}",
    )
    with connect(rejecting_server.server.url) as connection:
        connection.sendall(request_head(API, lines))
        for _ in range(10):
            time.sleep(0.1)
            connection.sendall(bytes(rejected.size // 10))
        assert read_response(connection).status == rejected.status
