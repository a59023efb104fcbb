"""Uploads of gigabytes with bounded memory, and interrupted uploads."""

from __future__ import annotations

import json
import shutil
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import httpx2
import pytest

from leaderboard.settings import read_settings
from leaderboard.web.server import listening_socket
from tests.leaderboard.conftest import WriteArchive
from tests.leaderboard.raw_http import END, MULTIPART, connect, multipart_part, read_response, request_head
from tests.leaderboard.serving import RunServer, Server, distinct_archive
from tests.processes import descendants, memory_bytes, num_open_files
from tests.requirements import Repetitions

API = "/api/v1/submissions"
MAX_MEMORY_BYTES = 300_000_000
MAX_UPLOAD_BYTES = 4_000_000
UPLOADS = 10
CHUNK = bytes(1 << 20)


@dataclass
class MemoryWatch:
    """Sampler of the peak memory, in bytes, of a process and its descendants until the block ends."""

    pid: int
    peaks: dict[int, int] = field(default_factory=dict)

    def __enter__(self) -> MemoryWatch:
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._sample, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _sample(self) -> None:
        while not self._ended.wait(0.05):
            for pid in [self.pid, *descendants(self.pid)]:
                try:
                    self.peaks[pid] = max(self.peaks.get(pid, 0), memory_bytes(pid))
                except (OSError, AssertionError):
                    continue  # The process has just ended.


def split_with_gap(archive: bytes, gap: int) -> tuple[bytes, bytes]:
    """Split a valid archive into two parts that stay valid with ``gap`` unused bytes between them."""
    directory_offset = struct.unpack_from("<L", archive, len(archive) - 6)[0]
    last_record = archive.rindex(b"PK\1\2")
    (entry_offset,) = struct.unpack_from("<L", archive, last_record + 42)
    shifted = bytearray(archive)
    struct.pack_into("<L", shifted, last_record + 42, entry_offset + gap)
    struct.pack_into("<L", shifted, len(archive) - 6, directory_offset + gap)
    return archive[:entry_offset], bytes(shifted[entry_offset:])


def send_upload(connection: socket.socket, token: str, before: bytes, zeros: int, after: bytes) -> None:
    """Post a body of ``before``, ``zeros`` zero bytes and ``after`` in chunks."""
    length = len(before) + zeros + len(after)
    headers = (f"Authorization: Bearer {token}", f"Content-Type: {MULTIPART}", f"Content-Length: {length}")
    connection.sendall(request_head(API, headers) + before)
    for _ in range(zeros // len(CHUNK)):
        connection.sendall(CHUNK)
    connection.sendall(bytes(zeros % len(CHUNK)) + after)


def multipart_frame() -> tuple[bytes, bytes]:
    """Return the bytes before and after the content of the archive in a multipart body."""
    before, after = (multipart_part(b"|") + END).split(b"|")
    return before, after


def wait_for(holds: Callable[[], bool], timeout_s: float = 20) -> bool:
    """Wait until ``holds`` returns True; return whether it does within ``timeout_s``."""
    deadline = time.monotonic() + timeout_s
    while not holds() and time.monotonic() < deadline:
        time.sleep(0.05)
    return holds()


def spool_files(server: Server) -> list[Path]:
    return list((server.state / "spool").iterdir())


@pytest.fixture
def state(tmp_path: Path) -> Iterator[Path]:
    """Yield a state folder and delete it afterwards, because it holds gigabytes."""
    yield tmp_path / "state"
    shutil.rmtree(tmp_path / "state")


def test_large_upload_is_scored_with_bounded_memory(
    tiny_root: Path,
    state: Path,
    write_archive: WriteArchive,
    running_server: RunServer,
    repetitions: Repetitions,
) -> None:
    gap_bytes = repetitions(600_000_000, 2_000_000_000)
    archive = write_archive("large", configs=("lattice-orbit",)).read_bytes()
    first, second = split_with_gap(archive, gap_bytes)
    before, after = multipart_frame()
    with running_server(tiny_root, state) as server, MemoryWatch(server.process.pid) as watch:
        token = server.token("patient")
        with connect(server.url, timeout_s=300) as connection:
            send_upload(connection, token, before + first, gap_bytes, second + after)
            response = read_response(connection)
        assert response.status == 202, response.text
        submission = json.loads(response.text.split("\r\n\r\n", 1)[1])["id"]
        assert (state / "archives" / f"{submission}.zip").stat().st_size == len(archive) + gap_bytes
        assert server.wait_until_ended(submission)["status"] == "scored"
        assert memory_bytes(server.process.pid, "VmHWM") < MAX_MEMORY_BYTES, watch.peaks
        headers = {"Authorization": f"Bearer {token}"}
        assert httpx2.delete(f"{server.url}{API}/{submission}", headers=headers).status_code == 204
        assert list((state / "archives").iterdir()) == []
        assert spool_files(server) == []
    assert len(watch.peaks) >= 4  # server, checker, scorer and scoring process
    assert max(watch.peaks.values()) < MAX_MEMORY_BYTES, watch.peaks


@pytest.fixture(scope="module")
def small_server(
    tiny_root: Path, tmp_path_factory: pytest.TempPathFactory, running_server: RunServer
) -> Iterator[Server]:
    state = tmp_path_factory.mktemp("small") / "state"
    with running_server(tiny_root, state, workers=0, quota=1, max_upload=MAX_UPLOAD_BYTES) as server:
        yield server


@pytest.mark.parametrize("is_cut", [False, True], ids=["closed", "reset"])
def test_interrupted_upload_leaves_no_file_or_traceback(small_server: Server, is_cut: bool) -> None:
    token = small_server.token(f"impatient {is_cut}")
    files_before = num_open_files(small_server.process.pid)
    before, _ = multipart_frame()
    for _ in range(UPLOADS):
        with connect(small_server.url) as connection:
            headers = (f"Authorization: Bearer {token}", f"Content-Type: {MULTIPART}", "Content-Length: 3000000")
            connection.sendall(request_head(API, headers) + before + CHUNK)
            assert wait_for(lambda: len(spool_files(small_server)) == 1)
            if is_cut:
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        assert wait_for(lambda: not spool_files(small_server))
    assert (
        num_open_files(small_server.process.pid) < files_before + UPLOADS
    )  # A database connection may have been opened.
    assert not any("Traceback" in line or '"error"' in line for line in small_server.log)


@pytest.fixture(scope="module")
def hurried_server(
    tiny_root: Path, tmp_path_factory: pytest.TempPathFactory, running_server: RunServer
) -> Iterator[Server]:
    """Return a server that ends uploads after a second without a byte."""
    state = tmp_path_factory.mktemp("hurried") / "state"
    with running_server(tiny_root, state, workers=0, upload_idle_seconds=1) as server:
        yield server


@pytest.mark.parametrize("sent", [b"", CHUNK], ids=["nothing", "a part"])
def test_stalled_upload_is_ended(hurried_server: Server, sent: bytes) -> None:
    token = hurried_server.token(f"stalled after {len(sent)}")
    headers = (f"Authorization: Bearer {token}", f"Content-Type: {MULTIPART}", "Content-Length: 3000000")
    with connect(hurried_server.url) as connection:
        connection.sendall(request_head(API, headers) + (multipart_frame()[0] + sent if sent else b""))
        response = read_response(connection)
    assert response.status == 408, response.text
    assert "nothing was received for 1 seconds" in response.text
    assert spool_files(hurried_server) == []


def test_uploads_with_one_token_are_received_one_after_the_other(
    tiny_root: Path, tmp_path: Path, write_archive: WriteArchive, running_server: RunServer
) -> None:
    """Uploads with another token are not affected."""
    before, after = multipart_frame()
    archive = write_archive("slow", configs=("lattice-orbit",))
    contents = [distinct_archive(archive, number).read_bytes() for number in range(4)]
    with running_server(tiny_root, tmp_path / "state", workers=0) as server, ExitStack() as stack:
        own, other = server.token("own"), server.token("other")
        connections = []
        for token, content in zip((own, own, own, other), contents, strict=True):
            length = len(before) + len(content) + len(after)
            connection = stack.enter_context(connect(server.url))
            headers = (f"Authorization: Bearer {token}", f"Content-Type: {MULTIPART}", f"Content-Length: {length}")
            connection.sendall(request_head(API, headers) + before + content[:1000])
            connections.append(connection)
        assert wait_for(lambda: len(spool_files(server)) == 2)
        time.sleep(0.5)
        assert len(spool_files(server)) == 2
        for connection, content in zip(connections, contents, strict=True):
            connection.sendall(content[1000:] + after)
        for connection in connections:
            assert read_response(connection).status == 202
        assert spool_files(server) == []


def test_archive_of_the_full_protocols_fits_the_default_limit() -> None:
    """Float32 depth of six configs of 504 views and one of 100 views, 1280 x 720, stored without compression."""
    full = (6 * 504 + 100) * (1280 * 720 * 4 + 128)
    assert full < read_settings(None, {"data": "ROOT"}).max_upload


def test_small_responses_are_sent_at_once() -> None:
    settings = read_settings(None, {"data": "ROOT", "port": 0})
    with listening_socket(settings) as listener, socket.create_connection(listener.getsockname()):
        accepted, _ = listener.accept()
        with accepted:
            assert accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
