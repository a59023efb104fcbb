"""Shared functions of the studies: output files, terminal tables and reading of submissions.

The output options are ``--json``, ``--csv`` and ``--html``; the tables of the page are also printed to the
terminal. A submission is read view by view on the scored pixels, with the same validation as in ``score``.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from jaxtyping import Float, Float64
from numpy import ndarray
from rich import box
from rich.console import Console
from rich.table import Table as RichTable

from rebar_depth_bench.data.dataset_config import DatasetConfig
from rebar_depth_bench.errors import InputError
from rebar_depth_bench.output_options import add_output_file, prints_table
from rebar_depth_bench.outputs import write_output
from rebar_depth_bench.parallel import map_with_progress
from rebar_depth_bench.progress import Progress, silent
from rebar_depth_bench.reporting.html.study_page import PageTable, StudyPage, render_study
from rebar_depth_bench.reporting.tables import frame_csv, plain_text, print_unwrapped
from rebar_depth_bench.scoring.evaluation import Evaluation
from rebar_depth_bench.scoring.ground_truth import ViewTruth
from rebar_depth_bench.scoring.metrics import is_valid_prediction
from rebar_depth_bench.scoring.rounding import rounded
from rebar_depth_bench.submission import SubmissionReader

if TYPE_CHECKING:
    from pandas import DataFrame


def add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options ``--json FILE``, ``--csv FILE`` and ``--html FILE``."""
    add_output_file(parser, "--json", "write every number as JSON")
    add_output_file(parser, "--csv", "write the table as CSV")
    add_output_file(parser, "--html", "write a self-contained page")


def write_outputs(
    options: argparse.Namespace, content: Mapping[str, Any], frame: DataFrame, page: StudyPage
) -> None:
    """Write the requested files, then print the page's tables and notes unless a file is standard output.

    ``content`` is the JSON object and ``frame`` has the rows of the CSV; an empty frame writes an empty file.
    """
    if options.json:
        write_output(options.json, json_bytes(content))
    if options.csv:
        write_output(options.csv, frame_csv(frame))
    if options.html:
        write_output(options.html, render_study(page))
    if prints_table(options):
        print_page(page, Console())


def json_bytes(content: Mapping[str, Any]) -> bytes:
    """Return deterministic UTF-8 JSON: numbers have 12 significant digits, undefined numbers are null."""
    return (json.dumps(_round_numbers(content), indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()


def print_page(page: StudyPage, console: Console) -> None:
    """Print title, stamps, tables and notes.

    Numbers are never truncated: on a narrow console, lines become longer than the console.
    """
    console.print(plain_text(page.title, style="bold"))
    console.print(plain_text("; ".join(f"{label}: {value}" for label, value in page.stamps), style="dim"))
    for table in page.tables:
        console.print()
        console.print(plain_text(table.caption, style="italic"))
        print_unwrapped(console, _rich_table(table))
    console.print()
    for note in page.notes:
        console.print(plain_text(note))


def _rich_table(table: PageTable) -> RichTable:
    rich_table = RichTable(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0), show_edge=False)
    for index, (name, unit) in enumerate(table.heads):
        justify: Any = "left" if index == 0 else "right"
        rich_table.add_column(plain_text(f"{name}\n{unit}"), justify=justify, no_wrap=True)
    for row in table.rows:
        rich_table.add_row(*(plain_text(cell) for cell in row))
    return rich_table


def _round_numbers(value: Any) -> Any:
    if isinstance(value, float):
        return rounded(value)
    if isinstance(value, Mapping):
        return {key: _round_numbers(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_round_numbers(item) for item in value]
    return value


T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class ViewPairs:
    """Scored pixels of one view that have a valid prediction.

    ``p_m`` is the predicted and ``z_m`` the true planar depth in metres, both float64 of shape (n,) and in pixel
    order; ``scored_px`` counts all scored pixels of the view, with or without a prediction.
    """

    view_id: str
    scored_px: int
    p_m: Float64[ndarray, " n"]
    z_m: Float64[ndarray, " n"]


def select_config(evaluation: Evaluation, wanted: str | None) -> DatasetConfig:
    """Return the config to study: ``wanted``, or the only config of the submission if ``wanted`` is None.

    Raises ``InputError`` if the submission does not contain ``wanted``, or if ``wanted`` is None and the
    submission does not contain exactly one config.
    """
    present, path = {config.name: config for config in evaluation.configs}, evaluation.submission.path
    if wanted is None and len(present) == 1:
        [wanted] = present
    if wanted is None:
        raise InputError(f"{path}: holds {', '.join(present)}, expected --config with one of them")
    if wanted not in present:
        raise InputError(f"{path}: has no config {wanted!r}, expected one of {', '.join(present)}")
    return present[wanted]


def map_views(
    submission: SubmissionReader,
    truths: Iterable[ViewTruth],
    total: int,
    compute: Callable[[ViewPairs], T],
    label: str,
    progress: Progress = silent,
) -> list[T]:
    """Return ``compute(view_pairs)`` for each of ``total`` views, in order.

    Views are processed on all cores; only a few are in memory at a time. ``label`` names the step in the progress
    display.
    """

    def compute_view(truth: ViewTruth) -> T:
        return compute(pair_with_truth(truth, submission.read(truth.view_id)))

    return map_with_progress(compute_view, truths, None, progress, label, total)


def pair_with_truth(truth: ViewTruth, prediction_m: Float[ndarray, "h w"]) -> ViewPairs:
    """Return the pairs of predicted and true depth on the scored pixels of a view.

    As in scoring, pixels whose prediction is not finite and > 0 are left out.
    """
    predicted_m = prediction_m.ravel()[truth.index]
    valid = is_valid_prediction(predicted_m)
    p_m, z_m = predicted_m[valid].astype(np.float64), truth.depth_m[valid].astype(np.float64)
    return ViewPairs(truth.view_id, len(truth.index), p_m, z_m)
