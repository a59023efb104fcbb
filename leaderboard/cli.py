"""Command-line interface ``rebar-leaderboard``."""

from __future__ import annotations

import argparse
import stat
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from leaderboard.db import submissions
from leaderboard.db.engine import Database
from leaderboard.db.tokens import create_token, replace_token, revoke_token
from leaderboard.log_setup import set_up_logs
from leaderboard.operations import run_operation
from leaderboard.settings import RENAMED_SETTINGS, Settings, read_settings
from leaderboard.storage.archive_store import ArchiveStore
from leaderboard.storage.backup import back_up
from rebar_depth_bench.atomic_io import write_error
from rebar_depth_bench.console import replace_renamed_options, run_command
from rebar_depth_bench.errors import InputError
from rebar_depth_bench.terminal import use_plain_characters
from rebar_depth_bench.version import software_version

COMMAND_SETTINGS: dict[str, tuple[str, ...]] = {
    "serve": tuple(Settings.model_fields),
    "score": (
        "data",
        "state_dir",
        "db",
        "archives",
        "score_time",
        "score_memory",
        "lease_seconds",
        "error_maps",
        "hidden_truth",
    ),
    "token": ("state_dir", "db"),
    "tokens": ("state_dir", "db"),
    "submissions": ("state_dir", "db"),
    "remove": ("state_dir", "db", "archives"),
    "prune": ("data", "state_dir", "db", "archives", "archive_days", "archive_ranks"),
    "check": ("data", "state_dir", "db", "archives"),
    "backup": ("state_dir", "db", "archives"),
}
"""Settings that each command accepts as options; all can also be set in a TOML file or the environment."""

RENAMED_OPTIONS = {f"--{old}": f"--{new.replace('_', '-')}" for old, new in RENAMED_SETTINGS.items()}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return the exit status: 0 = success, 2 = invalid input, 1 = any other error."""
    use_plain_characters()
    options = argument_parser().parse_args(replace_renamed_options(arguments, RENAMED_OPTIONS))
    return run_command(lambda: _run(options), interrupted="stopped")


def _run(options: argparse.Namespace) -> None:
    setting_names = COMMAND_SETTINGS[options.command]
    overrides: dict[str, Any] = {
        name: value for name in setting_names if (value := getattr(options, name, None)) is not None
    }
    if "data" not in setting_names:
        overrides["data"] = ""
    settings = read_settings(options.settings, overrides)
    set_up_logs()
    _make_state_dir(settings.state_dir)
    if options.command == "serve":
        from leaderboard.web.server import serve

        serve(settings)
    elif options.command == "score":
        from leaderboard.scoring.__main__ import run_worker

        run_worker(settings, migrate=True)
    elif options.command == "token":
        database = Database(settings.database_url)
        database.migrate()
        if options.revoke:
            revoke_token(database, options.name)
            return
        make_token = replace_token if options.replace else create_token
        print(make_token(database, options.name))
        print("The token is not shown again; only its hash is stored.", file=sys.stderr)
    elif options.command == "remove":
        _remove(settings, options.id)
    elif options.command == "backup":
        print(back_up(settings, options.target))
    else:
        run_operation(options.command, settings, dry_run=getattr(options, "dry_run", False))


def _remove(settings: Settings, submission_id: str) -> None:
    database = Database(settings.database_url)
    database.migrate()
    if submissions.find(database, submission_id) is None:
        raise InputError(f"there is no submission {submission_id!r}")
    submissions.remove(database, submission_id)
    ArchiveStore(settings.archive_dir).delete(submission_id)


def _make_state_dir(folder: Path) -> None:
    """Create the state folder with mode 0700, because the ids in it give access to unpublished submissions.

    Raises ``InputError`` if others may read an existing folder, and ``InputError`` or ``OutputError`` if it cannot
    be created.
    """
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        mode = stat.S_IMODE(folder.stat().st_mode)
    except OSError as error:
        raise write_error(f"the state folder {folder}", error) from None
    if mode & 0o077:
        raise InputError(f"the state folder {folder}: has mode {mode:04o}, expected 0700; run: chmod 700 {folder}")


def argument_parser() -> argparse.ArgumentParser:
    """Return the argument parser with all commands."""
    parser = argparse.ArgumentParser(
        "rebar-leaderboard",
        description="Leaderboard server that scores prediction archives exactly as rebar-bench does.",
        epilog="Each setting can also be given as the environment variable REBAR_LEADERBOARD_NAME or as "
        "name = value in a TOML file (--settings). The command line takes precedence over the file, and the file "
        "over the environment.",
    )
    parser.add_argument("--version", action="version", version=software_version())
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, help_text in _COMMAND_HELP.items():
        command = commands.add_parser(name, help=help_text, description=help_text)
        command.add_argument("--settings", type=Path, metavar="FILE", help="TOML file with settings")
        for setting in COMMAND_SETTINGS[name]:
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
        if name == "backup":
            command.add_argument("target", type=Path, metavar="FOLDER", help="folder to write the backup to")
    return parser


_COMMAND_HELP = {
    "serve": "run the web server and its local scoring workers",
    "score": "run a scoring worker for a server that uses the same database and archive storage",
    "token": "create a token for a submitter and print it",
    "tokens": "list the tokens with their submissions and bytes as CSV",
    "submissions": "list the submissions of all tokens as CSV",
    "prune": "delete archives of ended submissions by age and rank, as the settings say",
    "check": "check dataset, database, archives, disk and queue, and print what is wrong",
    "remove": "delete a submission of any owner, with its archive and results",
    "backup": "copy the database and the archives to a folder while the service is running",
}


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
