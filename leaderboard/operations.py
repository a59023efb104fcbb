"""Commands of operators: tokens, lists, worker, retention, removal, checks and backup."""

from __future__ import annotations

import argparse
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import closing
from datetime import UTC, datetime

import structlog
from sqlalchemy import select

from leaderboard.db import jobs, submissions
from leaderboard.db.engine import Database, without_password
from leaderboard.db.models import SubmissionModel, TokenModel
from leaderboard.db.submissions import DELETED
from leaderboard.db.tokens import create_token, list_tokens, replace_token, revoke_token
from leaderboard.scoring.worker import process_queue
from leaderboard.service import disk_problem, queue_problems
from leaderboard.settings import Settings
from leaderboard.storage.archive_store import ArchiveStore
from leaderboard.storage.backup import back_up
from leaderboard.storage.retention import delete_archives, expired_archives
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.verification import file_problems
from rebar_depth_bench.errors import InputError
from rebar_depth_bench.reporting.formatting import counted
from rebar_depth_bench.reporting.tables import csv_text
from rebar_depth_bench.version import software_version

_LOG = structlog.get_logger("worker")
Cell = str | float | None


def run_operation(command: str, settings: Settings, options: argparse.Namespace) -> None:
    """Run a command on the database of the settings, and print its output. Raises ``InputError``."""
    if command == "backup":
        print(back_up(settings, options.target))
        return
    with closing(Database(settings.database_url)) as database:
        if command == "score" and database.file is not None and not database.file.is_file():
            raise InputError(
                f"{settings.database_url}: the database does not exist, expected the database of a server"
            )
        database.migrate()
        _OPERATIONS[command](database, settings, options)


def _score(database: Database, settings: Settings, _: argparse.Namespace) -> None:
    """Score queued submissions until SIGTERM or SIGINT; then requeue the current job."""
    stop = threading.Event()
    for signal_number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(signal_number, lambda *_: stop.set())
    url = without_password(settings.database_url)
    _LOG.info("waiting for submissions", database=url, version=software_version())
    process_queue(database, settings, stop)


def _token(database: Database, _: Settings, options: argparse.Namespace) -> None:
    if options.revoke:
        revoke_token(database, options.name)
        return
    print((replace_token if options.replace else create_token)(database, options.name))
    print("The token is not shown again; only its hash is stored.", file=sys.stderr)


def _tokens(database: Database, _: Settings, __: argparse.Namespace) -> None:
    rows = [
        (name, _time(created), _time(revoked), count, size)
        for name, created, revoked, count, size in list_tokens(database)
    ]
    _print_csv(["name", "created", "revoked", "submissions", "bytes"], rows)


def _submissions(database: Database, _: Settings, __: argparse.Namespace) -> None:
    query = (
        select(SubmissionModel, TokenModel.name)
        .join(TokenModel, TokenModel.id == SubmissionModel.token_id)
        .where(SubmissionModel.status != DELETED)
        .order_by(SubmissionModel.created_at)
    )
    with database.read() as session:
        rows = [
            (
                *(one.id, name, one.method, one.status, one.public, _time(one.created_at)),
                *(one.archive_bytes, _time(one.archive_deleted_at)),
            )
            for one, name in session.execute(query)
        ]
    head = ["id", "submitter", "method", "status", "public", "created", "bytes", "archive_deleted"]
    _print_csv(head, rows)


def _remove(database: Database, settings: Settings, options: argparse.Namespace) -> None:
    if submissions.find(database, options.id) is None:
        raise InputError(f"there is no submission {options.id!r}")
    submissions.remove(database, options.id)
    ArchiveStore(settings.archive_dir).delete(options.id)


def _prune(database: Database, settings: Settings, options: argparse.Namespace) -> None:
    if not settings.archive_days:
        raise InputError("archive_days is 0, which keeps every archive; expected --archive-days DAYS")
    expired = expired_archives(database, open_folder(settings.data).configs, settings)
    if not options.dry_run:
        delete_archives(database, ArchiveStore(settings.archive_dir), expired)
    for record in expired:
        print(record.id)


def _check(database: Database, settings: Settings, _: argparse.Namespace) -> None:
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


def _print_csv(head: Sequence[str], rows: Sequence[Sequence[Cell]]) -> None:
    print(csv_text([head, *rows]), end="")


def _time(seconds: float | None) -> str:
    return "" if seconds is None else datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


_OPERATIONS: dict[str, Callable[[Database, Settings, argparse.Namespace], None]] = {
    "score": _score,
    "token": _token,
    "tokens": _tokens,
    "submissions": _submissions,
    "remove": _remove,
    "prune": _prune,
    "check": _check,
}
