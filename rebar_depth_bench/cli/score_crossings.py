"""The ``rebar-bench score-crossings`` command."""

from __future__ import annotations

import argparse
import math

from rich.console import Console

from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.base.terminal import ProgressBars, print_notice
from rebar_depth_bench.base.writing import write_output
from rebar_depth_bench.cli.console import (
    InputFile,
    add_data,
    add_names,
    add_output_file,
    add_workers,
    prints_table,
)
from rebar_depth_bench.detections.crossing_scorer import score_crossings
from rebar_depth_bench.reporting.detections import detection_page, print_page, render_page
from rebar_depth_bench.submission import INPUTS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        "detections",
        type=InputFile,
        metavar="FILE",
        help="CSV or Parquet file: view_id; x, y, z or world_x, world_y, world_z; nx, ny, nz, confidence",
    )
    add_data(parser)
    add_names(parser, "--config", "configs that were searched (default: those of the rows)")
    parser.add_argument(
        "--confidence", type=float, metavar="C", help="match only detections of at least C (default: all)"
    )
    parser.add_argument("--method", metavar="NAME", help="name of the method (default: of the file)")
    parser.add_argument("--inputs", choices=INPUTS, help="what the method reads (default: as the file declares)")
    parser.add_argument(
        "--uses-ground-truth",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="whether the method reads ground truth of the scored config",
    )
    add_output_file(parser, "--json", "write the result as JSON")
    add_output_file(parser, "--html", "write a self-contained report")
    add_workers(parser)


def run(options: argparse.Namespace) -> None:
    """Score a file of detections, write the requested files and print the tables."""
    if options.confidence is not None and not math.isfinite(options.confidence):
        raise InputError(f"--confidence is {options.confidence}, expected a finite number")
    declared = {name: getattr(options, name) for name in ("method", "inputs", "uses_ground_truth")}
    with ProgressBars() as bars:
        result = score_crossings(
            options.detections,
            options.data,
            configs=options.config,
            confidence=options.confidence,
            declared=declared,
            workers=options.workers,
            progress=bars.update,
        )
    page = detection_page(result)
    if options.json:
        write_output(options.json, result.to_json())
    if options.html:
        write_output(options.html, render_page(page))
    if prints_table(options):
        print_page(page, Console())
    if result.outside:
        print_notice(
            f"{result.outside} rows are of views without scored pixels, which are not part of the protocol"
        )
