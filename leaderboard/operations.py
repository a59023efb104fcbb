"""Commands of operators: tokens, lists, worker, retention, removal, checks and backup."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from datetime import UTC, datetime

import structlog
from sqlalchemy import select

from leaderboard.db import jobs, submissions
from leaderboard.db.engine import Database, sqlite_path, without_password
from leaderboard.db.models import SubmissionModel, TokenModel
from leaderboard.db.submissions import DELETED, archive_rows
from leaderboard.db.tokens import create_token, list_tokens, replace_token, revoke_token
from leaderboard.health import disk_problem, queue_problems
from leaderboard.scoring.worker import process_queue
from leaderboard.settings import Settings
from leaderboard.storage import retention
from leaderboard.storage.archive_store import ArchiveStore, archive_problem
from leaderboard.storage.backup import back_up
from rebar_depth_bench import software_version
from rebar_depth_bench.base.errors import InputError, StorageError, problem_summary
from rebar_depth_bench.data.files import file_problems
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.reporting.formatting import counted
from rebar_depth_bench.scoring.frames import csv_text

_LOG = structlog.get_logger("worker")
Cell = str | float | None


def run_operation(command: str, settings: Settings, options: argparse.Namespace) -> None:
    """Run a command on the database of the settings, and print its output.

    Raises ``InputError``, and ``StorageError`` for stored data that are missing or damaged.
    """
    if command in ("backup", "check"):
        (_back_up if command == "backup" else _check)(settings, options)
        return
    with closing(Database(settings.database_url)) as database:
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
    if not options.id.isascii() or submissions.find(database, options.id) is None:
        raise InputError(f"there is no submission {options.id!r}")
    submissions.remove(database, options.id)
    retention.delete_archives(ArchiveStore(settings.archive_dir), [options.id])


def _prune(database: Database, settings: Settings, options: argparse.Namespace) -> None:
    archives = ArchiveStore(settings.archive_dir)
    if options.orphans:
        pruned = retention.orphaned_archives(database, archives)
        if not options.dry_run:
            retention.delete_archives(archives, pruned)
    elif settings.archive_days:
        pruned = retention.expired_archives(database, open_folder(settings.data), settings)
        if not options.dry_run:
            retention.prune_archives(database, archives, pruned)
    else:
        raise InputError("archive_days is 0, which keeps every archive; expected --archive-days DAYS")
    for submission_id in pruned:
        print(submission_id)


def _back_up(settings: Settings, options: argparse.Namespace) -> None:
    if sqlite_path(settings.database_url) is None:
        note = "only archives are copied; save the rows with pg_dump before, so that each has its archive"
        print(f"the database is PostgreSQL: {note}", file=sys.stderr)
    back_up(settings, options.target, options.prune)
    print(options.target)


def _check(settings: Settings, options: argparse.Namespace) -> None:
    """Print that all is well; nothing is written or created.

    Raises ``StorageError`` with everything that is wrong, and ``InputError`` if only the dataset is.
    """
    archives = ArchiveStore(settings.archive_dir, create=False)
    with closing(Database(settings.database_url, read_only=True)) as database:
        database.check_schema()
        problems = [*database.problems(), *_archive_problems(database, archives, options.hash_archives)]
        problems += queue_problems(database)
        of_dataset = _dataset_problems(database, settings, archives)
    for name, folder in (("the state folder", settings.state_dir), ("the archives", settings.archive_dir)):
        problems += disk_problem(folder, name) if folder.is_dir() else []
    if problems or of_dataset:
        raise (StorageError if problems else InputError)(problem_summary([*problems, *of_dataset]))
    print(f"dataset, database, {counted(len(archives.ids()), 'archive')}, disk and queue are in order")


def _archive_problems(database: Database, archives: ArchiveStore, hashed: bool) -> Iterator[str]:
    rows = archive_rows(database)
    found = {name: archive_problem(archives.file(name), row, hashed) for name, row in rows.items() if row}
    rows = archive_rows(database)  # Again, because archives may have been deleted meanwhile.
    for name, problem in found.items():
        if problem and rows[name]:
            yield f"the archive of submission {name} {problem}"
    for name in retention.unneeded_archives(rows, archives):
        yield f"the archive {name}.zip exists, but its row says deleted; serve deletes it within an hour"
    for name in retention.orphaned_archives(database, archives):
        yield f"the archive {name}.zip has no submission; prune --orphans deletes it"


def _dataset_problems(database: Database, settings: Settings, archives: ArchiveStore) -> list[str]:
    try:
        folder = open_folder(settings.data)
    except InputError as error:
        return [str(error)]
    with database.read() as session:
        stale = jobs.stale_submissions(session, folder.digest, archives.ids())
    others = sum(record.dataset_digest != folder.digest for record in stale)
    text = f"{counted(others, 'submission')} of another dataset than {folder.digest}"
    return [*map(str, file_problems(folder)), *([text] if others else [])]


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
}
