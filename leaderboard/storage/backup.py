"""A copy of all that a restored service needs, taken while it runs."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Sequence
from contextlib import closing, suppress
from pathlib import Path

from sqlalchemy import select

from leaderboard.db.engine import Database
from leaderboard.db.models import SubmissionRecord
from leaderboard.db.submissions import DELETED
from leaderboard.settings import Settings
from leaderboard.storage.archive_store import Archives, GoneError
from rebar_depth_bench.atomic_io import replacing
from rebar_depth_bench.errors import InputError

DATABASE, ARCHIVES = "leaderboard.sqlite", "archives"


def back_up(settings: Settings, target: Path) -> Path:
    """Copy the SQLite database and every archive it knows into ``target``; run again, only what is new is copied.

    The database goes first: archives that come later are no loss, for their submissions are not in the copy.
    ``target`` is a state folder by itself: ``serve --state target`` serves it. Raises ``InputError`` for
    PostgreSQL, which ``pg_dump`` copies, for a database that is not there, and for a target that the service uses.
    """
    if not settings.database_url.startswith("sqlite:///"):
        raise InputError("the database is PostgreSQL: copy it with pg_dump, and the archives as files")
    source = Path(settings.database_url.removeprefix("sqlite:///"))
    if target.resolve() in (source.parent.resolve(), settings.state.resolve()):
        raise InputError(f"{target}: the service itself uses this folder, expected another")
    if not source.is_file():
        raise InputError(f"{source}: there is no database, expected that of a service")
    kept = target / ARCHIVES
    try:
        if target.is_dir() and any(target.iterdir()) and not (target / DATABASE).is_file():
            raise InputError(f"{target}: holds other things, expected a new folder or an earlier backup")
        target.mkdir(mode=0o700, parents=True, exist_ok=True)
        kept.mkdir(exist_ok=True)
        _copy_database(source, target / DATABASE)
        _copy_archives(Archives(settings.archives_url), _known(target / DATABASE), kept)
    except OSError as error:
        raise InputError(f"{target}: cannot be written: {error.strerror or error}") from None
    return target


def _copy_archives(archives: Archives, known: Sequence[str], kept: Path) -> None:
    """Copy what is new, and remove what its owner has deleted."""
    for path in kept.glob("*.zip"):
        if path.stem not in known:
            path.unlink()
    for submission_id in known:
        copy = kept / f"{submission_id}.zip"
        # One that is gone was deleted after the database was copied.
        if not copy.is_file():
            with (
                suppress(GoneError),
                archives.local(submission_id, kept.parent) as archive,
                replacing(copy) as part,
            ):
                shutil.copyfile(archive, part)


def _copy_database(source: Path, copy: Path) -> None:
    with (
        replacing(copy) as part,
        closing(sqlite3.connect(f"{source.resolve().as_uri()}?mode=ro", uri=True)) as read,
        closing(sqlite3.connect(part)) as written,
    ):
        try:
            read.backup(written)
        except sqlite3.DatabaseError as error:
            raise InputError(f"{source}: cannot be read as a database: {error}") from None
        for suffix in ("-wal", "-shm"):  # of an earlier copy that was served: no part of this one
            Path(f"{copy}{suffix}").unlink(missing_ok=True)


def _known(path: Path) -> list[str]:
    with closing(Database(f"sqlite:///{path.absolute()}")) as database:
        database.migrate()
        with database.read() as session:
            return list(session.scalars(select(SubmissionRecord.id).where(SubmissionRecord.status != DELETED)))
