"""The ``rebar-bench`` command."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping, Sequence

from rebar_depth_bench import software_version
from rebar_depth_bench.console import Command, add_commands, check_outputs, run_command
from rebar_depth_bench.terminal import use_plain_characters

_CLI = "rebar_depth_bench.cli"
COMMANDS: Mapping[str, Command] = {
    "score": Command(f"{_CLI}.score", "score a submission archive, native and scaled"),
    "score-crossings": Command(
        f"{_CLI}.score_crossings",
        "score detected crossings of bars: precision, recall, average precision, position",
    ),
    "compare": Command(f"{_CLI}.compare", "compute paired differences between submissions, with intervals"),
    "table": Command(
        f"{_CLI}.table", "print several submissions and the paper's rows in the layout of its Table I"
    ),
    "check": Command(f"{_CLI}.check", "list all problems of a submission archive"),
    "verify": Command(f"{_CLI}.verify", "compare every file, view and digest of a dataset with its manifest"),
    "methods": Command(f"{_CLI}.methods", "list the available methods"),
    "predict": Command(f"{_CLI}.predict", "run a method on a dataset and write a submission archive"),
    "submit": Command(
        f"{_CLI}.submit", "upload an archive to a leaderboard, wait for its score and print the table"
    ),
    "cache": Command(f"{_CLI}.cache", "show or clear the cache of ground truth"),
    "demo": Command(f"{_CLI}.demo", "render a small lattice dataset, predict, score and report"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``rebar-bench`` and return its exit code."""
    use_plain_characters()
    words = sys.argv[1:] if arguments is None else arguments
    options = argument_parser(words).parse_args(words)
    os.environ.setdefault("HF_DATASETS_DISABLE_PROGRESS_BARS", "1")  # ``datasets`` reads it at import.
    return run_command(lambda: _run(options), interrupted=getattr(options, "interrupted", "interrupted"))


def _run(options: argparse.Namespace) -> None:
    check_outputs(vars(options))
    options.run(options)


def argument_parser(words: Sequence[str] | None = None) -> argparse.ArgumentParser:
    """Return the argument parser of ``rebar-bench``, complete for the command in ``words``, or for all if None."""
    parser = argparse.ArgumentParser(
        prog="rebar-bench",
        description="Score metric depth on reinforcement against exact ground truth.",
    )
    parser.add_argument("--version", action="version", version=software_version())
    add_commands(parser.add_subparsers(required=True, metavar="COMMAND"), COMMANDS, words)
    return parser
