"""Uploads of gigabytes in little memory, and uploads that break off."""

from __future__ import annotations

import json
import shutil
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import httpx2
import pytest

from tests.leaderboard.conftest import Write
from tests.leaderboard.processes import descendants, memory_bytes, open_files
from tests.leaderboard.raw_http import END, MULTIPART, answer_of, connect, head, part
from tests.leaderboard.serving import Server, running_server

API = "/api/v1/submissions"
LARGE_BYTES = 2_000_000_000
MOST_MEMORY_BYTES = 300_000_000
MOST_UPLOAD = 4_000_000
UPLOADS = 10
PIECE = bytes(1 << 20)


@dataclass
class Watch:
    """Samples the memory of a process and of all that it starts, until the block ends; peaks by process, bytes."""

    pid: int
    peaks: dict[int, int] = field(default_factory=dict)

    def __enter__(self) -> Watch:
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
                    continue  # it has just ended


def widened(archive: bytes, gap: int) -> tuple[bytes, bytes]:
    """Return a sound archive in two parts; it stays sound with ``gap`` bytes of no entry between them."""
    directory_at = struct.unpack_from("<L", archive, len(archive) - 6)[0]
    last_record = archive.rindex(b"PK\1\2")
    (entry_at,) = struct.unpack_from("<L", archive, last_record + 42)
    wide = bytearray(archive)
    struct.pack_into("<L", wide, last_record + 42, entry_at + gap)
    struct.pack_into("<L", wide, len(archive) - 6, directory_at + gap)
    return archive[:entry_at], bytes(wide[entry_at:])


def send(connection: socket.socket, token: str, before: bytes, zeros: int, after: bytes) -> None:
    """Post a body of ``before``, zeros and ``after`` piece by piece."""
    length = len(before) + zeros + len(after)
    told = (f"Authorization: Bearer {token}", f"Content-Type: {MULTIPART}", f"Content-Length: {length}")
    connection.sendall(head(API, told) + before)
    for _ in range(zeros // len(PIECE)):
        connection.sendall(PIECE)
    connection.sendall(bytes(zeros % len(PIECE)) + after)


def body_around() -> tuple[bytes, bytes]:
    """Return what stands before and after an archive's content in a body."""
    before, after = (part(b"|") + END).split(b"|")
    return before, after


def until(holds: Callable[[], bool], timeout_s: float = 20) -> bool:
    """Wait for something to hold; return whether it does."""
    limit = time.monotonic() + timeout_s
    while not holds() and time.monotonic() < limit:
        time.sleep(0.05)
    return holds()


def spooled(server: Server) -> list[Path]:
    return list((server.state / "spool").glob("*/*"))


@pytest.fixture
def state(tmp_path: Path) -> Iterator[Path]:
    """The state folder, which no test run leaves lying about: there are gigabytes in it."""
    yield tmp_path / "state"
    shutil.rmtree(tmp_path / "state")


def test_two_gigabytes_are_taken_checked_and_scored_in_little_memory(
    tiny_root: Path, state: Path, write_archive: Write
) -> None:
    archive = write_archive("large", configs=("lattice-orbit",)).read_bytes()
    first, second = widened(archive, LARGE_BYTES)
    before, after = body_around()
    with running_server(tiny_root, state) as server, Watch(server.process.pid) as watch:
        token = server.token("patient")
        with connect(server.url, timeout_s=300) as connection:
            send(connection, token, before + first, LARGE_BYTES, second + after)
            answer = answer_of(connection)
        assert answer.status == 202, answer.text
        submission = json.loads(answer.text.split("\r\n\r\n", 1)[1])["id"]
        assert (state / "archives" / f"{submission}.zip").stat().st_size == len(archive) + LARGE_BYTES
        assert server.ended(submission)["status"] == "scored"
        assert memory_bytes(server.process.pid, "VmHWM") < MOST_MEMORY_BYTES, watch.peaks
        headers = {"Authorization": f"Bearer {token}"}
        assert httpx2.delete(f"{server.url}{API}/{submission}", headers=headers).status_code == 204
        assert list((state / "archives").iterdir()) == []
        assert spooled(server) == []
    assert len(watch.peaks) >= 4  # server, checker, scorer, scoring
    assert max(watch.peaks.values()) < MOST_MEMORY_BYTES, watch.peaks


@pytest.fixture(scope="module")
def small(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    state = tmp_path_factory.mktemp("small") / "state"
    with running_server(tiny_root, state, scorers=0, quota=1, max_upload=MOST_UPLOAD) as server:
        yield server


@pytest.mark.parametrize("is_cut", [False, True], ids=["closed", "reset"])
def test_an_upload_that_breaks_off_leaves_no_file_and_no_traceback(small: Server, is_cut: bool) -> None:
    token = small.token(f"impatient {is_cut}")
    files = open_files(small.process.pid)
    before, _ = body_around()
    for _ in range(UPLOADS):
        with connect(small.url) as connection:
            told = (f"Authorization: Bearer {token}", f"Content-Type: {MULTIPART}", "Content-Length: 3000000")
            connection.sendall(head(API, told) + before + PIECE)
            assert until(lambda: len(spooled(small)) == 1)
            if is_cut:
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        assert until(lambda: not spooled(small))
    assert open_files(small.process.pid) < files + UPLOADS  # a connection to the database may have come
    assert not any("Traceback" in line or '"error"' in line for line in small.log)
