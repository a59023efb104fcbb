"""``rebar-leaderboard``: serve, score, token, remove, backup."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from leaderboard.db import submissions
from leaderboard.db.engine import Database
from leaderboard.db.tokens import create_token, replace_token
from leaderboard.log_setup import set_up_logs
from leaderboard.settings import Settings, read_settings
from leaderboard.storage.archive_store import Archives
from leaderboard.storage.backup import back_up
from rebar_depth_bench.cli.console import run_command
from rebar_depth_bench.errors import InputError
from rebar_depth_bench.version import software_version

GROUPS: dict[str, tuple[str, ...]] = {
    "serve": tuple(Settings.model_fields),
    "score": ("data", "state", "db", "archives", "cluster", "score_time", "score_memory", "lease", "error_maps"),
    "token": ("state", "db"),
    "remove": ("state", "db", "archives"),
    "backup": ("state", "db", "archives"),
}
"""Which settings each command takes; all may also stand in a file or the environment."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; return the exit status: 0 done, 2 the input is at fault, 1 anything else."""
    options = argument_parser().parse_args(arguments)
    return run_command(lambda: _run(options), interrupted="stopped")


def _run(options: argparse.Namespace) -> None:
    taken = GROUPS[options.command]
    given: dict[str, Any] = {name: value for name in taken if (value := getattr(options, name, None)) is not None}
    if "data" not in taken:
        given["data"] = ""
    settings = read_settings(options.settings, given)
    set_up_logs()
    _make_state(settings.state)
    if options.command == "serve":
        from leaderboard.web.server import serve

        serve(settings)
    elif options.command == "score":
        from leaderboard.scoring.__main__ import run_scorer

        run_scorer(settings)
    elif options.command == "token":
        database = Database(settings.database_url)
        database.migrate()
        make = replace_token if options.replace else create_token
        print(make(database, options.name))
        print("It is shown this once; only its hash is kept.", file=sys.stderr)
    elif options.command == "remove":
        _remove(settings, options.id)
    else:
        print(back_up(settings, options.target))


def _remove(settings: Settings, submission_id: str) -> None:
    database = Database(settings.database_url)
    database.migrate()
    if submissions.find(database, submission_id) is None:
        raise InputError(f"there is no submission {submission_id!r}")
    submissions.remove(database, submission_id)
    Archives(settings.archives_url).delete(submission_id)


def _make_state(folder: Path) -> None:
    """Make the state folder, for nobody else to read: ids in it are keys of submissions that are not public."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: files cannot be kept there: {error.strerror}") from None


def argument_parser() -> argparse.ArgumentParser:
    """Return the parser of every command."""
    parser = argparse.ArgumentParser(
        "rebar-leaderboard",
        description="A leaderboard that scores archives exactly as rebar-bench does.",
        epilog="Every setting may also be given as REBAR_LEADERBOARD_NAME in the environment, or as name = value "
        "in a TOML file (--settings); the command line wins over the file, the file over the environment.",
    )
    parser.add_argument("--version", action="version", version=software_version())
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, words in _COMMANDS.items():
        command = commands.add_parser(name, help=words, description=words)
        command.add_argument("--settings", type=Path, metavar="FILE", help="a TOML file of settings")
        for setting in GROUPS[name]:
            _add_setting(command, setting)
        if name == "token":
            command.add_argument("name", metavar="NAME", help="whose it is; shown on the board")
            command.add_argument("--replace", action="store_true", help="void the token that NAME has")
        if name == "remove":
            command.add_argument("id", metavar="ID", help="the submission, as its address has it")
        if name == "backup":
            command.add_argument("target", type=Path, metavar="FOLDER", help="a folder to write the backup into")
    return parser


_COMMANDS = {
    "serve": "serve the board, and score what is uploaded",
    "score": "score what is uploaded to a server that shares the database and the archives",
    "token": "make a token for a submitter and print it",
    "remove": "delete a submission, whoever made it, with its archive and results",
    "backup": "copy database and archives into a folder while the service runs",
}


def _add_setting(command: argparse.ArgumentParser, name: str) -> None:
    field = Settings.model_fields[name]
    shown = "" if field.is_required() or field.default == "" else f" (default: {field.default})"
    command.add_argument(
        f"--{name.replace('_', '-')}", metavar=name.upper(), help=f"{field.description}{shown}".replace("%", "%%")
    )


if __name__ == "__main__":
    sys.exit(main())
