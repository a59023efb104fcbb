"""Commands of operators: tokens, submissions, prune, check."""

from __future__ import annotations

import csv
import io
import os
import shutil
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import httpx2
import pytest

from rebar_depth_bench.data.manifest import open_folder
from tests.leaderboard.boards import add_submission, board_settings, make_board
from tests.leaderboard.conftest import WriteArchive
from tests.leaderboard.serving import RunServer, Server


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "leaderboard", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def table(process: subprocess.CompletedProcess[str]) -> list[dict[str, str]]:
    assert process.returncode == 0, process.stderr
    return list(csv.DictReader(io.StringIO(process.stdout)))


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory, running_server: RunServer) -> Iterator[Server]:
    state = tmp_path_factory.mktemp("operations") / "state"
    with running_server(state, default_visibility="owner") as started:
        yield started


@pytest.fixture(scope="module")
def scored(server: Server, write_archive: WriteArchive) -> dict[str, str]:
    """Return the ids of three scored submissions by their method, of which two are public."""
    token = server.token("alice")
    scales = {"best": 1.0, "middle": 1.2, "worst": 2.0}
    ids = {
        name: server.submit_accepted(write_archive(name, scale, configs=("lattice-orbit",)), token)
        for name, scale in scales.items()
    }
    for submission_id in ids.values():
        assert server.wait_until_ended(submission_id)["status"] == "scored"
    for name in ("best", "worst"):
        address, headers = f"{server.url}/api/v1/submissions/{ids[name]}", {"Authorization": f"Bearer {token}"}
        assert httpx2.patch(address, json={"public": True}, headers=headers).status_code == 200
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


def test_prune_deletes_old_archives_but_not_the_best(
    server: Server, scored: dict[str, str], tiny_root: Path
) -> None:
    with closing(sqlite3.connect(server.state / "leaderboard.sqlite")) as connection:
        connection.execute("UPDATE submissions SET created_at = ?", (time.time() - 10 * 86400,))
        connection.commit()
    options = ("--state-dir", server.state, "--data", tiny_root)
    assert run("prune", *options).returncode == 2
    assert run("prune", *options, "--archive-days", "20").stdout == ""
    limits = ("--archive-days", "5", "--archive-ranks", "1")
    expected = {scored["middle"], scored["worst"]}
    assert set(run("prune", *options, *limits, "--dry-run").stdout.split()) == expected
    archives = server.state / "archives"
    assert {path.stem for path in archives.iterdir()} >= expected
    assert set(run("prune", *options, *limits).stdout.split()) == expected
    assert {path.stem for path in archives.iterdir()} == {scored["best"]}
    assert run("prune", *options, *limits).stdout == ""
    shown = server.wait_until_ended(scored["worst"])
    assert (shown["status"], shown["archive_kept"]) == ("scored", False)
    assert run("check", *options).returncode == 0


@pytest.mark.slow
def test_check_names_everything_that_is_wrong(tmp_path: Path, tiny_root: Path) -> None:
    settings = board_settings(tmp_path / "state")
    token = make_board(settings)
    sound, damaged, truncated, missing, left, gone = (
        add_submission(settings, token, content) for content in (b"1", b"2", b"3", b"4", b"5", b"6")
    )
    digest = open_folder(tiny_root).digest
    archives = settings.archive_dir
    with closing(sqlite3.connect(settings.state_dir / "leaderboard.sqlite")) as connection:
        connection.execute("UPDATE submissions SET dataset_digest = ?", (digest,))
        connection.commit()

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
    for name, age_s in (("orphan", 7200), ("upload", 0)):
        (archives / f"{name}.zip").write_bytes(b"of nobody")
        os.utime(archives / f"{name}.zip", (time.time() - age_s,) * 2)
    with closing(sqlite3.connect(settings.state_dir / "leaderboard.sqlite")) as connection:
        connection.execute("UPDATE submissions SET archive_deleted_at = 1 WHERE id = ?", (left,))
        connection.execute("UPDATE results SET json = 'x' WHERE submission_id = ?", (gone,))
        other = "UPDATE submissions SET dataset_digest = 'sha256:1' WHERE id = ?"
        connection.execute(other, (sound,))
        waits = "UPDATE submissions SET status = 'queued', created_at = 1 WHERE id = ?"
        connection.execute(waits, (damaged,))
        connection.commit()
    status, text = check()
    assert status == 1
    for words in (
        f"the result of submission {gone} is no JSON",
        f"the archive of submission {truncated} has 0 bytes, expected 1",
        f"the archive of submission {missing} is missing",
        f"the archive {left}.zip exists, but its row says deleted",
        "the archive orphan.zip has no submission",
        "no worker scores, and a submission has waited",
        f"1 submission of another dataset than {digest}",
    ):
        assert words in text
    assert "error: 7 problems" in text
    assert run("prune", "--orphans", "--dry-run", "--state-dir", settings.state_dir).stdout == "orphan\n"
    assert (archives / "orphan.zip").exists()
    assert run("prune", "--orphans", "--state-dir", settings.state_dir).stdout == "orphan\n"
    assert {path.stem for path in archives.iterdir()} == {sound, damaged, truncated, left, gone, "upload"}


@pytest.mark.slow
def test_commands_on_a_board_that_is_not_there_create_nothing(tmp_path: Path, tiny_root: Path) -> None:
    state = ("--state-dir", tmp_path / "typo")
    for command in ("check", "prune", "score", "tokens", "submissions"):
        data = () if command in ("tokens", "submissions") else ("--data", tiny_root)
        process = run(command, *data, *state)
        assert process.returncode == 2, command
        assert "the database does not exist, expected the database of a leaderboard" in process.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_damaged_database_is_named_by_every_command(tmp_path: Path, tiny_root: Path) -> None:
    settings = board_settings(tmp_path / "state")
    add_submission(settings, make_board(settings), b"1")
    database = settings.state_dir / "leaderboard.sqlite"
    content = bytearray(database.read_bytes())
    for page in range(4096, len(content), 4096):
        content[page : page + 100] = b"\xff" * 100
    data = ("--data", tiny_root)
    commands = {
        "serve": (*data, "--port", "0"),
        "check": data,
        "prune": ("--orphans",),
        "tokens": (),
        "token": ("bob",),
        "backup": (tmp_path / "backup",),
    }
    for damaged, names in ((bytes(content), commands), (b"no database" * 1000, ("serve", "check"))):
        database.write_bytes(damaged)
        for command in names:
            process = run(command, *commands[command], "--state-dir", settings.state_dir)
            assert process.returncode in (1, 2), (command, process.stderr)
            assert process.returncode == 1 or command != "check"
            assert "error: " in process.stderr, command
            assert "Traceback" not in process.stderr, command
        assert database.read_bytes() == damaged


def test_older_database_keeps_newer_archives(
    tiny_root: Path, tmp_path: Path, small_archive: Path, running_server: RunServer
) -> None:
    state = tmp_path / "state"
    with running_server(state, workers=0) as server:
        token = server.token("alice")
        old = server.submit_accepted(small_archive, token)
    shutil.copy(state / "leaderboard.sqlite", tmp_path / "older.sqlite")
    with running_server(state, workers=0) as server:
        newer = server.submit_accepted(small_archive, token)
        assert server.process.poll() is None
    shutil.copy(tmp_path / "older.sqlite", state / "leaderboard.sqlite")
    archive = state / "archives" / f"{newer}.zip"
    os.utime(archive, (0, 0))
    with running_server(state, workers=0) as server:
        assert run("check", "--state-dir", state, "--data", tiny_root).stderr.count(newer) == 1
    assert {path.stem for path in (state / "archives").iterdir()} == {old, newer}


def test_permissive_state_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "state").mkdir(mode=0o755)
    process = run("tokens", "--state-dir", tmp_path / "state")
    assert process.returncode == 2
    assert "has mode 0755, expected 0700" in process.stderr
