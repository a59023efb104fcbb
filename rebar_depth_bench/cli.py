"""The ``rebar-bench`` command."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import datasets
from rich.console import Console
from rich.table import Table as RichTable

from rebar_depth_bench.comparison import compare
from rebar_depth_bench.comparison_table import comparison_csv, print_comparison
from rebar_depth_bench.console import ProgressBars, run_command
from rebar_depth_bench.demo import DEMO_FOLDER, DEMO_VIEWS, run_demo
from rebar_depth_bench.errors import SubmissionError
from rebar_depth_bench.files import write_bytes, write_text
from rebar_depth_bench.folder import open_folder
from rebar_depth_bench.methods import METHODS, find_method
from rebar_depth_bench.predict import predict
from rebar_depth_bench.report import write_report
from rebar_depth_bench.scoring import score
from rebar_depth_bench.submission import check_archive
from rebar_depth_bench.table import print_table, result_csv
from rebar_depth_bench.version import software_version


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``rebar-bench``; return its exit status."""
    options = argument_parser().parse_args(arguments)
    datasets.disable_progress_bars()
    return run_command(lambda: options.run(options))


def _score(options: argparse.Namespace) -> None:
    with ProgressBars() as bars:
        result = score(options.archive, options.data, workers=options.workers, progress=bars.update)
    if options.json:
        write_bytes(options.json, result.to_json())
    if options.csv:
        write_text(options.csv, result_csv(result))
    if options.html:
        write_report(result, options.archive, options.data, options.html)
    print_table(result, Console())


def _compare(options: argparse.Namespace) -> None:
    with ProgressBars() as bars:
        first, *others = (
            score(archive, options.data, workers=options.workers, progress=bars.update)
            for archive in (options.first, *options.others)
        )
    comparisons = [compare(first, other) for other in others]
    if options.json:
        content = [comparison.to_dict() for comparison in comparisons]
        write_text(options.json, json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
    if options.csv:
        write_text(options.csv, comparison_csv(comparisons))
    for comparison in comparisons:
        print_comparison(comparison, Console())


def _check(options: argparse.Namespace) -> None:
    expected = open_folder(options.data).expected_views()
    with ProgressBars() as bars:
        problems = check_archive(options.archive, expected, bars.update)
    if problems:
        raise SubmissionError(str(options.archive), problems)
    print(f"{options.archive}: no problem found")


def _methods(_: argparse.Namespace) -> None:
    table = RichTable(title="Methods")
    for heading in ("method", "what it does", "needs", "source", "licence"):
        table.add_column(heading, overflow="fold")
    for method in METHODS.values():
        info = method.info
        table.add_row(info.name, info.summary, ", ".join(info.columns), info.source, info.licence)
    Console().print(table)


def _predict(options: argparse.Namespace) -> None:
    method = find_method(options.method)
    with ProgressBars() as bars:
        predict(method, options.data, options.out, configs=options.config, progress=bars.update)
    print(options.out)


def _demo(options: argparse.Namespace) -> None:
    run_demo(options.out, options.views)


def argument_parser() -> argparse.ArgumentParser:
    """Return the command's argument parser."""
    parser = argparse.ArgumentParser(
        prog="rebar-bench",
        description="Score metric depth on reinforcement against exact ground truth.",
    )
    parser.add_argument("--version", action="version", version=software_version())
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    scoring = _command(commands, "score", _score, "score a submission archive: native beside scaled")
    _archive_and_data(scoring)
    scoring.add_argument("--json", type=Path, metavar="FILE", help="write the result as JSON")
    scoring.add_argument("--html", type=Path, metavar="FILE", help="write a self-contained report")
    scoring.add_argument("--csv", type=Path, metavar="FILE", help="write the tables as CSV")
    scoring.add_argument("--workers", type=int, metavar="N", help="threads (default: one a core)")

    comparing = _command(commands, "compare", _compare, "paired differences of submissions, with intervals")
    comparing.add_argument("first", metavar="A", help="the archive that the others are compared with")
    comparing.add_argument("others", metavar="B", nargs="+", help="one or more archives")
    comparing.add_argument("--data", required=True, metavar="ROOT", help="dataset folder or Hub repository id")
    comparing.add_argument("--json", type=Path, metavar="FILE", help="write the differences as JSON")
    comparing.add_argument("--csv", type=Path, metavar="FILE", help="write the differences as CSV")
    comparing.add_argument("--workers", type=int, metavar="N", help="threads (default: one a core)")

    _archive_and_data(_command(commands, "check", _check, "say everything that is wrong with an archive"))
    _command(commands, "methods", _methods, "list the methods that come with the bench")

    predicting = _command(commands, "predict", _predict, "run a method over a dataset into an archive")
    predicting.add_argument("method", metavar="METHOD", help=", ".join(METHODS))
    predicting.add_argument("--data", required=True, metavar="ROOT", help="dataset folder or Hub repository id")
    predicting.add_argument("--out", required=True, type=Path, metavar="ARCHIVE", help="the zip to write")
    predicting.add_argument(
        "--config",
        nargs="+",
        action="extend",
        metavar="NAME",
        help="which configs (default: all of the folder)",
    )

    demo = _command(commands, "demo", _demo, "render a small lattice set, predict, score and report")
    demo.add_argument(
        "--out", type=Path, default=Path(DEMO_FOLDER), help="folder to work in (default: %(default)s)"
    )
    demo.add_argument(
        "--views", type=int, default=DEMO_VIEWS, help="stereo views to render (default: %(default)s)"
    )
    return parser


def _command(commands: object, name: str, run: object, summary: str) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = commands.add_parser(name, help=summary, description=summary)  # type: ignore[attr-defined]
    parser.set_defaults(run=run)
    return parser


def _archive_and_data(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("archive", metavar="ARCHIVE", help="the submission's zip")
    parser.add_argument("--data", required=True, metavar="ROOT", help="dataset folder or Hub repository id")
