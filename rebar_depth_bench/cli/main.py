"""The ``rebar-bench`` command."""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping, Sequence

from rebar_depth_bench.cli import (
    cache,
    check,
    compare,
    demo,
    methods,
    predict,
    push_results,
    score,
    score_crossings,
    submissions,
    submit,
    table,
    verify,
    view,
)
from rebar_depth_bench.console import Command, add_commands, run_command
from rebar_depth_bench.output_options import check_outputs
from rebar_depth_bench.studies.registry import STUDIES
from rebar_depth_bench.terminal import use_plain_characters
from rebar_depth_bench.version import software_version

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
    "submissions": submissions,
    "push-results": push_results,
    "cache": cache,
    "view": view,
    "demo": demo,
}

_STUDY_SUMMARY = "run a study of the paper on your own archives"


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
    commands = add_commands(parser, COMMANDS, "COMMAND")
    add_commands(commands.add_parser("study", help=_STUDY_SUMMARY, description=_STUDY_SUMMARY), STUDIES, "NAME")
    return parser
