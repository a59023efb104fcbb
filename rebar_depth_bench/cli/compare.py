"""The ``rebar-bench compare`` command."""

from __future__ import annotations

import argparse
import json

from rich.console import Console

from rebar_depth_bench.base.terminal import print_notice
from rebar_depth_bench.base.writing import write_output
from rebar_depth_bench.cli.console import (
    InputFile,
    add_output_file,
    add_scored_data,
    add_workers,
    prints_table,
    score_archives,
)
from rebar_depth_bench.reporting.tables import print_comparison
from rebar_depth_bench.scoring.comparison import check_same_kinds, compare
from rebar_depth_bench.scoring.frames import differences_frame, frame_csv


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("first", type=InputFile, metavar="A", help="the archive that the others are compared with")
    parser.add_argument("others", type=InputFile, metavar="B", nargs="+", help="one or more archives")
    add_scored_data(parser)
    add_output_file(parser, "--json", "write the differences as JSON")
    add_output_file(parser, "--csv", "write the differences as CSV")
    add_workers(parser)


def run(options: argparse.Namespace) -> None:
    """Score all archives, compare each with the first, and write and print the differences."""
    first, *others = score_archives([options.first, *options.others], options, check_same_kinds)
    comparisons = [compare(first, other) for other in others]
    for other, comparison in zip(others, comparisons, strict=True):
        if names := [name for name in {**first.tables, **other.tables} if name not in comparison.configs]:
            print_notice(f"only in one of {first.method} and {other.method}, not compared: {', '.join(names)}")
    content = [comparison.to_dict() for comparison in comparisons]
    if options.json:
        write_output(options.json, json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
    if options.csv:
        write_output(options.csv, frame_csv(differences_frame(content)))
    for comparison in comparisons if prints_table(options) else ():
        print_comparison(comparison, Console())
