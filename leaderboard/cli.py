"""Command-line interface ``rebar-leaderboard``."""

from __future__ import annotations

import argparse
import stat
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from leaderboard.db.engine import database_errors, sqlite_path
from leaderboard.log_setup import set_up_logs
from leaderboard.settings import Settings, read_settings
from leaderboard.storage.archive_store import make_folder, state_lock
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.cli.console import Command, program_parser, run_program

_STORED = ("state_dir", "db")
_WITH_ARCHIVES = (*_STORED, "archives")
_SCORING = ("score_time", "score_memory", "lease_seconds", "error_maps", "hidden_truth")
COMMANDS: dict[str, tuple[str, tuple[str, ...]]] = {
    "serve": ("run the web server and its local scoring workers", tuple(Settings.model_fields)),
    "score": (
        "run a scoring worker for a server that uses the same database and archive storage",
        ("data", *_WITH_ARCHIVES, *_SCORING),
    ),
    "token": ("create a token for a submitter and print it", _STORED),
    "tokens": ("list the tokens with their submissions and bytes as CSV", _STORED),
    "submissions": ("list the submissions of all tokens as CSV", _STORED),
    "prune": (
        "delete archives of ended submissions by age and rank, as the settings say, or those without a submission",
        ("data", *_WITH_ARCHIVES, "archive_days", "archive_ranks"),
    ),
    "check": (
        "check dataset, database, archives, disk and queue, and print what is wrong; nothing is changed",
        ("data", *_WITH_ARCHIVES),
    ),
    "remove": ("delete a submission of any owner, with its archive and results", _WITH_ARCHIVES),
    "backup": ("copy the database and the archives to a folder while the service is running", _WITH_ARCHIVES),
}
"""Help texts of the commands, and the settings that each accepts as options.

All settings can also be set in a TOML file or the environment.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return the exit status: 0 = success, 2 = invalid input, 1 = any other error."""
    return run_program(argument_parser(), arguments)


def _run(options: argparse.Namespace) -> None:
    _, names = COMMANDS[options.command]
    values = {name: getattr(options, name, None) for name in names}
    overrides: dict[str, Any] = {name: value for name, value in values.items() if value is not None}
    needs_data = "data" in names and not getattr(options, "orphans", False)
    settings = read_settings(options.settings, overrides if needs_data else {**overrides, "data": ""})
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
        if options.command == "serve":
            from leaderboard.web.server import serve

            serve(settings)
        else:
            from leaderboard.operations import run_operation

            run_operation(options.command, settings, options)


def _make_state_dir(folder: Path) -> None:
    """Create the state folder with mode 0700, because the ids in it give access to unpublished submissions.

    Raises ``InputError`` if others may read an existing folder, and the errors of ``make_folder``.
    """
    make_folder(folder, "the state folder")
    mode = stat.S_IMODE(folder.stat().st_mode)
    if mode & 0o077:
        raise InputError(f"the state folder {folder}: has mode {mode:04o}, expected 0700; run: chmod 700 {folder}")


def argument_parser() -> argparse.ArgumentParser:
    """Return the argument parser with all commands."""
    parser = program_parser(
        "rebar-leaderboard",
        "Leaderboard server that scores prediction archives exactly as rebar-bench does.",
        {name: Command(summary, partial(_add_arguments, name), _run) for name, (summary, _) in COMMANDS.items()},
        epilog="Each setting can also be given as the environment variable REBAR_LEADERBOARD_NAME or as "
        "name = value in a TOML file (--settings). The command line takes precedence over the file, and the file "
        "over the environment.",
    )
    parser.set_defaults(interrupted="stopped")
    return parser


def _add_arguments(name: str, command: argparse.ArgumentParser) -> None:
    command.set_defaults(command=name)
    command.add_argument("--settings", type=Path, metavar="FILE", help="TOML file with settings")
    for setting in COMMANDS[name][1]:
        _add_setting(command, setting)
    if name == "token":
        command.add_argument("name", metavar="NAME", help="name of the submitter, shown on the leaderboard")
        change = command.add_mutually_exclusive_group()
        change.add_argument("--replace", action="store_true", help="revoke the existing token of NAME")
        change.add_argument("--revoke", action="store_true", help="only revoke the existing token of NAME")
    if name == "remove":
        command.add_argument("id", metavar="ID", help="id of the submission, the last part of its URL")
    if name == "prune":
        command.add_argument("--dry-run", action="store_true", help="print the ids, but delete nothing")
        command.add_argument("--orphans", action="store_true", help="delete the archives without a submission")
    if name == "check":
        command.add_argument("--hash-archives", action="store_true", help="read all archives, too")
    if name == "backup":
        command.add_argument("target", type=Path, metavar="FOLDER", help="folder to write the backup to")
        command.add_argument("--prune", action="store_true", help="delete what is removed or pruned from it")


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
