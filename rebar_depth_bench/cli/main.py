"""The ``rebar-bench`` command."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

from rebar_depth_bench import software_version
from rebar_depth_bench.cli import (
    cache,
    check,
    compare,
    demo,
    methods,
    predict,
    score,
    score_crossings,
    submit,
    table,
    verify,
)
from rebar_depth_bench.console import run_command
from rebar_depth_bench.output_options import check_outputs
from rebar_depth_bench.terminal import use_plain_characters


class Command(Protocol):
    """Interface of the module of a command: one-line summary, arguments and entry point."""

    SUMMARY: str

    @property
    def add_arguments(self) -> Callable[[argparse.ArgumentParser], None]:
        """Function that adds the command's arguments to its parser."""

    @property
    def run(self) -> Callable[[argparse.Namespace], None]:
        """Function that runs the command: results to standard output, progress to standard error.

        Raises ``RebarDepthError``.
        """


COMMANDS: Mapping[str, Command] = {
    "score": score,
    "score-crossings": score_crossings,
    "compare": compare,
    "table": table,
    "check": check,
    "verify": verify,
    "methods": methods,
    "predict": predict,
    "submit": submit,
    "cache": cache,
    "demo": demo,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``rebar-bench`` and return its exit code."""
    use_plain_characters()
    options = argument_parser().parse_args(arguments)
    os.environ.setdefault("HF_DATASETS_DISABLE_PROGRESS_BARS", "1")  # ``datasets`` reads it at import.
    return run_command(lambda: _run(options), interrupted=getattr(options, "interrupted", "interrupted"))


def _run(options: argparse.Namespace) -> None:
    check_outputs(vars(options))
    options.run(options)


def argument_parser() -> argparse.ArgumentParser:
    """Return the argument parser of ``rebar-bench``."""
    parser = argparse.ArgumentParser(
        prog="rebar-bench",
        description="Score metric depth on reinforcement against exact ground truth.",
    )
    parser.add_argument("--version", action="version", version=software_version())
    subparsers = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, command in COMMANDS.items():
        subparser = subparsers.add_parser(name, help=command.SUMMARY, description=command.SUMMARY)
        command.add_arguments(subparser)
        subparser.set_defaults(run=command.run)
    return parser
