"""``rebar-bench submit``."""

from __future__ import annotations

import argparse
import getpass
import os
import sys
from pathlib import Path

from rich.console import Console

from rebar_depth_bench.atomic_io import write_bytes
from rebar_depth_bench.cli.arguments import add_archive, add_file
from rebar_depth_bench.cli.console import ProgressBars
from rebar_depth_bench.errors import InputError
from rebar_depth_bench.leaderboard_client import Leaderboard
from rebar_depth_bench.reporting.tables import print_table
from rebar_depth_bench.scoring.result_io import read_result

SUMMARY = "upload an archive to a leaderboard, wait, print its table"
TOKEN = "REBAR_LEADERBOARD_TOKEN"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_archive(parser)
    parser.add_argument("--url", required=True, help="the leaderboard's address")
    parser.add_argument(
        "--token-file",
        type=Path,
        metavar="FILE",
        help=f"a file with the token (default: {TOKEN}, or it is asked for)",
    )
    parser.add_argument("--no-wait", action="store_true", help="do not wait until it is scored")
    add_file(parser, "--json", "write the result as JSON")


def run(options: argparse.Namespace) -> None:
    """Upload, wait, print."""
    if options.no_wait and options.json:
        raise InputError("--no-wait and --json: there is no result yet, expected one of the two")
    with Leaderboard(options.url, _token(options.token_file)) as leaderboard, ProgressBars() as bars:
        accepted = leaderboard.submit(Path(options.archive), bars.update)
        print(accepted["url"], file=sys.stderr, flush=True)
        if options.no_wait:
            print(accepted["id"])
            return
        try:
            found = leaderboard.wait(accepted["id"], bars.update)
        except KeyboardInterrupt:
            print("it is accepted and goes on without you; its address is above", file=sys.stderr)
            raise
        if found["status"] == "failed":
            raise InputError(f"{options.archive}: scoring failed: {found['reason']}")
        result = leaderboard.result(accepted["id"])
    if options.json:
        write_bytes(options.json, result)
    print_table(read_result(result, options.url), Console())


def _token(file: Path | None) -> str:
    """Return the token: never from the command line, where others on the machine would see it."""
    if file is not None:
        try:
            return file.read_text(encoding="utf-8").strip()
        except (OSError, ValueError) as error:
            raise InputError(f"{file}: cannot be read: {error}") from None
    found = os.environ.get(TOKEN) or (getpass.getpass("token: ") if sys.stdin.isatty() else "")
    if not found:
        raise InputError(f"no token: set {TOKEN}, or give --token-file FILE")
    return found.strip()
