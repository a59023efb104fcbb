"""What every study shares: ``--json``, ``--csv``, ``--html``, and its page's tables in the terminal.

An archive as a study reads it: view by view on the scored pixels, refused exactly as ``score`` refuses it.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float, Float64
from numpy import ndarray
from rich import box
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from rebar_depth_bench.atomic_io import write_bytes, write_text
from rebar_depth_bench.data.ground_truth import ViewTruth
from rebar_depth_bench.data.manifest import DatasetFolder
from rebar_depth_bench.errors import InputError, SubmissionError
from rebar_depth_bench.parallel import ordered_map
from rebar_depth_bench.progress import Progress, silent
from rebar_depth_bench.reporting.html.study_page import PageTable, StudyPage, render_study
from rebar_depth_bench.reporting.tables import csv_cell, print_whole
from rebar_depth_bench.scoring.metrics import is_prediction
from rebar_depth_bench.scoring.protocol import PROTOCOL
from rebar_depth_bench.scoring.provenance import ArchiveStamp, Stamp
from rebar_depth_bench.scoring.rounding import rounded
from rebar_depth_bench.submission import SubmissionReader, config_of, open_submission


def add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--json FILE --csv FILE --html FILE``."""
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every number as JSON")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write the table as CSV")
    parser.add_argument("--html", type=Path, metavar="FILE", help="write a self-contained page")


def write_outputs(
    options: argparse.Namespace, content: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], page: StudyPage
) -> None:
    """Write the files that are asked for, then print the page's tables and notes to standard output.

    ``rows`` are the CSV's lines, all with the same keys; none gives an empty file.
    """
    if options.json:
        write_bytes(options.json, json_bytes(content))
    if options.csv:
        write_text(options.csv, csv_text(rows))
    if options.html:
        write_text(options.html, render_study(page))
    print_page(page, Console())


def json_bytes(content: Mapping[str, Any]) -> bytes:
    """Return JSON with numbers of 12 significant digits and null for undefined ones: same input, same bytes."""
    return (json.dumps(_rounded(content), indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()


def csv_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return rows as CSV with a header, numbers as in the JSON: same input, same bytes.

    Undefined numbers are empty. A text that a spreadsheet would run as a formula gets a leading apostrophe.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerows(rows[:1])
    writer.writerows([csv_cell(_rounded(value)) for value in row.values()] for row in rows)
    return out.getvalue()


def print_page(page: StudyPage, console: Console) -> None:
    """Print title, stamps, tables and notes; no number is cut, a narrow console gets longer lines."""
    console.print(Text(page.title, style="bold"))
    console.print(Text("; ".join(f"{what}: {value}" for what, value in page.stamps), style="dim"))
    for table in page.tables:
        console.print()
        console.print(Text(table.caption, style="italic"))
        print_whole(console, _rich_table(table))
    console.print()
    for note in page.notes:
        console.print(Text(note))


def _rich_table(table: PageTable) -> RichTable:
    shown = RichTable(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0), show_edge=False)
    for index, (name, unit) in enumerate(table.heads):
        justify: Any = "left" if index == 0 else "right"
        shown.add_column(Text(f"{name}\n{unit}"), justify=justify, no_wrap=True)
    for row in table.rows:
        shown.add_row(*(Text(cell) for cell in row))
    return shown


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return rounded(value)
    if isinstance(value, Mapping):
        return {key: _rounded(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(one) for one in value]
    return value


T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class ViewPairs:
    """One view's scored pixels that have a prediction: prediction p and truth z, planar depth in metres."""

    view_id: str
    scored_px: int
    p_m: Float64[ndarray, " n"]
    z_m: Float64[ndarray, " n"]


@contextmanager
def opened(
    archive: str | os.PathLike[str], folder: DatasetFolder, progress: Progress = silent
) -> Iterator[SubmissionReader]:
    """Yield an archive all of whose entries can be read; raise ``SubmissionError`` with all problems otherwise."""
    with open_submission(archive, folder.expected_views()) as submission:
        problems = list(submission.problems(progress))
        if problems:
            raise SubmissionError(str(archive), problems)
        yield submission


def archive_stamp(submission: SubmissionReader, folder: DatasetFolder) -> Stamp:
    """Return the stamp of a study of one sound archive against a dataset folder."""
    method = submission.meta.method if submission.meta else ""
    archives = (ArchiveStamp(method, submission.sha256()),)
    return Stamp(PROTOCOL, folder.digest, folder.version, archives)


def configs_of(submission: SubmissionReader, folder: DatasetFolder) -> list[str]:
    """Return the configs that an archive holds, in the folder's order."""
    present = {config_of(view_id) for view_id in submission.view_ids}
    return [config for config in folder.configs if config in present]


def one_config(submission: SubmissionReader, folder: DatasetFolder, wanted: str | None) -> str:
    """Return the config to study; without a ``wanted`` one the archive's only one. Raises ``InputError``."""
    present = configs_of(submission, folder)
    if wanted is None and len(present) == 1:
        return present[0]
    if wanted is None:
        raise InputError(f"{submission.path}: holds {', '.join(present)}, expected --config with one of them")
    if wanted not in present:
        raise InputError(f"{submission.path}: has no config {wanted!r}, expected one of {', '.join(present)}")
    return wanted


def map_views(
    submission: SubmissionReader,
    truths: Iterable[ViewTruth],
    total: int,
    make: Callable[[ViewPairs], T],
    what: str,
    progress: Progress = silent,
) -> list[T]:
    """Return ``make`` of the pairs of ``total`` views, in order, computed on all cores, few views in memory."""
    made: list[T] = []
    outcomes = ordered_map(lambda truth: make(pairs(truth, submission.read(truth.view_id))), truths, None)
    for done, one in enumerate(outcomes, start=1):
        progress(what, done, total)
        made.append(one)
    return made


def pairs(truth: ViewTruth, prediction_m: Float[ndarray, "h w"]) -> ViewPairs:
    """Return a view's pairs: as the score takes them, pixels that are not finite and > 0 are left out."""
    gathered = prediction_m.ravel()[truth.index]
    valid = is_prediction(gathered)
    p_m, z_m = gathered[valid].astype(np.float64), truth.depth_m[valid].astype(np.float64)
    return ViewPairs(truth.view_id, len(truth.index), p_m, z_m)
