"""Online backup of the database and the archives while the service runs."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path

from sqlalchemy import select

from leaderboard.db.engine import Database, database_errors, sqlite_path
from leaderboard.db.models import SubmissionModel
from leaderboard.db.submissions import archive_rows
from leaderboard.settings import Settings
from leaderboard.storage.archive_store import (
    FILE_MODE,
    ArchiveNotFoundError,
    ArchiveStore,
    archive_problem,
    state_lock,
)
from rebar_depth_bench.base.errors import InputError, StorageError, problem_summary
from rebar_depth_bench.base.writing import atomic_replace, write_error

DATABASE, FORMER, ARCHIVES = "leaderboard.sqlite", "leaderboard.sqlite.1", "archives"
Rows = Mapping[str, tuple[str, int] | None]
"""SHA-256 and size of archives by submission id, as ``archive_rows`` returns them."""


def back_up(settings: Settings, target: Path, prune: bool) -> None:
    """Copy the SQLite database and the archives of its submissions into ``target``; of PostgreSQL, the archives.

    The target is a valid state folder, which ``serve --state-dir target`` can serve. It holds a whole backup at
    any time: archives are added before the database that needs them replaces the former one, and with ``prune``,
    those whose row says deleted are deleted last. Nothing is replaced unless what is copied is sound.

    Raises ``InputError`` for a target that is in use, holds other files or has submissions that the database
    lacks, ``OutputError`` if the target cannot be written, and ``StorageError`` for damaged data, and, after all
    the rest is copied, for missing archives.
    """
    source, archive_dir = sqlite_path(settings.database_url), settings.archive_dir.resolve()
    in_use = {settings.state_dir.resolve(), archive_dir, archive_dir.parent}
    if target.resolve() in in_use or (source and target.resolve() == source.resolve().parent):
        raise InputError(f"{target}: is in use by the service, expected another folder")
    with closing(Database(settings.database_url, read_only=True)) as database:
        database.check_schema()
        board_id = database.board().board_id
        rows: Rows = archive_rows(database)
        archives = ArchiveStore(settings.archive_dir, board_id)
        archives.check()
        if source is None and (problems := database.problems()):
            raise StorageError(f"nothing was copied: {problem_summary(problems)}")
    try:
        target.mkdir(mode=0o700, parents=True, exist_ok=True)
        with state_lock(target, alone=True):
            if any(target.iterdir()) and not any((target / name).exists() for name in (DATABASE, ARCHIVES)):
                raise InputError(f"{target}: contains other files, expected a new folder or an earlier backup")
            if source is None and (target / DATABASE).exists():
                raise InputError(f"{target}: is the backup of an SQLite leaderboard, expected another folder")
            target.chmod(0o700)
            copies = ArchiveStore(target / ARCHIVES, board_id)
            copies.initialise({})
            try:
                copies.check()
            except StorageError:
                found = "is the backup of another leaderboard or version"
                raise InputError(f"{target}: {found}, expected a new folder or an earlier backup") from None
            copies.finish_deletions({}, copy_age_s=0)  # Copies of a backup that was killed.
            for leftover in target.glob(f".{DATABASE}*.tmp*"):
                leftover.unlink()
            if source is None:
                missing = _copy_archives(rows, archives, copies)
            else:
                rows, missing = _copy_board(source, archives, target, copies)
            if prune:
                copies.finish_deletions(rows)
    except OSError as error:
        raise write_error(target, error) from None
    with closing(Database(settings.database_url, read_only=True)) as database:
        rows = archive_rows(database)  # Again, because archives may have been deleted meanwhile.
    if missing := [f"the archive of submission {name} is missing" for name in missing if rows[name]]:
        raise StorageError(f"{target}: has all the rest, but {problem_summary(missing)}")


def _copy_board(
    source: Path, archives: ArchiveStore, target: Path, copies: ArchiveStore
) -> tuple[Rows, list[str]]:
    """Copy an SQLite database and its archives; return the rows of archives, and the ids of missing archives."""
    former = target / DATABASE
    with atomic_replace(former, FILE_MODE) as temporary:
        former_ids = _submission_ids(former) if former.is_file() else set()
        _copy_database(source, temporary)
        with closing(Database(f"sqlite:///{temporary.absolute()}", read_only=True)) as database:
            if problems := database.problems():
                raise StorageError(f"{source}: {problem_summary(problems)}")
            rows = archive_rows(database)
        if lost := former_ids - rows.keys():
            raise InputError(
                f"{target}: has {len(lost)} submissions that {source} lacks, as {min(lost)}; expected a new folder"
            )
        missing = _copy_archives(rows, archives, copies)
        if former.is_file():
            with atomic_replace(target / FORMER, FILE_MODE) as kept:
                _copy_database(former, kept)
            # SQLite has moved the log of a killed server into the former database; it would damage the new one.
            if Path(f"{former}-wal").exists():
                raise InputError(f"{former}: a program has it open, expected a backup that none uses")
    for suffix in ("-wal", "-shm"):  # Of a program that has opened the former database since.
        Path(f"{former}{suffix}").unlink(missing_ok=True)
    return rows, missing


def _copy_archives(rows: Rows, archives: ArchiveStore, copies: ArchiveStore) -> list[str]:
    """Copy the archives that are new, compare them with their rows, and return the ids of those that are missing.

    An archive that has its size was compared when it was copied. Raises ``StorageError`` for damaged archives.
    """
    missing, damaged = list[str](), list[str]()
    for submission_id, row in rows.items():
        copy = copies.file(submission_id)
        if row is None or archive_problem(copy, row, hashed=False) is None:
            continue
        try:
            with atomic_replace(copy, FILE_MODE) as temporary:
                shutil.copyfile(archives.path(submission_id), temporary)
                if problem := archive_problem(temporary, row, hashed=True):
                    raise StorageError(f"the archive of submission {submission_id} {problem}")
        except ArchiveNotFoundError:
            missing.append(submission_id)
        except StorageError as error:
            damaged.append(str(error))
    if damaged:
        raise StorageError(f"nothing was replaced: {problem_summary(damaged)}")
    return missing


def _copy_database(source: Path, copy: Path) -> None:
    """Copy a database with its write-ahead log into one file."""
    with (
        closing(sqlite3.connect(f"{source.resolve().as_uri()}?mode=rw", uri=True)) as source_connection,
        closing(sqlite3.connect(copy)) as copy_connection,
    ):
        try:
            source_connection.backup(copy_connection)
            copy_connection.execute("PRAGMA journal_mode=DELETE")
        except sqlite3.DatabaseError as error:
            raise StorageError(f"{source}: cannot be copied to {copy}: {error}") from None


def _submission_ids(database_file: Path) -> set[str]:
    """Return the ids of all submissions of an earlier backup, including those in its write-ahead log."""
    url = f"sqlite:///{database_file.absolute()}"
    with database_errors(url, InputError), closing(Database(url, read_only=True)) as one, one.read() as session:
        return set(session.scalars(select(SubmissionModel.id)))
