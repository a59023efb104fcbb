"""Backup: what it refuses, what it keeps, and how a board is restored from it."""

from __future__ import annotations

import os
import shutil
import signal
import sqlite3
import stat
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

import pytest
from sqlalchemy import update

from leaderboard.db import submissions
from leaderboard.db.models import ResultModel
from leaderboard.settings import Settings
from leaderboard.storage.archive_store import state_lock
from leaderboard.storage.backup import back_up
from leaderboard.storage.retention import prune_archives
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
from tests.leaderboard.serving import RunServer
from tests.leaderboard.test_operations import run


def tree(folder: Path) -> dict[str, bytes]:
    """Return the content of all files by their path."""
    return {
        str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()
    }


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.fixture
def board(tmp_path: Path) -> tuple[Settings, str]:
    """Return the settings of a board, and a token of it."""
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
        with pytest.raises(InputError, match=f"has 1 submissions that .* lacks, as {kept}"):
            back_up(settings, target, prune)
        assert tree(target) == before
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
    (target / "leaderboard.sqlite").write_bytes(b"no database" * 1000)
    sound = board_settings(tmp_path / "sound")
    make_board(sound)
    with pytest.raises(InputError, match="file is not a database"):
        back_up(sound, target, prune=False)


def _accept_and_die(settings: Settings, token: str) -> None:
    """Add a submission, and die before the write-ahead log is moved into the database."""
    with opened(settings):
        add_submission(settings, token, b"accepted by the backup")
        os.kill(os.getpid(), signal.SIGKILL)


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


def test_served_backup_is_refused_while_it_is_served(tmp_path: Path, running_server: RunServer) -> None:
    settings = board_settings(tmp_path / "state")
    make_board(settings)
    back_up(settings, tmp_path / "backup", prune=False)
    with running_server(tmp_path / "backup", workers=0):
        process = run("backup", tmp_path / "backup", "--state-dir", settings.state_dir)
    assert process.returncode == 2
    assert "a server, a worker or another command uses it" in process.stderr


def test_backup_has_the_modes_of_a_state_folder(board: tuple[Settings, str], tmp_path: Path) -> None:
    settings, token = board
    target = tmp_path / "backup"
    target.mkdir(mode=0o755)
    submission_id = add_submission(settings, token, b"one")
    for _ in range(2):
        back_up(settings, target, prune=False)
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in [target, *target.rglob("*")]}
    assert modes == {
        "backup": 0o700,
        "archives": 0o700,
        f"{submission_id}.zip": 0o600,
        "leaderboard.sqlite": 0o600,
        "leaderboard.sqlite.1": 0o600,
    }


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
    with pytest.raises(StorageError, match=f"has all the rest, but 1 problem\n.*{damaged} is missing"):
        back_up(settings, target, prune=False)
    assert len(facts(board_settings(target))) == 3
    assert (target / "archives" / f"{sound}.zip").read_bytes() == b"three"
    (target / "archives" / f"{sound}.zip").write_bytes(b"thr")
    with suppress(StorageError):
        back_up(settings, target, prune=False)
    assert (target / "archives" / f"{sound}.zip").read_bytes() == b"three", "a truncated copy is made again"


def test_backup_keeps_what_was_removed_until_it_is_pruned(board: tuple[Settings, str], tmp_path: Path) -> None:
    settings, token = board
    target = tmp_path / "backup"
    removed, pruned, kept = (add_submission(settings, token, content) for content in (b"1", b"2", b"3"))
    (settings.archive_dir / "orphan.zip").write_bytes(b"of nobody")
    back_up(settings, target, prune=False)
    (target / "archives" / "orphan.zip").write_bytes(b"of nobody")
    with opened(settings) as (database, archives):
        submissions.remove(database, removed)
        prune_archives(database, archives, [pruned])
    assert names(settings.archive_dir) == {f"{kept}.zip", "orphan.zip"}
    back_up(settings, target, prune=False)
    assert names(target / "archives") == {f"{name}.zip" for name in (removed, pruned, kept, "orphan")}
    back_up(settings, target, prune=True)
    assert names(target / "archives") == {f"{kept}.zip", "orphan.zip"}
    assert facts(board_settings(target)) == facts(settings)


@pytest.mark.slow
def test_backup_of_postgresql_is_restored_from_dump_and_archives(
    tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    postgres = request.getfixturevalue("postgres")
    url = postgres.new_database(f"dumped_{time.time_ns()}")
    settings = board_settings(tmp_path / "state", db=url)
    token, dump, target = make_board(settings), tmp_path / "board.dump", tmp_path / "backup"
    first = add_submission(settings, token, b"one")
    add_submission(settings, token, b"two")
    postgres.run("pg_dump", "--format", "custom", "--dbname", url, output=dump)
    later = add_submission(settings, token, b"three")
    process = run("backup", target, "--state-dir", settings.state_dir, "--db", url)
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
    with opened(settings) as (database, archives):
        prune_archives(database, archives, [first])
    assert run("backup", target, "--state-dir", settings.state_dir, "--db", url, "--prune").returncode == 0
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
def test_restore_runs_as_written(
    block: int, tiny_root: Path, tmp_path: Path, make_shell: Callable[[Path], Callable[[str], str]]
) -> None:
    settings = board_settings(tmp_path / "board")
    token, target = make_board(settings), tmp_path / "backups" / "board"
    shell = make_shell(tiny_root)
    add_submission(settings, token, b"one")
    back_up(settings, target, prune=False)
    before = facts(settings)
    newer = add_submission(settings, token, b"two")
    archive = settings.archive_dir / f"{newer}.zip"
    os.utime(archive, (0, 0))
    if block:
        back_up(settings, target, prune=False)
    damage(settings.state_dir / "leaderboard.sqlite")
    printed = shell(shell_of(PAGE, "Restore")[block])
    assert facts(settings) == before
    assert_sound(settings)
    assert stat.S_IMODE(settings.state_dir.stat().st_mode) == 0o700
    if block:
        assert f"{newer}.zip has no submission" in printed
        assert archive.read_bytes() == b"two"


@pytest.fixture
def make_shell(tmp_path: Path) -> Callable[[Path], Callable[[str], str]]:
    """Return a function that runs commands of the page with the folders of a test, and returns what they print."""

    def make(root: Path) -> Callable[[str], str]:
        def shell(commands: str) -> str:
            text = commands.replace("/backups", str(tmp_path / "backups")).replace("ROOT", str(root))
            environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
            finished = subprocess.run(
                ["bash", "-u", "-c", text],
                cwd=tmp_path,
                env=environment,
                capture_output=True,
                text=True,
                check=False,
            )
            return finished.stdout + finished.stderr

        return shell

    return make
