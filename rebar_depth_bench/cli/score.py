"""The ``rebar-bench score`` command."""

from __future__ import annotations

import argparse

from rich.console import Console

from rebar_depth_bench.base.errors import InputError, escape_text
from rebar_depth_bench.base.terminal import ProgressBars, print_notice
from rebar_depth_bench.base.writing import write_output
from rebar_depth_bench.cli.console import (
    add_archive,
    add_output_file,
    add_scored_data,
    add_workers,
    print_verified,
    prints_table,
)
from rebar_depth_bench.reporting.tables import print_table
from rebar_depth_bench.scorer import VIEWS_SHOWN, score
from rebar_depth_bench.scoring.spreadsheet import tables_sheet


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_archive(parser)
    add_scored_data(parser)
    add_output_file(parser, "--json", "write the result as JSON")
    add_output_file(parser, "--html", "write a self-contained report")
    parser.add_argument(
        "--html-views",
        type=int,
        default=VIEWS_SHOWN,
        metavar="N",
        help="views per config shown as images (default: %(default)s)",
    )
    add_output_file(parser, "--csv", "write the tables as CSV")
    add_output_file(parser, "--groups-csv", "write the tables of groups of views, of configs with splits, as CSV")
    parser.add_argument(
        "--extended",
        action="store_true",
        help="also compute boundary, point cloud and disparity measures, and measures of bars and crossings",
    )
    parser.add_argument(
        "--family",
        metavar="NAME",
        help="print all measures of one family of the extended ones, which --extended names (implies --extended)",
    )
    add_output_file(parser, "--extended-csv", "write the extended measures as CSV (implies --extended)")
    add_output_file(parser, "--bars-csv", "write a row per judged bar and view as CSV (implies --extended)")
    add_workers(parser)


def run(options: argparse.Namespace) -> None:
    """Score an archive, write the requested files and print the tables."""
    if options.html_views < 0:
        raise InputError(f"--html-views is {options.html_views}, expected 0 or more")
    has_table = options.extended_csv or options.bars_csv
    is_extended = options.extended or has_table or options.family is not None
    if options.align and is_extended:
        raise InputError("--align and --extended are both given: extended measures need metric predictions")
    if options.family is not None:
        from rebar_depth_bench.extended.families import MEASURE_FAMILIES

        if options.family not in MEASURE_FAMILIES:
            found = f"--family is {escape_text(options.family)}"
            raise InputError(f"{found}, expected one of {', '.join(MEASURE_FAMILIES)}")
    with ProgressBars() as bars:
        result = score(
            options.archive,
            options.data,
            expect_digest=options.expect_digest,
            workers=options.workers,
            align=options.align,
            extended=bool(is_extended),
            progress=bars.update,
        )
    names = ", ".join(result.tables)
    print_verified(result.folder, f"views of {names} verified when their ground truth was stored in the cache")
    if options.html:
        result.to_html(options.html, views_shown=options.html_views)
    mistakes = result.mistakes
    if options.json:
        write_output(options.json, result.to_json())
    if options.csv:
        write_output(options.csv, tables_sheet([result]).to_csv())
    if options.groups_csv:
        write_output(options.groups_csv, tables_sheet([result], groups=True).to_csv())
    if options.extended_csv:
        from rebar_depth_bench.reporting.extended_tables import extended_csv

        write_output(options.extended_csv, extended_csv(result))
    if options.bars_csv and result.extended is not None:
        write_output(options.bars_csv, result.extended.to_samples_sheet("bars").to_csv())
    if prints_table(options):
        print_table(result, Console())
        if result.extended is not None:
            from rebar_depth_bench.reporting.extended_tables import print_extended

            print_extended(result.extended, Console(), options.family or "")
    for note in result.archive_notes:
        print_notice(note)
    for mistake in mistakes:
        print_notice(f"possible mistake: {mistake.text}")
