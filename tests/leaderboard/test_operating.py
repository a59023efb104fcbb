"""Operating a service: backups while it runs, stopping it, killing it, tokens."""

from __future__ import annotations

import hashlib
import os
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import httpx2
import pytest

from tests.leaderboard.conftest import Write
from tests.leaderboard.serving import Server, make_token, running_server
from tests.leaderboard.watching import SCORER, SCORING, processes_below, submission_row, wait_until

UPLOADS = 2


def command(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run ``rebar-leaderboard`` as an operator does."""
    line = [sys.executable, "-m", "leaderboard", *map(str, arguments)]
    return subprocess.run(line, capture_output=True, text=True, timeout=120)


def read(url: str, path: str) -> bytes:
    answer = httpx2.get(f"{url}{path}", timeout=30)
    assert answer.status_code == 200, answer.text
    return bytes(answer.content)


def boards(server: Server, config: str) -> list[bytes]:
    return [read(server.url, f"/api/v1/leaderboard{kind}?config={config}") for kind in ("", ".csv")]


def identities(folder: Path) -> dict[str, tuple[int, int]]:
    """What tells whether a file was written anew: its inode and time, by name."""
    return {path.name: (path.stat().st_ino, path.stat().st_mtime_ns) for path in folder.iterdir()}


def statuses(state: Path) -> list[str]:
    with closing(sqlite3.connect(state / "leaderboard.sqlite")) as connection:
        return [status for (status,) in connection.execute("SELECT status FROM submissions")]


@pytest.fixture(scope="module")
def small(write_archive: Write) -> Path:
    return write_archive("small", configs=("lattice-orbit",))


@dataclass
class SlowUpload:
    """A client that sends an archive and stops before its last bytes until it is told to go on."""

    server: Server
    token: str
    archive: Path
    go_on: threading.Event

    def __call__(self) -> httpx2.Response:
        return httpx2.post(
            f"{self.server.url}/api/v1/submissions",
            content=self._body(),
            headers={
                "Authorization": f"Bearer {self.token}",
                "Content-Type": "multipart/form-data; boundary=frontier",
            },
            timeout=60,
        )

    def _body(self) -> Iterator[bytes]:
        content = self.archive.read_bytes()
        yield b'--frontier\r\nContent-Disposition: form-data; name="archive"; filename="a.zip"\r\n\r\n'
        yield content[:-100]
        self.go_on.wait(60)
        yield content[-100:] + b"\r\n--frontier--\r\n"


def is_receiving(state: Path) -> bool:
    return any((state / "spool").glob("*/*.upload"))


def test_a_backup_taken_during_uploads_serves_the_same_board(
    tiny_root: Path, tmp_path: Path, write_archive: Write, small: Path
) -> None:
    state, backup = tmp_path / "state", tmp_path / "backup"
    with running_server(tiny_root, state) as server:
        token = server.token("alice")
        scored = server.accepted(write_archive("good", configs=("lattice",)), token)
        server.ended(scored)
        shown = boards(server, "lattice")
    with running_server(tiny_root, state, scorers=0) as server, ThreadPoolExecutor() as threads:
        uploads = [threads.submit(server.accepted, small, token) for _ in range(UPLOADS)]
        wait_until(lambda: len(statuses(state)) > 1, "the first upload is in")
        finished = command("backup", backup, "--state", state)
        assert finished.returncode == 0, finished.stderr
        accepted = {scored, *(upload.result() for upload in uploads)}
    copied = {path.stem for path in (backup / "archives").iterdir()}
    assert scored in copied
    assert copied <= accepted
    assert "queued" in statuses(backup)
    with running_server(tiny_root, backup) as server:
        assert boards(server, "lattice") == shown
        for submission_id in copied:
            assert server.ended(submission_id)["status"] == "scored"
        assert read(server.url, f"/api/v1/submissions/{scored}/result.json")


def test_a_second_backup_copies_only_new_archives(tiny_root: Path, tmp_path: Path, small: Path) -> None:
    state, backup = tmp_path / "state", tmp_path / "backup"
    with running_server(tiny_root, state, scorers=0) as server:
        token = server.token("alice")
        first = server.accepted(small, token)
        assert command("backup", backup, "--state", state).returncode == 0
        before = identities(backup / "archives")
        assert set(before) == {f"{first}.zip"}
        second, lost = server.accepted(small, token), server.accepted(small, token)
    (state / "archives" / f"{lost}.zip").unlink()  # as if it were deleted in mid-backup
    finished = command("backup", backup, "--state", state)  # while no service runs
    assert finished.returncode == 0, finished.stderr
    after = identities(backup / "archives")
    assert set(after) == {*before, f"{second}.zip"}
    assert {name: after[name] for name in before} == before
    assert (backup / "archives" / f"{second}.zip").read_bytes() == small.read_bytes()
    assert len(statuses(backup)) == 3
    assert sorted(path.name for path in backup.iterdir()) == ["archives", "leaderboard.sqlite"]
    assert command("remove", second, "--state", state).returncode == 0
    assert command("backup", backup, "--state", state).returncode == 0
    assert identities(backup / "archives") == before
    assert statuses(backup).count("deleted") == 1
    assert [path.stat().st_mode & 0o077 for path in (state, backup)] == [0, 0]


def test_what_is_removed_is_gone_for_all(tiny_root: Path, tmp_path: Path, small: Path) -> None:
    state = tmp_path / "state"
    with running_server(tiny_root, state, scorers=0) as server:
        submission = server.accepted(small, server.token("alice"))
        removed = command("remove", submission, "--state", state)
        assert (removed.returncode, removed.stderr) == (0, "")
        assert httpx2.get(f"{server.url}/api/v1/submissions/{submission}", timeout=60).status_code == 404
        assert not list((state / "archives").iterdir())
        again = command("remove", submission, "--state", state)
        assert (again.returncode, again.stderr) == (2, f"error: there is no submission {submission!r}\n")


def test_a_backup_is_not_put_among_other_things(tmp_path: Path) -> None:
    state, other = tmp_path / "state", tmp_path / "other"
    assert command("token", "alice", "--state", state).returncode == 0
    other.mkdir()
    (other / "precious.txt").write_text("mine")
    refused = command("backup", other, "--state", state)
    assert refused.returncode == 2
    assert "holds other things, expected a new folder or an earlier backup" in refused.stderr
    assert [path.name for path in other.iterdir()] == ["precious.txt"]


def test_sigterm_finishes_requests_and_queues_the_job_at_hand_again(
    tiny_root: Path, tmp_path: Path, small: Path
) -> None:
    state, go_on = tmp_path / "state", threading.Event()
    with running_server(tiny_root, state) as server, ThreadPoolExecutor() as threads:
        token = server.token("alice")
        at_hand = server.accepted(small, token)
        wait_until(lambda: processes_below(server.process.pid, SCORING), "scoring begins")
        (scoring,) = processes_below(server.process.pid, SCORING)
        os.kill(scoring, signal.SIGSTOP)  # it will not be done before the service stops
        assert submission_row(state, at_hand)["attempts"] == 1
        answer = threads.submit(SlowUpload(server, token, small, go_on))
        wait_until(lambda: is_receiving(state), "the upload is under way")
        server.process.send_signal(signal.SIGTERM)
        time.sleep(1)
        assert server.process.poll() is None, "it did not wait for the upload"
        go_on.set()
        accepted = answer.result(60)
        assert accepted.status_code == 202, accepted.text
        assert server.process.wait(30) == 0
        assert not any("Traceback" in line for line in server.log), server.log
    uploaded = accepted.json()["id"]
    row = submission_row(state, at_hand)
    assert (row["status"], row["attempts"], row["scorer"], row["lease_until"]) == ("queued", 0, None, None)
    assert submission_row(state, uploaded)["status"] == "queued"
    assert [path.name for path in (state / "spool").iterdir()] == ["entrance.lock"]
    assert sorted(path.name for path in state.iterdir()) == ["archives", "leaderboard.sqlite", "spool"]
    assert not Path(f"/proc/{scoring}").exists()
    with running_server(tiny_root, state) as server:
        for submission_id in (at_hand, uploaded):
            assert server.ended(submission_id)["status"] == "scored"
    assert submission_row(state, at_hand)["attempts"] == 1


def test_what_a_killed_server_leaves_is_cleared_by_the_next(tiny_root: Path, tmp_path: Path, small: Path) -> None:
    state, go_on = tmp_path / "state", threading.Event()
    token = make_token(state, "alice")
    with running_server(tiny_root, state) as server, ThreadPoolExecutor() as threads:
        wait_until(lambda: processes_below(server.process.pid, SCORER), "a scorer starts")
        scorers = processes_below(server.process.pid, SCORER)
        answer = threads.submit(SlowUpload(server, token, small, go_on))
        wait_until(lambda: is_receiving(state), "the upload is under way")
        server.process.kill()
        server.process.wait()
        wait_until(lambda: not any(Path(f"/proc/{one}").exists() for one in scorers), "its scorers end", 20)
        go_on.set()
        with pytest.raises(httpx2.TransportError):
            answer.result(60)
    left = {path for path in (state / "spool").iterdir() if path.is_dir()}
    assert is_receiving(state), "the killed server left nothing: the test shows too little"
    with running_server(tiny_root, state, scorers=0) as server:
        present = {path for path in (state / "spool").iterdir() if path.is_dir()}
        assert len(present) == 1
        assert not present & left
        assert not is_receiving(state)
        locks = {path.stem for path in (state / "spool").glob("*.lock")}
        assert locks == {"entrance", *(path.name for path in present)}
        server.accepted(small, token)


def test_two_services_do_not_clear_each_others_spools(tiny_root: Path, tmp_path: Path, small: Path) -> None:
    state, go_on = tmp_path / "state", threading.Event()
    token = make_token(state, "alice")
    with running_server(tiny_root, state, scorers=0) as first, ThreadPoolExecutor() as threads:
        answer = threads.submit(SlowUpload(first, token, small, go_on))
        wait_until(lambda: is_receiving(state), "the upload is under way")
        with running_server(tiny_root, state, scorers=0) as second:
            go_on.set()
            accepted = answer.result(60)
            assert accepted.status_code == 202, accepted.text
            assert read(second.url, f"/api/v1/submissions/{accepted.json()['id']}")


def contents(folder: Path) -> bytes:
    return b"".join(path.read_bytes() for path in folder.rglob("*") if path.is_file())


def test_a_token_is_shown_once_and_kept_as_a_hash(tmp_path: Path) -> None:
    first = command("token", "alice", "--state", tmp_path)
    token = first.stdout.strip()
    assert first.returncode == 0
    assert token not in first.stderr
    again = command("token", "alice", "--state", tmp_path)
    assert (again.returncode, again.stdout) == (2, "")
    assert again.stderr.startswith("error: there is a token for 'alice' already")
    kept = contents(tmp_path)
    assert hashlib.sha256(token.encode()).hexdigest().encode() in kept
    for part in (token, token.removeprefix("rdb_")):
        assert part.encode() not in kept
