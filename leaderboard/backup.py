"""A copy of all that a restored service needs, taken while it runs."""

from __future__ import annotations

import shutil
import sqlite3
from pathlib import Path

from sqlalchemy import select

from leaderboard.archives import Archives
from leaderboard.database import Database
from leaderboard.records import SubmissionRecord
from leaderboard.settings import Settings
from leaderboard.submissions import DELETED
from rebar_depth_bench.errors import InputError
from rebar_depth_bench.files import replacing

DATABASE, ARCHIVES = "leaderboard.sqlite", "archives"


def back_up(settings: Settings, target: Path) -> Path:
    """Copy the SQLite database and every archive it knows into ``target``; run again, only what is new is copied.

    The database goes first: archives that come later are no loss, for their submissions are not in the copy.
    ``target`` is a state folder by itself: ``serve --state target`` serves it. Raises ``InputError`` for
    PostgreSQL, which ``pg_dump`` copies.
    """
    if not settings.database_url.startswith("sqlite:///"):
        raise InputError("the database is PostgreSQL: copy it with pg_dump, and the archives as files")
    kept = target / ARCHIVES
    kept.mkdir(parents=True, exist_ok=True)
    with replacing(target / DATABASE) as part:
        source, copy = sqlite3.connect(settings.database_url.removeprefix("sqlite:///")), sqlite3.connect(part)
        with source, copy:
            source.backup(copy)
        source.close()
        copy.close()
    archives = Archives(settings.archives_url)
    database = Database(f"sqlite:///{(target / DATABASE).absolute()}")
    with database.read() as session:
        known = session.scalars(select(SubmissionRecord.id).where(SubmissionRecord.status != DELETED)).all()
    database.close()
    for submission_id in known:
        if not (kept / f"{submission_id}.zip").is_file():
            with (
                archives.local(submission_id, target) as archive,
                replacing(kept / f"{submission_id}.zip") as part,
            ):
                shutil.copyfile(archive, part)
    return target
