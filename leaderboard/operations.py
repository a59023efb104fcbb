"""Commands of operators that list and check: ``tokens``, ``submissions``, ``prune`` and ``check``."""

from __future__ import annotations

import shutil
from contextlib import closing
from datetime import UTC, datetime

from sqlalchemy import select

from leaderboard.checks import disk_problem, queue_problems
from leaderboard.db import jobs
from leaderboard.db.engine import Database
from leaderboard.db.models import SubmissionModel, TokenModel
from leaderboard.db.submissions import DELETED
from leaderboard.db.tokens import list_tokens
from leaderboard.settings import Settings
from leaderboard.storage.archive_store import ArchiveStore
from leaderboard.storage.retention import delete_archives, expired_archives
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.verification import file_problems
from rebar_depth_bench.errors import InputError
from rebar_depth_bench.reporting.formatting import counted
from rebar_depth_bench.reporting.tables import csv_text

Cell = str | float | None


def run_operation(command: str, settings: Settings, *, dry_run: bool) -> None:
    """Run a command on the database of the settings, and print its output. Raises ``InputError``."""
    with closing(Database(settings.database_url)) as database:
        database.migrate()
        if command == "tokens":
            print(_tokens_csv(database), end="")
        elif command == "submissions":
            print(_submissions_csv(database), end="")
        elif command == "prune":
            _prune(database, settings, dry_run=dry_run)
        else:
            _check(database, settings)


def _tokens_csv(database: Database) -> str:
    head = ["name", "created", "revoked", "submissions", "bytes"]
    rows: list[list[Cell]] = [
        [token.name, _time(token.created_at), _time(token.revoked_at), token.submissions, token.size]
        for token in list_tokens(database)
    ]
    return csv_text([head, *rows])


def _submissions_csv(database: Database) -> str:
    head = ["id", "submitter", "method", "status", "public", "created", "bytes", "archive_deleted"]
    query = (
        select(SubmissionModel, TokenModel.name)
        .join(TokenModel, TokenModel.id == SubmissionModel.token_id)
        .where(SubmissionModel.status != DELETED)
        .order_by(SubmissionModel.created_at)
    )
    with database.read() as session:
        rows: list[list[Cell]] = [
            [
                *(record.id, name, record.method, record.status, record.public, _time(record.created_at)),
                *(record.archive_bytes, _time(record.archive_deleted_at)),
            ]
            for record, name in session.execute(query)
        ]
    return csv_text([head, *rows])


def _prune(database: Database, settings: Settings, *, dry_run: bool) -> None:
    if not settings.archive_days:
        raise InputError("archive_days is 0, which keeps every archive; expected --archive-days DAYS")
    configs = open_folder(settings.data).configs
    expired = expired_archives(database, configs, settings.archive_days, settings.archive_ranks)
    if not dry_run:
        delete_archives(database, ArchiveStore(settings.archive_dir), expired)
    for record in expired:
        print(record.id)


def _check(database: Database, settings: Settings) -> None:
    """Print that all is well. Raises ``InputError`` with everything that is wrong."""
    folder = open_folder(settings.data)
    problems = [str(problem) for problem in file_problems(folder)]
    if stale := jobs.count_stale_submissions(database, folder.digest):
        problems.append(f"{counted(stale, 'submission')} of another dataset than {folder.digest}")
    archives = ArchiveStore(settings.archive_dir).ids()
    query = select(SubmissionModel.id).where(
        SubmissionModel.status != DELETED, SubmissionModel.archive_deleted_at.is_(None)
    )
    with database.read() as session:
        missing = [submission_id for submission_id in session.scalars(query) if submission_id not in archives]
    problems += [f"the archive of submission {submission_id} is missing" for submission_id in missing]
    problems += [*disk_problem(settings.state_dir), *queue_problems(database)]
    if problems:
        raise InputError("\n".join([f"{counted(len(problems), 'problem')}:", *(f"  - {one}" for one in problems)]))
    free = shutil.disk_usage(settings.state_dir).free
    print(f"dataset, database, {counted(len(archives), 'archive')} and queue are in order; {free >> 30} GiB free")


def _time(seconds: float | None) -> str:
    return "" if seconds is None else datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
