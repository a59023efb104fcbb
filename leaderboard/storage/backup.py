"""Online backup of the database and the archives while the service runs."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

from leaderboard.db.engine import Database, sqlite_path
from leaderboard.db.submissions import archive_rows
from leaderboard.settings import Settings
from leaderboard.storage.archive_store import FILE_MODE, ArchiveNotFoundError, ArchiveStore, state_lock
from leaderboard.storage.retention import delete_unneeded
from rebar_depth_bench.atomic_io import atomic_replace, write_error
from rebar_depth_bench.errors import InputError, OutputError, StorageError, problem_summary

DATABASE, ARCHIVES = "leaderboard.sqlite", "archives"
FORMER = f"{DATABASE}.1"
FOLDER_MODE = 0o700


def back_up(settings: Settings, target: Path, prune: bool = False) -> list[str]:
    """Copy the SQLite database and the archives of its submissions into ``target``.

    Returns the ids of the submissions whose archive is neither in the archive storage nor in ``target``. Of a
    PostgreSQL database, only the archives are copied.

    The target is a valid state folder, which ``serve --state-dir target`` can serve. It holds a whole backup at any
    time: archives are added before the database that needs them replaces the former one, and with ``prune``, those
    whose row says deleted or pruned are deleted last. Nothing is replaced unless all that is copied is sound.

    Raises ``InputError`` for a missing database, and a target that is in use, holds other files or has submissions
    that the database lacks, ``StorageError`` for damaged data, and ``OutputError`` if the target cannot be written.
    """
    source, archive_dir = sqlite_path(settings.database_url), target / ARCHIVES
    in_use = {settings.state_dir.resolve(), settings.archive_dir.resolve(), settings.archive_dir.resolve().parent}
    if target.resolve() in in_use | ({source.resolve().parent} if source else set()):
        raise InputError(f"{target}: is in use by the service, expected another folder")
    archives = ArchiveStore(settings.archive_dir)
    with closing(Database(settings.database_url, read_only=True)) as database:
        database.check_schema()
    try:
        target.mkdir(mode=FOLDER_MODE, parents=True, exist_ok=True)
        with state_lock(target, alone=True):
            if any(target.iterdir()) and not ((target / DATABASE).is_file() or archive_dir.is_dir()):
                raise InputError(f"{target}: contains other files, expected a new folder or an earlier backup")
            archive_dir.mkdir(mode=FOLDER_MODE, exist_ok=True)
            for folder in (target, archive_dir):
                folder.chmod(FOLDER_MODE)
            for leftover in [*target.glob(f".{DATABASE}*.tmp*"), *archive_dir.glob(".*.zip.*.tmp")]:
                leftover.unlink()  # Of a backup that was killed.
            copies = ArchiveStore(archive_dir)
            if source is None:
                with closing(Database(settings.database_url, read_only=True)) as database:
                    missing = _copy_archives(database, archives, copies)
                    if prune:
                        delete_unneeded(database, copies)
            else:
                missing = _copy_board(source, archives, target, copies)
                if prune:
                    with closing(_opened(target / DATABASE)) as database:
                        delete_unneeded(database, copies)
        with closing(Database(settings.database_url, read_only=True)) as database:
            kept = archive_rows(database)  # Without what was deleted since its row was copied.
        return [submission_id for submission_id in missing if kept.get(submission_id)]
    except OSError as error:
        raise write_error(target, error) from None


def _copy_board(source: Path, archives: ArchiveStore, target: Path, copies: ArchiveStore) -> list[str]:
    """Copy an SQLite database and its archives; return the ids of missing archives."""
    database_file = target / DATABASE
    with atomic_replace(database_file, FILE_MODE) as temporary:
        former_ids = _submission_ids(database_file) if database_file.is_file() else set()
        _copy_database(source, temporary)
        with closing(_opened(temporary)) as database:
            if problems := database.problems():
                raise StorageError(f"{source}: {problem_summary(problems)}")
            if lost := former_ids - archive_rows(database).keys():
                raise InputError(
                    f"{target}: has {len(lost)} submissions that {source} lacks, such as {min(lost)}; expected the "
                    "backup of this leaderboard, or a new folder"
                )
            missing = _copy_archives(database, archives, copies)
        if database_file.is_file():
            with atomic_replace(target / FORMER, FILE_MODE) as former:
                shutil.copyfile(database_file, former)
    for suffix in ("-wal", "-shm"):  # Empty: what they held is part of the former database.
        Path(f"{database_file}{suffix}").unlink(missing_ok=True)
    return missing


def _opened(file: Path) -> Database:
    return Database(f"sqlite:///{file.absolute()}", read_only=True)


def _copy_archives(database: Database, archives: ArchiveStore, copies: ArchiveStore) -> list[str]:
    """Copy the archives that are new, compare them with their rows, and return the ids of those that are missing.

    An archive that has its size was compared when it was copied. Raises ``StorageError`` for damaged archives.
    """
    missing, damaged = list[str](), list[str]()
    for submission_id, row in archive_rows(database).items():
        if row is None or copies.problem(submission_id, row, hashed=False) is None:
            continue
        try:
            copies.copy_from(archives.path(submission_id), submission_id, row)
        except ArchiveNotFoundError:
            missing.append(submission_id)
        except StorageError as error:
            damaged.append(str(error))
    if damaged:
        raise StorageError(f"nothing was replaced: {problem_summary(damaged)}")
    return missing


def _copy_database(source: Path, copy: Path) -> None:
    """Copy a database, including its write-ahead log, into the single file ``copy``."""
    with (
        closing(sqlite3.connect(f"{source.resolve().as_uri()}?mode=rw", uri=True)) as source_connection,
        closing(sqlite3.connect(copy)) as copy_connection,
    ):
        try:
            source_connection.backup(copy_connection)
            copy_connection.execute("PRAGMA journal_mode=DELETE")
        except sqlite3.OperationalError as error:
            raise OutputError(f"{copy}: cannot be written: {error}") from None
        except sqlite3.DatabaseError as error:
            raise StorageError(f"{source}: cannot be read as a database: {error}") from None


def _submission_ids(database_file: Path) -> set[str]:
    """Return the ids of all submissions of an earlier backup, and move its write-ahead log into the database.

    A log that a killed server left would otherwise be applied to the database that replaces this one.
    """
    with closing(sqlite3.connect(database_file)) as connection:
        try:
            ids = {submission_id for (submission_id,) in connection.execute("SELECT id FROM submissions")}
            (mode,) = connection.execute("PRAGMA journal_mode=DELETE").fetchone()
        except sqlite3.DatabaseError as error:
            raise InputError(f"{database_file}: cannot be read: {error}; expected a sound backup") from None
    if mode != "delete":
        raise InputError(f"{database_file}: is in use, expected a backup that no program reads")
    return ids
