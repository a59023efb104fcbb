"""Command line of ``rebar-leaderboard``: server, work on its database and archives, and set-up of the logs."""

from __future__ import annotations

import argparse
import logging
import signal
import stat
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any

import structlog
from sqlalchemy import select
from structlog.typing import Processor

from leaderboard.db import jobs, submissions
from leaderboard.db.engine import Database, database_errors, sqlite_path, without_password
from leaderboard.db.models import SubmissionModel, TokenModel
from leaderboard.db.submissions import DELETED, QUEUED, SCORING, archive_rows
from leaderboard.db.tokens import create_token, list_tokens, replace_token, revoke_token
from leaderboard.health import disk_problem, queue_problems
from leaderboard.scoring.worker import process_queue
from leaderboard.settings import Settings, read_settings
from leaderboard.storage.archive_store import ArchiveStore, archive_problem, make_folder, state_lock
from leaderboard.storage.backup import back_up
from rebar_depth_bench import software_version
from rebar_depth_bench.base.errors import InputError, StorageError, problem_summary
from rebar_depth_bench.cli.console import Command, program_parser, run_program
from rebar_depth_bench.data.files import file_problems
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.scoring.formatting import counted
from rebar_depth_bench.scoring.spreadsheet import csv_text

_LOG = structlog.get_logger("worker")
Cell = str | float | None


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return the exit status: 0 = success, 2 = invalid input, 1 = any other error."""
    return run_program(argument_parser(), arguments)


def argument_parser() -> argparse.ArgumentParser:
    """Return the argument parser with all commands."""
    parser = program_parser(
        "rebar-leaderboard",
        "Leaderboard server that scores prediction archives exactly as rebar-bench does.",
        {name: Command(one.summary, partial(_add_arguments, name), _run) for name, one in COMMANDS.items()},
        epilog="Each setting can also be given as the environment variable REBAR_LEADERBOARD_NAME or as "
        "name = value in a TOML file (--settings). The command line takes precedence over the file, and the file "
        "over the environment.",
    )
    parser.set_defaults(interrupted="stopped")
    return parser


def _add_arguments(name: str, command: argparse.ArgumentParser) -> None:
    command.set_defaults(command=name)
    command.add_argument("--settings", type=Path, metavar="FILE", help="TOML file with settings")
    for setting in COMMANDS[name].settings:
        _add_setting(command, setting)
    if name == "token":
        command.add_argument("name", metavar="NAME", help="name of the submitter, shown on the leaderboard")
        change = command.add_mutually_exclusive_group()
        change.add_argument("--replace", action="store_true", help="revoke the existing token of NAME")
        change.add_argument("--revoke", action="store_true", help="only revoke the existing token of NAME")
        change.add_argument(
            "--baseline", action="store_true", help="mark the rows of the new token as the organiser's"
        )
    if name == "requeue":
        command.add_argument("ids", metavar="ID", nargs="+", help="id of a submission, the last part of its URL")
    if name == "remove":
        command.add_argument("id", metavar="ID", help="id of the submission, the last part of its URL")
        command.add_argument(
            "--archive-only", action="store_true", help="delete its archive, and keep its results"
        )
    if name == "check":
        command.add_argument("--hash-archives", action="store_true", help="read all archives, too")
    if name == "backup":
        command.add_argument("target", type=Path, metavar="FOLDER", help="folder to write the backup to")
        command.add_argument("--prune", action="store_true", help="delete from it the archives that were removed")


def _add_setting(command: argparse.ArgumentParser, name: str) -> None:
    field = Settings.model_fields[name]
    flag: dict[str, Any] = {"nargs": "?", "const": "true"} if field.annotation is bool else {}
    default_text = "" if field.is_required() or field.default == "" else f" (default: {field.default})"
    command.add_argument(
        f"--{name.replace('_', '-')}",
        metavar=name.upper(),
        help=f"{field.description}{default_text}".replace("%", "%%"),
        **flag,
    )


def _run(options: argparse.Namespace) -> None:
    """Run a command with its settings, while the state folder is locked and has the right mode.

    Raises ``InputError``, and ``StorageError`` for stored data that are missing or damaged.
    """
    command = COMMANDS[options.command]
    values = {name: getattr(options, name, None) for name in command.settings}
    overrides: dict[str, Any] = {name: value for name, value in values.items() if value is not None}
    settings = read_settings(
        options.settings, overrides if "data" in command.settings else {**overrides, "data": ""}
    )
    set_up_logs()
    database = sqlite_path(settings.database_url)
    is_missing = database is not None and not database.is_file() and options.command not in ("serve", "token")
    with ExitStack() as stack:
        if options.command != "check" and (settings.state_dir.exists() or not is_missing):  # It writes nothing.
            _make_state_dir(settings.state_dir)
            stack.enter_context(state_lock(settings.state_dir))
        if is_missing:
            raise InputError(f"{database}: the database does not exist, expected the database of a leaderboard")
        stack.enter_context(database_errors(settings.database_url))
        command.run(settings, options)


def _make_state_dir(folder: Path) -> None:
    """Create the state folder with mode 0700, because the ids in it give access to unpublished submissions.

    Raises ``InputError`` if others may read an existing folder, and the errors of ``make_folder``.
    """
    make_folder(folder, "the state folder")
    mode = stat.S_IMODE(folder.stat().st_mode)
    if mode & 0o077:
        raise InputError(f"the state folder {folder}: has mode {mode:04o}, expected 0700; run: chmod 700 {folder}")


@contextmanager
def _opened(settings: Settings) -> Iterator[Database]:
    """Yield the database of the settings; an empty one gets its tables."""
    with closing(Database(settings.database_url)) as database:
        database.create_schema()
        yield database


def _serve(settings: Settings, _: argparse.Namespace) -> None:
    from leaderboard.web.server import serve  # Slow to import, and no other command needs it.

    serve(settings)


def _score(settings: Settings, _: argparse.Namespace) -> None:
    """Score queued submissions until SIGTERM or SIGINT; then requeue the current job."""
    stop = threading.Event()
    for signal_number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(signal_number, lambda *_: stop.set())
    with _opened(settings) as database:
        url = without_password(settings.database_url)
        _LOG.info("waiting for submissions", database=url, version=software_version())
        process_queue(database, settings, stop)


def _token(settings: Settings, options: argparse.Namespace) -> None:
    with _opened(settings) as database:
        if options.revoke:
            revoke_token(database, options.name)
            return
        if options.replace:
            print(replace_token(database, options.name))
        else:
            print(create_token(database, options.name, baseline=options.baseline))
    print("The token is not shown again; only its hash is stored.", file=sys.stderr)


def _tokens(settings: Settings, _: argparse.Namespace) -> None:
    with _opened(settings) as database:
        tokens = list_tokens(database)
    rows = [(name, _time(created), _time(revoked), count, size) for name, created, revoked, count, size in tokens]
    _print_csv(["name", "created", "revoked", "submissions", "bytes"], rows)


def _submissions(settings: Settings, _: argparse.Namespace) -> None:
    query = (
        select(SubmissionModel, TokenModel.name)
        .join(TokenModel, TokenModel.id == SubmissionModel.token_id)
        .where(SubmissionModel.status != DELETED)
        .order_by(SubmissionModel.created_at)
    )
    with _opened(settings) as database, database.read() as session:
        rows = [
            (
                *(one.id, name, one.method, one.status, one.public, _time(one.created_at)),
                *(one.archive_bytes, _time(one.archive_deleted_at)),
            )
            for one, name in session.execute(query)
        ]
    head = ["id", "submitter", "method", "status", "public", "created", "bytes", "archive_deleted"]
    _print_csv(head, rows)


def _requeue(settings: Settings, options: argparse.Namespace) -> None:
    with _opened(settings) as database:
        archives = ArchiveStore(settings.archive_dir, database.board().board_id)
        archives.check()
        known = archive_rows(database)
        if missing := [name for name in options.ids if known.get(name) and not archives.file(name).is_file()]:
            raise StorageError(f"{archives.file(missing[0])}: is missing, expected the archive; restore it first")
        jobs.requeue(database, options.ids)
    print(f"{counted(len(set(options.ids)), 'submission')} queued")


def _remove(settings: Settings, options: argparse.Namespace) -> None:
    """Delete a submission, or its archive alone: the row first, so that the next ``serve`` ends what is killed."""
    with _opened(settings) as database:
        archives = ArchiveStore(settings.archive_dir, database.board().board_id)
        archives.check()
        record = submissions.find(database, options.id) if options.id.isascii() else None
        if record is None:
            raise InputError(f"there is no submission {options.id!r}")
        if not options.archive_only:
            submissions.remove(database, record.id)
        elif record.status in (QUEUED, SCORING):
            raise InputError(f"{record.id}: is {record.status}, so that its archive is needed; try again later")
        else:
            submissions.change(database, record.id, {"archive_deleted_at": time.time()})
    archives.delete(record.id)
    print(f"{record.id}: {'its archive is deleted' if options.archive_only else 'is deleted'}")


def _back_up(settings: Settings, options: argparse.Namespace) -> None:
    if sqlite_path(settings.database_url) is None:
        note = "only archives are copied; save the rows with pg_dump before, so that each has its archive"
        print(f"the database is PostgreSQL: {note}", file=sys.stderr)
    back_up(settings, options.target, options.prune)
    print(options.target)


def _check(settings: Settings, options: argparse.Namespace) -> None:
    """Print that all is well, and the archives that no submission needs; nothing is written or created.

    Raises ``StorageError`` with everything that is wrong, and ``InputError`` if only the dataset is.
    """
    of_dataset: list[str] = []
    try:
        folder = open_folder(settings.data)
        of_dataset += map(str, file_problems(folder))
    except InputError as error:
        of_dataset.append(str(error))
        folder = None
    with closing(Database(settings.database_url, read_only=True)) as database:
        database.check_schema()
        board = database.board()
        if folder is not None and board.dataset_digest not in (None, folder.digest):
            of_dataset.append(f"the digest is {folder.digest}, expected {board.dataset_digest}, which was served")
        problems = [*database.problems(), *queue_problems(database)]
        archives = ArchiveStore(settings.archive_dir, board.board_id)
        stored: set[str] = set()
        try:
            rows, stored = archive_rows(database), archives.ids()
            found = {
                name: archive_problem(archives.file(name), row, options.hash_archives)
                for name, row in rows.items()
                if row is not None
            }
            rows = archive_rows(database)  # Again, because archives may have been deleted meanwhile.
        except StorageError as error:
            problems.append(str(error))
        else:
            problems += [
                f"the archive of submission {name} {problem}"
                for name, problem in found.items()
                if problem and rows[name]
            ]
            for name in sorted(stored - {name for name, row in rows.items() if row is not None}):
                why = (
                    "was deleted; serve deletes the file at its start"
                    if name in rows
                    else "is not in the database"
                )
                print(f"note: {archives.file(name)}: its submission {why}", file=sys.stderr)
    for name, path in (("the state folder", settings.state_dir), ("the archives", settings.archive_dir)):
        problems += disk_problem(path, name) if path.is_dir() else []
    if problems or of_dataset:
        raise (StorageError if problems else InputError)(problem_summary([*problems, *of_dataset]))
    print(f"dataset, database, {counted(len(stored), 'archive')}, disk and queue are in order")


def _print_csv(head: Sequence[str], rows: Sequence[Sequence[Cell]]) -> None:
    print(csv_text([head, *rows]), end="")


def _time(seconds: float | None) -> str:
    return "" if seconds is None else datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


@dataclass(frozen=True)
class _Operation:
    """Command: its help, the settings that it accepts as options, and what runs it."""

    summary: str
    settings: tuple[str, ...]
    run: Callable[[Settings, argparse.Namespace], None]


_STORED = ("state_dir", "db")
_WITH_ARCHIVES = (*_STORED, "archives")
_SCORING = ("score_time", "score_memory", "lease_seconds")
COMMANDS = {
    "serve": _Operation("run the web server and its local scoring workers", tuple(Settings.model_fields), _serve),
    "score": _Operation(
        "run a scoring worker for a server that uses the same database and archive storage",
        ("data", *_WITH_ARCHIVES, *_SCORING),
        _score,
    ),
    "token": _Operation("create a token for a submitter and print it", _STORED, _token),
    "tokens": _Operation("list the tokens with their submissions and bytes as CSV", _STORED, _tokens),
    "submissions": _Operation("list the submissions of all tokens as CSV", _STORED, _submissions),
    "requeue": _Operation("score submissions again, failed ones too, without quota", _WITH_ARCHIVES, _requeue),
    "check": _Operation(
        "check dataset, database, archives, disk and queue, and print what is wrong; nothing is changed",
        ("data", *_WITH_ARCHIVES),
        _check,
    ),
    "remove": _Operation(
        "delete a submission of any owner with its archive and results, or its archive alone",
        _WITH_ARCHIVES,
        _remove,
    ),
    "backup": _Operation(
        "copy the database and the archives to a folder while the service is running", _WITH_ARCHIVES, _back_up
    ),
}
"""Commands by name. All settings can also be set in a TOML file or the environment."""


# Structured logging on standard error: one JSON object per line, or readable lines on a terminal.


def set_up_logs() -> None:
    """Configure logging of this process: structlog, library loggers, warnings and uncaught exceptions."""
    renderer: Processor = (
        structlog.dev.ConsoleRenderer()
        if sys.stderr.isatty()
        else structlog.processors.JSONRenderer(sort_keys=True)
    )
    common: list[Processor] = [
        structlog.processors.add_log_level,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
        structlog.processors.format_exc_info,
    ]
    structlog.configure(
        processors=[*common, renderer],
        # Each line is a single write, because other processes write to the same stream.
        logger_factory=structlog.WriteLoggerFactory(sys.stderr),
        cache_logger_on_first_use=True,
    )
    handler = logging.StreamHandler(sys.stderr)
    handler.setLevel(logging.WARNING)
    remove_meta = structlog.stdlib.ProcessorFormatter.remove_processors_meta
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=[structlog.stdlib.add_logger_name, *common], processors=[remove_meta, renderer]
        )
    )
    logging.basicConfig(handlers=[handler], level=logging.WARNING, force=True)
    logging.captureWarnings(True)
    sys.excepthook = _log_uncaught_exception


def _log_uncaught_exception(
    error_type: type[BaseException], error: BaseException, traceback: TracebackType | None
) -> None:
    structlog.get_logger("process").critical("uncaught exception", exc_info=(error_type, error, traceback))
