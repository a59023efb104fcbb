"""The ``rebar-bench submit`` command."""

from __future__ import annotations

import argparse
import getpass
import os
import sys
from pathlib import Path

from rich.console import Console

from rebar_depth_bench.base.errors import InputError, printable
from rebar_depth_bench.base.reading import decode_text
from rebar_depth_bench.base.terminal import ProgressBars, print_notice
from rebar_depth_bench.base.writing import write_output
from rebar_depth_bench.cli.console import InputFile, add_archive, add_output_file, add_seconds, prints_table
from rebar_depth_bench.remote.leaderboard_client import WAIT_S, LeaderboardClient
from rebar_depth_bench.reporting.tables import print_table

TOKEN_VARIABLE = "REBAR_LEADERBOARD_TOKEN"
"""Environment variable that holds the token."""
_MAX_TOKEN_BYTES = 10_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_archive(parser)
    parser.add_argument("--url", required=True, help="URL of the leaderboard")
    parser.add_argument(
        "--token-file",
        type=InputFile,
        metavar="FILE",
        help=f"file with the token (default: the environment variable {TOKEN_VARIABLE}, or a prompt)",
    )
    waiting = parser.add_mutually_exclusive_group()
    waiting.add_argument("--no-wait", action="store_true", help="do not wait until the submission is scored")
    add_seconds(waiting, "--wait", WAIT_S, "time limit on waiting until the submission is scored")
    add_output_file(parser, "--json", "write the result as JSON")


def run(options: argparse.Namespace) -> None:
    """Upload an archive, wait until it is scored and print its table."""
    if options.no_wait and options.json:
        raise InputError(
            "--no-wait and --json are both given, expected at most one: without waiting there is no result"
        )
    leaderboard = LeaderboardClient(options.url, read_token(options.token_file))
    with ProgressBars() as bars:
        accepted = leaderboard.submit(Path(options.archive), bars.update)
        print_notice(accepted.url)
        if options.no_wait:
            print(accepted.id)
            return
        try:
            submission = leaderboard.wait(accepted, bars.update, options.wait)
        except KeyboardInterrupt:
            print_notice("the submission is accepted and will be scored; its URL is printed above")
            raise
        if submission.status == "failed":
            reason = submission.reason or "the service gives no reason"
            raise InputError(f"{options.archive}: scoring failed: {reason}")
        if submission.outdated:
            print_notice(f"warning: the result is outdated: {printable(submission.outdated, 1000)}")
        result, result_json = leaderboard.result(accepted)
    if options.json:
        write_output(options.json, result_json)
    if prints_table(options):
        print_table(result, Console())


def read_token(file: str | None) -> str:
    """Return the token from ``file``, the environment or a prompt.

    It is never a command-line argument, which other users of the machine could read. Raises ``InputError`` if
    there is no token or ``file`` cannot be read.
    """
    if file is not None:
        try:
            with Path(file).open("rb") as stream:  # It may be a pipe of the user's own.
                text, problems = decode_text(stream.read(_MAX_TOKEN_BYTES))
        except (OSError, ValueError) as error:
            raise InputError(f"{file}: cannot be read: {error}") from None
        if problems:
            raise InputError.from_problems(file, problems)
        token = text.strip()
        if not token or not token.isprintable():
            found = "has characters that are not printable" if token else "is empty"
            raise InputError(f"{file}: {found}, expected a token on one line")
        return token
    token = os.environ.get(TOKEN_VARIABLE) or (getpass.getpass("token: ") if sys.stdin.isatty() else "")
    if not token:
        raise InputError(f"no token: set {TOKEN_VARIABLE}, or give --token-file FILE")
    return token.strip()
