"""Backup: what it refuses, what it keeps, and how a leaderboard is restored from it."""

from __future__ import annotations

import os
import re
import shutil
import signal
import sqlite3
import stat
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from pathlib import Path

import pytest
from sqlalchemy import update

from leaderboard.db.models import ResultModel
from leaderboard.settings import Settings
from leaderboard.storage.archive_store import state_lock
from leaderboard.storage.backup import back_up
from rebar_depth_bench.base.errors import InputError, StorageError
from tests.leaderboard.boards import (
    add_submission,
    assert_sound,
    board_settings,
    facts,
    killed,
    make_board,
    opened,
)
from tests.leaderboard.conftest import WriteArchive
from tests.leaderboard.serving import Postgres, RunServer, run
from tests.leaderboard.test_storage import free_archive, remove
from tests.processes import wait_until


def tree(folder: Path) -> dict[str, bytes]:
    """Return the content of all files by their path."""
    return {
        str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()
    }


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def back_up_by_command(settings: Settings, target: Path, *options: object) -> subprocess.CompletedProcess[str]:
    """Run ``rebar-leaderboard backup``."""
    return run("backup", target, "--state-dir", settings.state_dir, "--db", settings.db, *options)


@pytest.fixture
def board(tmp_path: Path) -> tuple[Settings, str]:
    """Return the settings of a leaderboard, and a token of it."""
    settings = board_settings(tmp_path / "state")
    return settings, make_board(settings)


def damage(database: Path) -> None:
    """Overwrite a page of a database that is read, but not when it is opened."""
    with closing(sqlite3.connect(database)) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        (page,) = connection.execute("SELECT rootpage FROM sqlite_master WHERE name = 'results'").fetchone()
        (size,) = connection.execute("PRAGMA page_size").fetchone()
    with database.open("r+b") as file:
        file.seek((page - 1) * size)
        file.write(b"\xff" * size)


def test_backup_of_a_lost_board_is_refused(board: tuple[Settings, str], tmp_path: Path) -> None:
    settings, token = board
    target, new = tmp_path / "backup", tmp_path / "new"
    kept = add_submission(settings, token, b"one")
    back_up(settings, target, prune=False)
    shutil.rmtree(settings.state_dir)
    make_board(settings)
    before = tree(target)
    for prune in (False, True):
        with pytest.raises(InputError, match="is the backup of another leaderboard"):
            back_up(settings, target, prune)
        assert tree(target) == before
    assert (target / "archives" / f"{kept}.zip").exists()
    back_up(settings, new, prune=False)
    assert facts(board_settings(new)) == {}


def test_damaged_database_replaces_no_backup(board: tuple[Settings, str], tmp_path: Path) -> None:
    settings, token = board
    target = tmp_path / "backup"
    add_submission(settings, token, b"one")
    back_up(settings, target, prune=False)
    before = tree(target)
    damage(settings.state_dir / "leaderboard.sqlite")
    with pytest.raises(StorageError, match="the database is damaged"):
        back_up(settings, target, prune=False)
    assert tree(target) == before
    for content, words in (("x", "is no JSON"), ("{}", "is no result"), ('{"protocol": 2}', "is no result")):
        with closing(sqlite3.connect(target / "leaderboard.sqlite")) as connection:
            connection.execute("UPDATE results SET json = ?", (content,))
            connection.commit()
        with pytest.raises(StorageError, match=words):
            back_up(board_settings(target), tmp_path / "second", prune=False)
    assert not (tmp_path / "second" / "leaderboard.sqlite").exists()
    sound = board_settings(tmp_path / "sound")
    make_board(sound)
    back_up(sound, tmp_path / "third", prune=False)
    (tmp_path / "third" / "leaderboard.sqlite").write_bytes(b"no database" * 1000)
    with pytest.raises(InputError, match="file is not a database"):
        back_up(sound, tmp_path / "third", prune=False)


def _accept_and_die(settings: Settings, token: str) -> None:
    """Add a submission, and die before the write-ahead log is moved into the database."""
    with opened(settings):
        add_submission(settings, token, b"accepted by the backup")
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.slow
def test_upload_to_a_served_backup_is_not_replaced(board: tuple[Settings, str], tmp_path: Path) -> None:
    settings, token = board
    target = tmp_path / "backup"
    add_submission(settings, token, b"one")
    back_up(settings, target, prune=False)
    assert killed(1000, _accept_and_die, board_settings(target), token)
    assert (target / "leaderboard.sqlite-wal").stat().st_size > 0, "the test shows too little"
    with pytest.raises(InputError, match="has 1 submissions that"):
        back_up(settings, target, prune=False)
    assert len(facts(board_settings(target))) == 2
    assert_sound(board_settings(target))


def test_folder_that_is_used_is_refused(board: tuple[Settings, str], tmp_path: Path) -> None:
    settings, _ = board
    target = tmp_path / "backup"
    back_up(settings, target, prune=False)
    with state_lock(target), pytest.raises(InputError, match="a server, a worker or another command uses it"):
        back_up(settings, target, prune=False)
    with state_lock(target, alone=True), pytest.raises(InputError, match="a backup is being written"):
        state_lock(target).__enter__()
    shared = board_settings(tmp_path / "other", archives=str(tmp_path / "shared" / "archives"))
    make_board(shared)
    for folder in (shared.state_dir, tmp_path / "shared", shared.archive_dir):
        with pytest.raises(InputError, match="is in use by the service"):
            back_up(shared, folder, prune=False)
    precious = tmp_path / "foreign" / "precious.txt"
    precious.parent.mkdir()
    precious.write_text("mine")
    process = back_up_by_command(settings, precious.parent)
    assert process.returncode == 2
    assert "contains other files, expected a new folder or an earlier backup" in process.stderr
    assert names(precious.parent) == {"precious.txt"}


def test_board_is_backed_up_while_it_is_served(
    tmp_path: Path, write_archive: WriteArchive, small_archive: Path, running_server: RunServer
) -> None:
    target, paths = tmp_path / "backup", [f"/api/v1/leaderboard{kind}?config=lattice" for kind in ("", ".csv")]
    with running_server() as server:
        token = server.token("alice")
        scored = server.submit_accepted(write_archive("good", configs=("lattice",)), token)
        server.wait_until_ended(scored)
        expected = [server.get(path).content for path in paths]
    settings = board_settings(server.state)
    with running_server(server.state, workers=0) as server, ThreadPoolExecutor() as threads:
        uploads = [threads.submit(server.submit_accepted, small_archive, token) for _ in range(2)]
        wait_until(lambda: len(facts(settings)) > 1, "the first upload is in")
        process = back_up_by_command(settings, target)
        assert (process.returncode, process.stdout) == (0, f"{target}\n"), process.stderr
        accepted = {scored, *(upload.result() for upload in uploads)}
    copied = {path.stem for path in (target / "archives").glob("*.zip")}
    assert scored in copied
    assert copied <= accepted
    assert "queued" in {status for status, *_ in facts(board_settings(target)).values()}
    with running_server(target) as server:
        assert [server.get(path).content for path in paths] == expected
        for submission_id in copied:
            assert server.wait_until_ended(submission_id)["status"] == "scored"
        assert server.get(f"/api/v1/submissions/{scored}/result.json").status_code == 200
        process = back_up_by_command(settings, target)
    assert process.returncode == 2
    assert "a server, a worker or another command uses it" in process.stderr


def test_backup_has_the_modes_of_a_state_folder(board: tuple[Settings, str], tmp_path: Path) -> None:
    settings, token = board
    target = tmp_path / "backup"
    target.mkdir(mode=0o755)
    add_submission(settings, token, b"one")
    for _ in range(2):
        back_up(settings, target, prune=False)
    assert names(target) == {"archives", "leaderboard.sqlite", "leaderboard.sqlite.1"}
    for path in [target, *target.rglob("*")]:
        expected = 0o700 if path.is_dir() else 0o600
        assert stat.S_IMODE(path.stat().st_mode) == expected, path


@pytest.mark.slow
def test_damaged_archive_replaces_nothing_and_missing_one_is_named(
    board: tuple[Settings, str], tmp_path: Path
) -> None:
    settings, token = board
    target = tmp_path / "backup"
    add_submission(settings, token, b"one")
    back_up(settings, target, prune=False)
    database = (target / "leaderboard.sqlite").read_bytes()
    damaged, sound = add_submission(settings, token, b"two"), add_submission(settings, token, b"three")
    archive = settings.archive_dir / f"{damaged}.zip"
    for content in (b"owt", b"tw"):
        archive.write_bytes(content)
        with pytest.raises(StorageError, match=f"nothing was replaced: 1 problem\n.*{damaged} has "):
            back_up(settings, target, prune=False)
        assert (target / "leaderboard.sqlite").read_bytes() == database
        assert not (target / "archives" / f"{damaged}.zip").exists()
    archive.unlink()
    process = back_up_by_command(settings, target)
    assert process.returncode == 1
    assert re.search(f"has all the rest, but 1 problem\n.*{damaged} is missing", process.stderr)
    assert len(facts(board_settings(target))) == 3
    assert (target / "archives" / f"{sound}.zip").read_bytes() == b"three"
    (target / "archives" / f"{sound}.zip").write_bytes(b"thr")
    with suppress(StorageError):
        back_up(settings, target, prune=False)
    assert (target / "archives" / f"{sound}.zip").read_bytes() == b"three", "a truncated copy is made again"


def test_backup_keeps_what_was_removed_until_it_is_pruned(
    board: tuple[Settings, str], tiny_root: Path, tmp_path: Path
) -> None:
    settings, token = board
    target = tmp_path / "backup"
    removed, freed, kept = (add_submission(settings, token, content) for content in (b"1", b"2", b"3"))
    (settings.archive_dir / "orphan.zip").write_bytes(b"of nobody")
    back_up(settings, target, prune=False)
    (target / "archives" / "orphan.zip").write_bytes(b"of nobody")
    copies = {path: (path.stat().st_ino, path.stat().st_mtime_ns) for path in (target / "archives").iterdir()}
    remove(settings, removed)
    free_archive(settings, freed)
    assert names(settings.archive_dir) == {f"{kept}.zip", "orphan.zip", "leaderboard-id"}
    back_up(settings, target, prune=False)
    assert names(target / "archives") == {
        *(f"{name}.zip" for name in (removed, freed, kept, "orphan")),
        "leaderboard-id",
    }
    process = run("check", "--data", tiny_root, "--state-dir", target)
    assert process.stderr.count("note: ") == 3, process.stderr
    assert f"{removed}.zip: its submission was deleted" in process.stderr
    assert "orphan.zip: its submission is not in the database" in process.stderr
    assert all((path.stat().st_ino, path.stat().st_mtime_ns) == file for path, file in copies.items())
    back_up(settings, target, prune=True)
    assert names(target / "archives") == {f"{kept}.zip", "orphan.zip", "leaderboard-id"}
    assert facts(board_settings(target)) == facts(settings)


@pytest.mark.slow
def test_backup_of_postgresql_is_restored_from_dump_and_archives(tmp_path: Path, postgres: Postgres) -> None:
    url = postgres.new_database(f"dumped_{time.time_ns()}")
    settings = board_settings(tmp_path / "state", db=url)
    token, dump, target = make_board(settings), tmp_path / "board.dump", tmp_path / "backup"
    first = add_submission(settings, token, b"one")
    add_submission(settings, token, b"two")
    postgres.run("pg_dump", "--format", "custom", "--dbname", url, output=dump)
    later = add_submission(settings, token, b"three")
    process = back_up_by_command(settings, target)
    assert process.returncode == 0, process.stderr
    assert "save the rows with pg_dump before" in process.stderr
    assert names(target) == {"archives"}
    other = board_settings(tmp_path / "other")
    make_board(other)
    back_up(other, tmp_path / "of-sqlite", prune=False)
    with pytest.raises(InputError, match="is the backup of an SQLite leaderboard"):
        back_up(settings, tmp_path / "of-sqlite", prune=False)
    restored = board_settings(tmp_path / "restored", db=postgres.new_database(f"restored_{time.time_ns()}"))
    postgres.run("pg_restore", "--dbname", restored.db, input=dump)
    shutil.copytree(target / "archives", restored.archive_dir)
    assert_sound(restored)
    assert facts(restored) == {name: fact for name, fact in facts(settings).items() if name != later}
    free_archive(settings, first)
    assert back_up_by_command(settings, target, "--prune").returncode == 0
    assert names(target / "archives") == names(settings.archive_dir)
    with opened(settings) as (database, _), database.write() as session:
        session.execute(update(ResultModel).values(json=b"x"))
    with pytest.raises(StorageError, match="is no JSON"):
        back_up(settings, target, prune=False)


def shell_of(page: Path, heading: str) -> list[str]:
    """Return the blocks of shell commands in a section of a page."""
    section = page.read_text().split(f"\n## {heading}\n")[1].split("\n## ")[0]
    return [block.split("```")[0] for block in section.split("```sh\n")[1:]]


PAGE = Path(__file__).parents[2] / "docs" / "leaderboard-operator.md"


@pytest.mark.slow
@pytest.mark.parametrize("block", range(2))
def test_restore_runs_as_written(block: int, tiny_root: Path, tmp_path: Path) -> None:
    settings = board_settings(tmp_path / "board")
    token, target = make_board(settings), tmp_path / "backups" / "board"
    add_submission(settings, token, b"one")
    back_up(settings, target, prune=False)
    before = facts(settings)
    newer = add_submission(settings, token, b"two")
    archive = settings.archive_dir / f"{newer}.zip"
    if block:
        back_up(settings, target, prune=False)
    damage(settings.state_dir / "leaderboard.sqlite")
    commands = shell_of(PAGE, "Restore")[block]
    commands = commands.replace("/backups", str(tmp_path / "backups")).replace("ROOT", str(tiny_root))
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    shell = ["bash", "-u", "-c", commands]
    finished = subprocess.run(shell, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert facts(settings) == before
    assert_sound(settings)
    assert stat.S_IMODE(settings.state_dir.stat().st_mode) == 0o700
    if block:
        assert f"{newer}.zip: its submission is not in the database" in finished.stdout + finished.stderr
        assert archive.read_bytes() == b"two"
