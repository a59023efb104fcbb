"""The ``rebar-bench tasks`` command: at which distances methods can be used for which task."""

from __future__ import annotations

import argparse
import json

from rich.console import Console

from rebar_depth_bench.base.writing import write_output
from rebar_depth_bench.cli.console import (
    InputFile,
    add_data,
    add_expect_digest,
    add_output_file,
    add_workers,
    prints_table,
    score_archives,
)
from rebar_depth_bench.reporting.tables import disambiguate_method_names
from rebar_depth_bench.reporting.tasks import print_tasks, render_tasks, tasks_dict, tasks_sheet
from rebar_depth_bench.scoring.comparison import check_same_splits


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    archives = "submission archives (zip) with metric depth"
    parser.add_argument("archives", type=InputFile, metavar="ARCHIVE", nargs="+", help=archives)
    add_data(parser)
    add_expect_digest(parser)
    add_output_file(parser, "--json", "write the working ranges as JSON")
    add_output_file(parser, "--csv", "write the working ranges as CSV, one row per bin")
    add_output_file(parser, "--html", "write a self-contained sheet of sentences, charts and tables")
    add_workers(parser)


def run(options: argparse.Namespace) -> None:
    """Score all archives with extended measures, write the requested files and print the working ranges."""
    results = score_archives(options.archives, options, extended=True)
    check_same_splits(results)
    results = disambiguate_method_names(results)
    if options.html:
        write_output(options.html, render_tasks(results))
    if options.json:
        content = json.dumps(tasks_dict(results), indent=1, ensure_ascii=False, allow_nan=False)
        write_output(options.json, content + "\n")
    if options.csv:
        write_output(options.csv, tasks_sheet(results).to_csv())
    if prints_table(options):
        print_tasks(results, Console())
