"""The ``rebar-bench`` command."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping, Sequence

from rebar_depth_bench.cli.console import Command, module_command, program_parser, run_program

_CLI = "rebar_depth_bench.cli"
COMMANDS: Mapping[str, Command] = {
    "score": module_command(f"{_CLI}.score", "score a submission archive, native and scaled"),
    "score-crossings": module_command(
        f"{_CLI}.score_crossings",
        "score detected crossings of bars: precision, recall, average precision, position",
    ),
    "compare": module_command(
        f"{_CLI}.table",
        "compute paired differences between submissions, with intervals",
        add="add_compare_arguments",
        run="run_compare",
    ),
    "table": module_command(
        f"{_CLI}.table", "print several submissions and the paper's rows in the layout of its Table I"
    ),
    "tasks": module_command(
        f"{_CLI}.tasks", "state at which distances methods can be used for which task on bars and crossings"
    ),
    "check": module_command(f"{_CLI}.check", "list all problems of a submission archive"),
    "verify": module_command(
        f"{_CLI}.check",
        "compare every file, view and digest of a dataset with its manifest",
        add="add_verify_arguments",
        run="run_verify",
    ),
    "methods": module_command(
        f"{_CLI}.predict",
        "list the available methods, or print one whole",
        add="add_methods_arguments",
        run="run_methods",
    ),
    "predict": module_command(f"{_CLI}.predict", "run a method on a dataset and write a submission archive"),
    "submit": module_command(
        f"{_CLI}.submit", "upload an archive to a leaderboard, wait for its score and print the table"
    ),
    "cache": module_command(f"{_CLI}.cache", "show or clear the cache of ground truth"),
    "demo": module_command(f"{_CLI}.demo", "predict, score and report a few views, rendered or of the package"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``rebar-bench`` and return its exit code."""
    os.environ.setdefault("HF_DATASETS_DISABLE_PROGRESS_BARS", "1")  # ``datasets`` reads it at import.
    words = sys.argv[1:] if arguments is None else arguments
    return run_program(argument_parser(words), words)


def argument_parser(words: Sequence[str] | None = None) -> argparse.ArgumentParser:
    """Return the argument parser of ``rebar-bench``, complete for the command in ``words``, or for all if None."""
    description = "Score metric depth on reinforcement against exact ground truth."
    return program_parser("rebar-bench", description, COMMANDS, words)
