"""The commands of several submissions: ``rebar-bench table``, as in the paper, and ``rebar-bench compare``."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence

from rich.console import Console

from rebar_depth_bench.base.errors import InputError, printable
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
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.reporting.figure import check_figure, write_figure
from rebar_depth_bench.reporting.latex import latex_table
from rebar_depth_bench.reporting.tables import disambiguate_method_names, print_comparison, print_paper_table
from rebar_depth_bench.scoring.comparison import check_same_kinds, check_same_splits, compare
from rebar_depth_bench.scoring.spreadsheet import differences_sheet, tables_sheet
from rebar_depth_bench.scoring.truth import paper_differences
from rebar_depth_bench.submission.declaration import METRIC


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    archives = "submission archives (zip), one table row per archive"
    parser.add_argument("archives", type=InputFile, metavar="ARCHIVE", nargs="+", help=archives)
    add_scored_data(parser)
    add_output_file(parser, "--latex", "write the table as LaTeX (booktabs)")
    add_output_file(parser, "--csv", "write all tables as CSV")
    add_output_file(parser, "--figure", "draw native against scaled AbsRel of all configs (.svg, .png or .pdf)")
    parser.add_argument("--intervals", action="store_true", help="include the 95 %% intervals in the LaTeX table")
    parser.add_argument("--no-published", action="store_true", help="omit the paper's own rows and points")
    add_workers(parser)


def run(options: argparse.Namespace) -> None:
    """Score all archives, write the requested files and print the table."""
    if options.figure:
        check_figure(options.figure)
    results = score_archives(options.archives, options, _check_figure_kinds if options.figure else lambda _: None)
    check_same_splits(results)
    results = disambiguate_method_names(results)
    published = not options.no_published
    absent = []
    if published and not any(table.published for result in results for table in result.tables.values()):
        configs = open_folder(options.data).config_by_name
        names = dict.fromkeys(name for result in results for name in result.tables)
        absent = [f"{printable(name)} ({', '.join(paper_differences(configs[name]))})" for name in names]
    if options.latex:
        latex = latex_table(results, published=published, intervals=options.intervals, absent=absent)
        write_output(options.latex, latex)
    if options.csv:
        write_output(options.csv, tables_sheet(results).to_csv())
    if options.figure:
        for note in write_figure(results, options.figure, published=published):
            print_notice(note)
    if prints_table(options):
        print_paper_table(results, Console(), published=published, absent=absent)


def _check_figure_kinds(kinds: Sequence[tuple[str, str]]) -> None:
    for method, kind in kinds:
        if kind != METRIC:
            found = f"{method} has predictions of the kind {kind}"
            raise InputError(f"--figure: {found}, expected metric ones: the figure shows native errors")


def add_compare_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``compare``."""
    parser.add_argument("first", type=InputFile, metavar="A", help="the archive that the others are compared with")
    parser.add_argument("others", type=InputFile, metavar="B", nargs="+", help="one or more archives")
    add_scored_data(parser)
    add_output_file(parser, "--json", "write the differences as JSON")
    add_output_file(parser, "--csv", "write the differences as CSV")
    add_workers(parser)


def run_compare(options: argparse.Namespace) -> None:
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
        write_output(options.csv, differences_sheet(content).to_csv())
    for comparison in comparisons if prints_table(options) else ():
        print_comparison(comparison, Console())
