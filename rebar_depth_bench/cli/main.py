"""The ``rebar-bench`` command."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import datasets

from rebar_depth_bench.cli import check, compare, demo, methods, predict, score, submit, table
from rebar_depth_bench.cli.arguments import check_outputs
from rebar_depth_bench.cli.console import run_command
from rebar_depth_bench.studies.registry import add_study_commands
from rebar_depth_bench.version import software_version


class Command(Protocol):
    """What a command's module has: one line, its arguments, and how it runs."""

    SUMMARY: str

    @property
    def add_arguments(self) -> Callable[[argparse.ArgumentParser], None]:
        """Add the command's arguments to its parser."""

    @property
    def run(self) -> Callable[[argparse.Namespace], None]:
        """Run the command: results to standard output, progress to standard error."""


COMMANDS: Mapping[str, Command] = {
    "score": score,
    "compare": compare,
    "table": table,
    "check": check,
    "methods": methods,
    "predict": predict,
    "submit": submit,
    "demo": demo,
}

_STUDY_SUMMARY = "the studies of the paper, on your own archives"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``rebar-bench``; return its exit status."""
    options = argument_parser().parse_args(arguments)
    datasets.disable_progress_bars()
    return run_command(lambda: _run(options), interrupted=getattr(options, "interrupted", "interrupted"))


def _run(options: argparse.Namespace) -> None:
    check_outputs(vars(options))
    options.run(options)


def argument_parser() -> argparse.ArgumentParser:
    """Return the command's argument parser."""
    parser = argparse.ArgumentParser(
        prog="rebar-bench",
        description="Score metric depth on reinforcement against exact ground truth.",
    )
    parser.add_argument("--version", action="version", version=software_version())
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, command in COMMANDS.items():
        own = commands.add_parser(name, help=command.SUMMARY, description=command.SUMMARY)
        command.add_arguments(own)
        own.set_defaults(run=command.run)
    add_study_commands(commands.add_parser("study", help=_STUDY_SUMMARY, description=_STUDY_SUMMARY))
    return parser
