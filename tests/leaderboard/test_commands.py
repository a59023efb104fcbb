"""Commands of operators, and shutdown and recovery of the service."""

from __future__ import annotations

import csv
import hashlib
import io
import os
import re
import signal
import sqlite3
import subprocess
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from pathlib import Path
from threading import Event

import httpx2
import pytest

from rebar_depth_bench.data.manifest import open_folder
from tests.leaderboard.boards import add_submission, board_settings, make_board
from tests.leaderboard.conftest import WriteArchive
from tests.leaderboard.serving import API, SCORING, RunServer, Server, distinct_archive, run
from tests.processes import is_running, processes_below, wait_until


def table(process: subprocess.CompletedProcess[str]) -> list[dict[str, str]]:
    assert process.returncode == 0, process.stderr
    return list(csv.DictReader(io.StringIO(process.stdout)))


@pytest.fixture(scope="module")
def server(running_server: RunServer) -> Iterator[Server]:
    with running_server(default_visibility="owner") as started:
        yield started


@pytest.fixture(scope="module")
def scored(server: Server, write_archive: WriteArchive) -> dict[str, str]:
    """Return the ids of three scored submissions by their method, of which two are public."""
    token = server.token("alice")
    ids = {}
    for name, scale in {"best": 1.0, "middle": 1.2, "worst": 2.0}.items():
        ids[name] = server.submit_accepted(write_archive(name, scale, configs=("lattice-orbit",)), token)
        assert server.wait_until_ended(ids[name])["status"] == "scored"
    for name in ("best", "worst"):
        assert server.call("PATCH", f"{API}/{ids[name]}", token, json={"public": True}).status_code == 200
    return ids


def test_tokens_and_submissions_are_listed(server: Server, scored: dict[str, str], tiny_root: Path) -> None:
    assert run("token", "eve", "--state-dir", server.state).returncode == 0
    assert run("token", "eve", "--revoke", "--state-dir", server.state).returncode == 0
    tokens = {row["name"]: row for row in table(run("tokens", "--state-dir", server.state))}
    assert (tokens["alice"]["submissions"], tokens["alice"]["revoked"]) == ("3", "")
    assert int(tokens["alice"]["bytes"]) > 0
    assert tokens["eve"]["revoked"].startswith("20")
    rows = {row["method"]: row for row in table(run("submissions", "--state-dir", server.state))}
    assert {name: (row["id"], row["public"]) for name, row in rows.items()} == {
        "best": (scored["best"], "true"),
        "middle": (scored["middle"], "false"),
        "worst": (scored["worst"], "true"),
    }
    process = run("check", "--state-dir", server.state, "--data", tiny_root)
    assert process.returncode == 0, process.stderr
    assert "are in order" in process.stdout


def test_archive_alone_can_be_removed(server: Server, scored: dict[str, str], tiny_root: Path) -> None:
    options = ("--state-dir", server.state)
    before = server.rows(config="lattice-orbit")
    assert run("remove", "--archive-only", scored["worst"], *options).returncode == 0
    assert scored["worst"] not in {path.stem for path in (server.state / "archives").iterdir()}
    shown = server.wait_until_ended(scored["worst"])
    assert (shown["status"], shown["archive_kept"]) == ("scored", False)
    assert server.rows(config="lattice-orbit") == before
    refused = run("requeue", scored["worst"], *options)
    assert refused.returncode == 2
    assert "its archive was deleted" in refused.stderr
    assert run("check", "--data", tiny_root, *options).returncode == 0


@pytest.mark.slow
def test_check_names_everything_that_is_wrong(tmp_path: Path, tiny_root: Path) -> None:
    settings = board_settings(tmp_path / "state")
    token = make_board(settings)
    sound, damaged, truncated, missing, left, gone = (
        add_submission(settings, token, content) for content in (b"1", b"2", b"3", b"4", b"5", b"6")
    )
    archives, digest = settings.archive_dir, open_folder(tiny_root).digest
    with closing(sqlite3.connect(settings.state_dir / "leaderboard.sqlite")) as connection, connection:
        connection.execute("UPDATE board SET dataset_digest = ?", (digest,))

    def check(*options: object, root: Path = tiny_root) -> tuple[int, str]:
        before = [(path, path.stat().st_mtime_ns) for path in sorted(settings.state_dir.rglob("*"))]
        process = run("check", "--state-dir", settings.state_dir, "--data", root, *options)
        assert "Traceback" not in process.stderr
        assert [(path, path.stat().st_mtime_ns) for path in sorted(settings.state_dir.rglob("*"))] == before
        return process.returncode, process.stdout + process.stderr

    assert check("--hash-archives")[0] == 0
    assert check(root=tmp_path)[0] == 2
    (archives / f"{damaged}.zip").write_bytes(b"X")
    assert check()[0] == 0
    assert check("--hash-archives") == (
        1,
        f"error: 1 problem\n  - the archive of submission {damaged} has another SHA-256 than its row\n",
    )
    (archives / f"{truncated}.zip").write_bytes(b"")
    (archives / f"{missing}.zip").unlink()
    (archives / "orphan.zip").write_bytes(b"of nobody")
    with closing(sqlite3.connect(settings.state_dir / "leaderboard.sqlite")) as connection, connection:
        connection.execute("UPDATE submissions SET archive_deleted_at = 1 WHERE id = ?", (left,))
        connection.execute("UPDATE results SET json = 'x' WHERE submission_id = ?", (gone,))
        waits = "UPDATE submissions SET status = 'queued', queued_at = 1 WHERE id = ?"
        connection.execute(waits, (damaged,))
        connection.execute("UPDATE board SET dataset_digest = 'sha256:1'")
    status, text = check()
    assert status == 1
    for words in (
        f"the result of submission {gone} is no JSON",
        f"the archive of submission {truncated} has 0 bytes, expected 1",
        f"the archive of submission {missing} is missing",
        "no worker scores, and a submission has waited",
        f"the digest is {digest}, expected sha256:1, which was served",
        f"note: {archives / f'{left}.zip'}: its submission was deleted",
        f"note: {archives / 'orphan.zip'}: its submission is not in the database",
    ):
        assert words in text
    assert "error: 5 problems" in text
    assert (archives / f"{sound}.zip").exists()


@pytest.mark.slow
def test_commands_on_a_board_that_is_not_there_create_nothing(tmp_path: Path, tiny_root: Path) -> None:
    state = ("--state-dir", tmp_path / "typo")
    for command in ("check", "score", "tokens", "submissions"):
        data = () if command in ("tokens", "submissions") else ("--data", tiny_root)
        process = run(command, *data, *state)
        assert process.returncode == 2, command
        assert "the database does not exist, expected the database of a leaderboard" in process.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_damaged_database_is_named_and_left_alone(tmp_path: Path, tiny_root: Path) -> None:
    settings = board_settings(tmp_path / "state")
    add_submission(settings, make_board(settings), b"1")
    database = settings.state_dir / "leaderboard.sqlite"
    content = bytearray(database.read_bytes())
    for page in range(4096, len(content), 4096):
        content[page : page + 100] = b"\xff" * 100
    data = ("--data", tiny_root)
    for damaged in (bytes(content), b"no database" * 1000):
        database.write_bytes(damaged)
        for command in (("serve", *data, "--port", "0"), ("check", *data), ("token", "bob")):
            process = run(*command, "--state-dir", settings.state_dir)
            assert process.returncode in (1, 2), (command, process.stderr)
            assert "error: " in process.stderr, command
            assert "Traceback" not in process.stderr, command
        assert database.read_bytes() == damaged


def test_permissive_state_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "state").mkdir(mode=0o755)
    process = run("tokens", "--state-dir", tmp_path / "state")
    assert process.returncode == 2
    assert "has mode 0755, expected 0700" in process.stderr


def test_token_is_printed_once_and_stored_as_hash(tmp_path: Path) -> None:
    state = tmp_path / "new"
    first = run("token", "alice", "--state-dir", state)
    token = first.stdout.strip()
    assert first.returncode == 0
    assert re.fullmatch(r"rdb_[\w-]{43}\n", first.stdout), "the token alone goes to standard output"
    assert token not in first.stderr
    assert state.stat().st_mode & 0o077 == 0
    second = run("token", "alice", "--state-dir", state)
    assert (second.returncode, second.stdout) == (2, "")
    assert second.stderr.startswith("error: a token for 'alice' already exists")
    stored = b"".join(path.read_bytes() for path in state.rglob("*") if path.is_file())
    assert hashlib.sha256(token.encode()).hexdigest().encode() in stored
    for part in (token, token.removeprefix("rdb_")):
        assert part.encode() not in stored


def test_removed_submission_is_404(small_archive: Path, running_server: RunServer) -> None:
    with running_server(workers=0) as server:
        submission = server.submit_accepted(small_archive, server.token("alice"))
        removed = run("remove", submission, "--state-dir", server.state)
        assert (removed.returncode, removed.stderr) == (0, "")
        assert server.get(f"{API}/{submission}").status_code == 404
        assert not list((server.state / "archives").glob("*.zip"))
        again = run("remove", submission, "--state-dir", server.state)
        assert (again.returncode, again.stderr) == (2, f"error: there is no submission {submission!r}\n")


@contextmanager
def upload_under_way(server: Server, token: str, archive: Path) -> Iterator[tuple[Event, Future[httpx2.Response]]]:
    """Begin an upload; yield the event for which its last bytes wait, and its future response."""
    go_on = Event()

    def body() -> Iterator[bytes]:
        content = archive.read_bytes()
        yield content[:-100]
        go_on.wait(60)
        yield content[-100:]

    with ThreadPoolExecutor() as threads:
        response = threads.submit(server.call, "PUT", API, token, content=body())
        wait_until(lambda: any((server.state / "spool").glob("*.upload")), "the upload is under way")
        try:
            yield go_on, response
        finally:
            go_on.set()


def test_sigterm_finishes_requests_and_requeues_job(small_archive: Path, running_server: RunServer) -> None:
    with running_server() as server:
        state, token = server.state, server.token("alice")
        in_progress = server.submit_accepted(small_archive, token)
        wait_until(lambda: processes_below(server.process.pid, SCORING), "scoring begins")
        (scoring,) = processes_below(server.process.pid, SCORING)
        os.kill(scoring, signal.SIGSTOP)  # It cannot finish before the service stops.
        assert server.row(in_progress)["attempts"] == 1
        with upload_under_way(server, token, distinct_archive(small_archive, 1)) as (go_on, future):
            server.process.send_signal(signal.SIGTERM)
            time.sleep(1)
            assert server.process.poll() is None, "it did not wait for the upload"
            go_on.set()
            response = future.result(60)
        assert response.status_code == 202, response.text
        assert server.process.wait(30) == 0
        assert not any("Traceback" in line for line in server.log), server.log
    uploaded = response.json()["id"]
    row = server.row(in_progress)
    assert (row["status"], row["attempts"], row["scorer"], row["lease_until"]) == ("queued", 0, None, None)
    assert server.row(uploaded)["status"] == "queued"
    assert server.spool_files() == []
    assert sorted(path.name for path in state.iterdir()) == ["archives", "leaderboard.sqlite", "spool"]
    assert not Path(f"/proc/{scoring}").exists()
    with running_server(state) as server:
        for submission_id in (in_progress, uploaded):
            assert server.wait_until_ended(submission_id)["status"] == "scored"
    assert server.row(in_progress)["attempts"] == 1


def test_next_server_clears_spool_of_killed_server(small_archive: Path, running_server: RunServer) -> None:
    with running_server() as server:
        token = server.token("alice")
        server.submit_accepted(small_archive, token)
        wait_until(lambda: processes_below(server.process.pid, SCORING), "scoring begins")
        scoring = processes_below(server.process.pid, SCORING)
        with upload_under_way(server, token, distinct_archive(small_archive, 1)) as (go_on, future):
            server.process.kill()
            server.process.wait()
            wait_until(lambda: not any(map(is_running, scoring)), "its processes end", 20)
            go_on.set()
            with pytest.raises(httpx2.TransportError):
                future.result(60)
    assert server.spool_files(), "the killed server left nothing: the test shows too little"
    with running_server(server.state, workers=0) as server:
        assert server.spool_files() == []
        server.submit_accepted(distinct_archive(small_archive, 2), token)


def test_running_services_keep_each_others_spools(small_archive: Path, running_server: RunServer) -> None:
    with running_server(workers=0) as first:
        token = first.token("alice")
        upload = upload_under_way(first, token, small_archive)
        with upload as (go_on, future), running_server(first.state, workers=0) as second:
            go_on.set()
            response = future.result(60)
            assert response.status_code == 202, response.text
            assert second.get(f"{API}/{response.json()['id']}").status_code == 200
