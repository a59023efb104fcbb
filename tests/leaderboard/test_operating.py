"""Operation of a service: backups, removal, shutdown, recovery after a kill, and tokens."""

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

from tests.leaderboard.conftest import WriteArchive
from tests.leaderboard.serving import SCORING, RunServer, Server, distinct_archive, make_token, submission_row
from tests.processes import is_running, processes_below, wait_until

NUM_UPLOADS = 2


def run_command(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run ``rebar-leaderboard``."""
    command = [sys.executable, "-m", "leaderboard", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


def read(url: str, path: str) -> bytes:
    response = httpx2.get(f"{url}{path}", timeout=30)
    assert response.status_code == 200, response.text
    return bytes(response.content)


def leaderboard_bytes(server: Server, config: str) -> list[bytes]:
    return [read(server.url, f"/api/v1/leaderboard{kind}?config={config}") for kind in ("", ".csv")]


def inodes_and_mtimes(folder: Path) -> dict[str, tuple[int, int]]:
    """Return inode and modification time by file name; they change if a file is rewritten."""
    return {path.name: (path.stat().st_ino, path.stat().st_mtime_ns) for path in folder.iterdir()}


def statuses(state: Path) -> list[str]:
    with closing(sqlite3.connect(state / "leaderboard.sqlite")) as connection:
        return [status for (status,) in connection.execute("SELECT status FROM submissions")]


@dataclass
class SlowUpload:
    """Client that uploads an archive but waits for the event ``go_on`` before the last bytes."""

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
    return any((state / "spool").glob("*.upload"))


def test_backup_during_uploads_serves_same_leaderboard(
    tmp_path: Path, write_archive: WriteArchive, small_archive: Path, running_server: RunServer
) -> None:
    state, backup = tmp_path / "state", tmp_path / "backup"
    with running_server(state) as server:
        token = server.token("alice")
        scored = server.submit_accepted(write_archive("good", configs=("lattice",)), token)
        server.wait_until_ended(scored)
        expected = leaderboard_bytes(server, "lattice")
    with running_server(state, workers=0) as server, ThreadPoolExecutor() as threads:
        uploads = [threads.submit(server.submit_accepted, small_archive, token) for _ in range(NUM_UPLOADS)]
        wait_until(lambda: len(statuses(state)) > 1, "the first upload is in")
        process = run_command("backup", backup, "--state-dir", state)
        assert process.returncode == 0, process.stderr
        accepted = {scored, *(upload.result() for upload in uploads)}
    copied = {path.stem for path in (backup / "archives").iterdir()}
    assert scored in copied
    assert copied <= accepted
    assert "queued" in statuses(backup)
    with running_server(backup) as server:
        assert leaderboard_bytes(server, "lattice") == expected
        for submission_id in copied:
            assert server.wait_until_ended(submission_id)["status"] == "scored"
        assert read(server.url, f"/api/v1/submissions/{scored}/result.json")


def test_second_backup_copies_only_new_archives(
    tmp_path: Path, small_archive: Path, running_server: RunServer
) -> None:
    state, backup = tmp_path / "state", tmp_path / "backup"
    with running_server(state, workers=0) as server:
        token = server.token("alice")
        first = server.submit_accepted(small_archive, token)
        assert run_command("backup", backup, "--state-dir", state).returncode == 0
        before = inodes_and_mtimes(backup / "archives")
        assert set(before) == {f"{first}.zip"}
        second, lost = server.submit_accepted(small_archive, token), server.submit_accepted(small_archive, token)
    (state / "archives" / f"{lost}.zip").unlink()
    process = run_command("backup", backup, "--state-dir", state)  # No service is running.
    assert process.returncode == 1, process.stderr
    assert f"the archive of submission {lost} is missing" in process.stderr
    after = inodes_and_mtimes(backup / "archives")
    assert set(after) == {*before, f"{second}.zip"}
    assert {name: after[name] for name in before} == before
    copies = [folder / "archives" / f"{second}.zip" for folder in (backup, state)]
    assert copies[0].read_bytes() == copies[1].read_bytes()
    assert len(statuses(backup)) == 3
    assert sorted(path.name for path in backup.iterdir()) == [
        "archives",
        "leaderboard.sqlite",
        "leaderboard.sqlite.1",
    ]
    for removed in (second, lost):
        assert run_command("remove", removed, "--state-dir", state).returncode == 0
    assert run_command("backup", backup, "--prune", "--state-dir", state).returncode == 0
    assert inodes_and_mtimes(backup / "archives") == before
    assert statuses(backup).count("deleted") == 2
    assert [path.stat().st_mode & 0o077 for path in (state, backup)] == [0, 0]


def test_removed_submission_is_404(tmp_path: Path, small_archive: Path, running_server: RunServer) -> None:
    state = tmp_path / "state"
    with running_server(state, workers=0) as server:
        submission = server.submit_accepted(small_archive, server.token("alice"))
        removed = run_command("remove", submission, "--state-dir", state)
        assert (removed.returncode, removed.stderr) == (0, "")
        assert httpx2.get(f"{server.url}/api/v1/submissions/{submission}", timeout=60).status_code == 404
        assert not list((state / "archives").iterdir())
        second_removal = run_command("remove", submission, "--state-dir", state)
        assert (second_removal.returncode, second_removal.stderr) == (
            2,
            f"error: there is no submission {submission!r}\n",
        )


@pytest.mark.slow
def test_backup_into_foreign_folder_is_rejected(tmp_path: Path) -> None:
    state, other = tmp_path / "state", tmp_path / "other"
    assert run_command("token", "alice", "--state-dir", state).returncode == 0
    other.mkdir()
    (other / "precious.txt").write_text("mine")
    process = run_command("backup", other, "--state-dir", state)
    assert process.returncode == 2
    assert "contains other files, expected a new folder or an earlier backup" in process.stderr
    assert [path.name for path in other.iterdir()] == ["precious.txt"]


def test_sigterm_finishes_requests_and_requeues_job(
    tmp_path: Path, small_archive: Path, running_server: RunServer
) -> None:
    state, go_on = tmp_path / "state", threading.Event()
    with running_server(state) as server, ThreadPoolExecutor() as threads:
        token = server.token("alice")
        in_progress = server.submit_accepted(small_archive, token)
        wait_until(lambda: processes_below(server.process.pid, SCORING), "scoring begins")
        (scoring,) = processes_below(server.process.pid, SCORING)
        os.kill(scoring, signal.SIGSTOP)  # It cannot finish before the service stops.
        assert submission_row(state, in_progress)["attempts"] == 1
        future = threads.submit(SlowUpload(server, token, distinct_archive(small_archive, 1), go_on))
        wait_until(lambda: is_receiving(state), "the upload is under way")
        server.process.send_signal(signal.SIGTERM)
        time.sleep(1)
        assert server.process.poll() is None, "it did not wait for the upload"
        go_on.set()
        response = future.result(60)
        assert response.status_code == 202, response.text
        assert server.process.wait(30) == 0
        assert not any("Traceback" in line for line in server.log), server.log
    uploaded = response.json()["id"]
    row = submission_row(state, in_progress)
    assert (row["status"], row["attempts"], row["scorer"], row["lease_until"]) == ("queued", 0, None, None)
    assert submission_row(state, uploaded)["status"] == "queued"
    assert not list((state / "spool").iterdir())
    assert sorted(path.name for path in state.iterdir()) == ["archives", "leaderboard.sqlite", "spool"]
    assert not Path(f"/proc/{scoring}").exists()
    with running_server(state) as server:
        for submission_id in (in_progress, uploaded):
            assert server.wait_until_ended(submission_id)["status"] == "scored"
    assert submission_row(state, in_progress)["attempts"] == 1


def test_next_server_clears_spool_of_killed_server(
    tmp_path: Path, small_archive: Path, running_server: RunServer
) -> None:
    state, go_on = tmp_path / "state", threading.Event()
    token = make_token(state, "alice")
    with running_server(state) as server, ThreadPoolExecutor() as threads:
        server.submit_accepted(small_archive, token)
        wait_until(lambda: processes_below(server.process.pid, SCORING), "scoring begins")
        scoring = processes_below(server.process.pid, SCORING)
        future = threads.submit(SlowUpload(server, token, distinct_archive(small_archive, 1), go_on))
        wait_until(lambda: is_receiving(state), "the upload is under way")
        server.process.kill()
        server.process.wait()
        wait_until(lambda: not any(map(is_running, scoring)), "its processes end", 20)
        go_on.set()
        with pytest.raises(httpx2.TransportError):
            future.result(60)
    assert is_receiving(state), "the killed server left nothing: the test shows too little"
    with running_server(state, workers=0) as server:
        assert not list((state / "spool").iterdir())
        server.submit_accepted(distinct_archive(small_archive, 2), token)


def test_running_services_keep_each_others_spools(
    tmp_path: Path, small_archive: Path, running_server: RunServer
) -> None:
    state, go_on = tmp_path / "state", threading.Event()
    token = make_token(state, "alice")
    with running_server(state, workers=0) as first, ThreadPoolExecutor() as threads:
        future = threads.submit(SlowUpload(first, token, small_archive, go_on))
        wait_until(lambda: is_receiving(state), "the upload is under way")
        with running_server(state, workers=0) as second:
            go_on.set()
            response = future.result(60)
            assert response.status_code == 202, response.text
            assert read(second.url, f"/api/v1/submissions/{response.json()['id']}")


def contents(folder: Path) -> bytes:
    return b"".join(path.read_bytes() for path in folder.rglob("*") if path.is_file())


@pytest.mark.slow
def test_token_is_printed_once_and_stored_as_hash(tmp_path: Path) -> None:
    first = run_command("token", "alice", "--state-dir", tmp_path)
    token = first.stdout.strip()
    assert first.returncode == 0
    assert token not in first.stderr
    second = run_command("token", "alice", "--state-dir", tmp_path)
    assert (second.returncode, second.stdout) == (2, "")
    assert second.stderr.startswith("error: a token for 'alice' already exists")
    stored = contents(tmp_path)
    assert hashlib.sha256(token.encode()).hexdigest().encode() in stored
    for part in (token, token.removeprefix("rdb_")):
        assert part.encode() not in stored
