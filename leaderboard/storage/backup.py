"""Online backup of the database and the archives while the service runs."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Sequence
from contextlib import closing, suppress
from pathlib import Path

from sqlalchemy import select

from leaderboard.db.engine import Database, sqlite_path
from leaderboard.db.models import SubmissionModel
from leaderboard.db.submissions import DELETED
from leaderboard.settings import Settings
from leaderboard.storage.archive_store import ArchiveNotFoundError, ArchiveStore
from rebar_depth_bench.atomic_io import atomic_replace, write_error
from rebar_depth_bench.errors import InputError, OutputError

DATABASE, ARCHIVES = "leaderboard.sqlite", "archives"


def back_up(settings: Settings, target: Path) -> Path:
    """Copy the SQLite database and the archives of its submissions into ``target``; return ``target``.

    The database is copied first; archives accepted later are left out, because their submissions are not in the
    copy. A repeated backup copies new archives only. The target is a valid state folder, which
    ``serve --state-dir target`` can serve. Raises ``InputError`` for a PostgreSQL database (use ``pg_dump``), a
    missing database, and a target that the service uses or that holds other files, and ``OutputError`` for one
    that cannot be written.
    """
    source = sqlite_path(settings.database_url)
    if source is None:
        raise InputError("the database is PostgreSQL, expected SQLite; use pg_dump and copy the archives as files")
    if target.resolve() in (source.parent.resolve(), settings.state_dir.resolve()):
        raise InputError(f"{target}: is in use by the service, expected another folder")
    if not source.is_file():
        raise InputError(f"{source}: the database does not exist, expected the database of a leaderboard")
    archive_dir = target / ARCHIVES
    try:
        if target.is_dir() and any(target.iterdir()) and not (target / DATABASE).is_file():
            raise InputError(f"{target}: contains other files, expected a new folder or an earlier backup")
        target.mkdir(mode=0o700, parents=True, exist_ok=True)
        archive_dir.mkdir(exist_ok=True)
        _copy_database(source, target / DATABASE)
        _copy_archives(ArchiveStore(settings.archive_dir), _submission_ids(target / DATABASE), archive_dir)
    except OSError as error:
        raise write_error(target, error) from None
    return target


def _copy_archives(archives: ArchiveStore, submission_ids: Sequence[str], archive_dir: Path) -> None:
    """Copy archives that are new, and remove those of deleted submissions."""
    for path in archive_dir.glob("*.zip"):
        if path.stem not in submission_ids:
            path.unlink()
    for submission_id in submission_ids:
        copy = archive_dir / f"{submission_id}.zip"
        # A missing archive was deleted after the database was copied.
        if not copy.is_file():
            with suppress(ArchiveNotFoundError), atomic_replace(copy) as temporary:
                shutil.copyfile(archives.path(submission_id), temporary)


def _copy_database(source: Path, copy: Path) -> None:
    with (
        atomic_replace(copy) as temporary,
        closing(sqlite3.connect(f"{source.resolve().as_uri()}?mode=ro", uri=True)) as source_connection,
        closing(sqlite3.connect(temporary)) as copy_connection,
    ):
        try:
            source_connection.backup(copy_connection)
        except sqlite3.OperationalError as error:
            raise OutputError(f"{copy}: cannot be written: {error}") from None
        except sqlite3.DatabaseError as error:
            raise InputError(f"{source}: cannot be read as a database: {error}") from None
        for suffix in ("-wal", "-shm"):  # Left over if an earlier backup was served.
            Path(f"{copy}{suffix}").unlink(missing_ok=True)


def _submission_ids(path: Path) -> list[str]:
    with closing(Database(f"sqlite:///{path.absolute()}")) as database:
        database.migrate()
        with database.read() as session:
            return list(session.scalars(select(SubmissionModel.id).where(SubmissionModel.status != DELETED)))
