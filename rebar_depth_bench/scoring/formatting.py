"""Text formatting of results: their summary, and names, notes and ranking reasons of tables and reports."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rebar_depth_bench.base.errors import printable
from rebar_depth_bench.scoring.bootstrap import MIN_BLOCKS
from rebar_depth_bench.scoring.columns import (
    CONSTANT,
    COVERAGE,
    DASH,
    NATIVE,
    ONE_PIXEL,
    PAPER_COLUMNS,
    SCALED,
    SCALED_CONSTANT,
    SIGNIFICANT_DIGITS,
    Column,
    columns_at,
    coverage_percent,
    number,
    rounded,
    texts,
    with_reference,
)
from rebar_depth_bench.scoring.groups import GROUPINGS
from rebar_depth_bench.scoring.protocol import MIN_COMPARABLE_COVERAGE
from rebar_depth_bench.scoring.relative import ALIGNMENT_BY_KIND
from rebar_depth_bench.submission.declaration import METRIC

if TYPE_CHECKING:
    from rebar_depth_bench.scoring.result import Result
    from rebar_depth_bench.scoring.table import Table
    from rebar_depth_bench.submission.declaration import Declaration

DASH_NOTE = f"{DASH}: undefined, because no pixel has a prediction or a number overflowed."

RANK_ERROR_NOTE = "Rank error: mean over all scored pixels of |p - z| / max(p, z), 1 without a valid prediction."

RANK_PURPOSE_NOTE = (
    "The rank error orders depth maps. Working ranges (rebar-bench tasks) state what a sensor can be used for, "
    "and at which distances."
)

CONSTANT_TITLE = "constant"
ONE_PIXEL_TITLE = "one pixel"
REFERENCE_NOTE = (
    f"References, from ground truth: {CONSTANT_TITLE}, a constant after scaling on the predicted pixels, for "
    f"scaled errors; {ONE_PIXEL_TITLE}, exact depth shifted by one pixel, for native errors."
)

ALIGNED_NOTE = (
    "Errors of predictions x after the alignment of their kind with the truth z of each view, and after the "
    "robust one; constant: of the same fit without x. Error: mean over all scored pixels of |p - z| / max(p, z), "
    "1 where x has no value or p <= 0. Never ranked."
)

RANK_MARKS = {"‡": "Not ranked (declares the use of ground truth)", "?": "Use of ground truth not declared"}

INTERVAL_NOTE = (
    "Small figures: 95 % interval, block bootstrap over views (other views of the same scene, not other scenes)."
)

_SCENES_NOTE = "bootstrap over scenes (other scenes of the same generator)."

_GROUP = "The group of a view follows from its ground truth."
_NO_INTERVALS = f"A group with views of fewer than {MIN_BLOCKS} scenes has no intervals."
ALIGNED_GROUP_NOTE = f"{_GROUP} {_NO_INTERVALS}"
GROUP_NOTE = (
    f"{_GROUP} Beside the errors of a group are the reference errors of its views: {ONE_PIXEL_TITLE} for native, "
    f"{CONSTANT_TITLE} for scaled errors. {_NO_INTERVALS}"
)


_HEADS = {
    "coverage": "coverage",
    "rank_error": "rank error",
    "native.abs_rel": "AbsRel",
    "scaled.abs_rel": "scaled",
    "reference.scaled_constant.abs_rel": "constant",
    "margin": "margin",
    "within_mm.5": "<= 5 mm",
}
_RELATIVE_HEADS = {
    "coverage": "coverage",
    "aligned.error": "aligned error",
    "constant.error": "constant error",
    "margin": "margin",
    "aligned.abs_rel": "AbsRel",
    "aligned_robust.abs_rel": "robust AbsRel",
    "aligned.within_mm.5": "<= 5 mm",
}
"""Headings of the columns of a summary by their places; ``margin`` is not in the JSON."""


@dataclass(frozen=True)
class Summary:
    """Content that ``print``, a notebook and the terminal show of a result.

    ``heads`` and ``rows`` are a table of the main numbers: method and headings, config and numbers.
    ``declared`` is the protocol and what the submission declares; ``provenance`` names dataset, archive and
    software.
    """

    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    provenance: str
    declared: str
    notes: Sequence[str]


def summary(result: Result) -> Summary:
    """Return the summary of a result."""
    by_place = _HEADS if result.prediction is None else _RELATIVE_HEADS
    rows = []
    for name, table in result.tables.items():
        cells = [config_title(name, table.split)]
        for place in by_place:
            if place == "margin":
                cells.append(margin_text(table))
            else:
                [column] = columns_at(place)
                cells.append(f"{column.text(table[column.place])} {column.unit}".strip())
        rows.append(cells)
    dataset, declared = result.dataset, result.declared
    method = f"{printable(result.method)} {rank_mark(declared)}".strip()
    return Summary(
        heads=[method, *by_place.values()],
        rows=rows,
        provenance=f"dataset {printable(dataset.version)} ({short_digest(dataset.digest)}), "
        f"{archive_text(result.submission.sha256)}, software {printable(result.software.version)}",
        declared=f"protocol {result.protocol}; inputs: {inputs_text(declared)}; "
        f"ground truth: {ground_truth_text(declared)}",
        notes=result.notes,
    )


def has_dash(result: Result) -> bool:
    """Return whether any number of the tables of a result is undefined."""
    return any(
        not math.isfinite(table[column.place]) for table in result.tables.values() for column in result.columns
    )


def archive_text(sha256: str | None) -> str:
    """Return the digest of the archive that was scored, or that the predictions were not written to one."""
    return "no archive" if sha256 is None else f"archive {short_digest(sha256)}"


def margin_text(table: Table) -> str:
    """Return the margin of a table against the constant in per cent, rounded down as a coverage."""
    margin = constant_margin(table)
    if margin is None:
        return DASH
    return f"{coverage_percent(margin) if margin > -1 else number(100 * margin, 1)} %"


def result_notes(result: Result) -> list[str]:
    """Return the sentences on what limits the numbers of a result: on its kind, and on its configs."""
    configs_by_note: dict[str, list[str]] = {}
    for name, table in result.tables.items():
        for note in (*table_notes(table), *reference_findings(table)):
            configs_by_note.setdefault(note, []).append(printable(name))
    kind = [] if result.prediction is None else [f"{kind_text(result)}; not ranked"]
    return kind + [f"{', '.join(configs)}: {note}" for note, configs in configs_by_note.items()]


def inputs_text(declared: Declaration) -> str:
    """Return the input class that a submission declares."""
    return declared.inputs or "not declared"


def ground_truth_text(declared: Declaration) -> str:
    """Return what a submission declares about its use of ground truth."""
    if declared.uses_ground_truth is None:
        return "use not declared"
    return "used, as declared" if declared.uses_ground_truth else "not used, as declared"


def interval_note(tables: Iterable[Table]) -> str:
    """Return the sentence on how intervals are determined, in configs of one scene and of several scenes."""
    by_scene = {table.split is not None for table in tables}
    if by_scene == {True}:
        return f"Small figures: 95 % interval, {_SCENES_NOTE}"
    return f"{INTERVAL_NOTE} In configs with splits: {_SCENES_NOTE}" if True in by_scene else INTERVAL_NOTE


def short_digest(digest: str, digits: int = 12) -> str:
    """Return ``sha256:`` and the first digits of a digest, which suffice to distinguish two datasets."""
    algorithm, colon, value = digest.rpartition(":")
    return f"{algorithm}{colon}{value[:digits]}"


def table_notes(table: Table) -> list[str]:
    """Return sentences on measured ground truth, and on why a row is not ranked or its errors not compared."""
    notes = []
    if table.truth_sigma_m is not None:
        notes.append(
            f"The ground truth was measured, with a standard deviation of {1000 * table.truth_sigma_m:.3g} mm, as "
            "its authors state; smaller errors cannot be told from errors of the ground truth."
        )
    if table.of_views is not None:
        notes.append(f"Not ranked: {table.views} of {counted(table.of_views, 'view')}.")
    elif not table.ranked and table.kind == METRIC:
        reason = "the submission declares that it uses ground truth" if table.views else "no views"
        notes.append(f"Not ranked: {reason}.")
    if reasons := incomparable_reasons(table):
        notes.append(f"Errors of valid predictions are not compared with those of others: {'; '.join(reasons)}.")
    return notes


def incomparable_reasons(table: Table) -> list[str]:
    """Return the reasons why the errors of a row are not compared with those of others; empty if they are."""
    if table.is_comparable:
        return []
    reasons = []
    if table.views == 0:
        reasons.append("no views")
    missing = table.views - table.views_scored
    if missing:
        reasons.append(f"{missing} of {counted(table.views, 'view')} without any prediction")
    if table["coverage"] < MIN_COMPARABLE_COVERAGE:
        minimum = f"{MIN_COMPARABLE_COVERAGE * 100:.0f} %"
        reasons.append(f"coverage {COVERAGE.text(table['coverage'])} % is below {minimum}")
    if table.views_scored and not table.is_finite:
        reasons.append("a number overflowed")
    return reasons


def row_notes(results: Sequence[Result], absent: Sequence[str]) -> list[tuple[str, str, Sequence[str]]]:
    """Return mark, beginning and list of each note on rows of tables; ``absent`` as in ``print_paper_table``."""
    rows = [
        (f"{printable(result.method, 40)}, {config_title(name, table.split)}", table)
        for result in results
        for name, table in result.tables.items()
    ]
    marked = [f"{row} ({', '.join(reasons)})" for row, table in rows if (reasons := incomparable_reasons(table))]
    partial = [f"{row} ({one.views} of {one.of_views} views)" for row, one in rows if one.of_views is not None]
    aligned = [printable(result.method, 40) for result in results if result.declared_prediction]
    incomparable = ("*", "Errors of valid predictions are not compared with those of others: ", marked)
    without_paper = ("", "The paper's rows are absent; the configs differ from its scenes: ", absent)
    of_some_views = ("", "Not ranked: ", partial)
    as_another_kind = ("", "Metric predictions, aligned as this kind: ", aligned)
    marks = {rank_mark(result.declared) for result in results}
    declared = [(mark, meaning, ()) for mark, meaning in RANK_MARKS.items() if mark in marks]
    return declared + [note for note in (incomparable, of_some_views, as_another_kind, without_paper) if note[-1]]


def note_text(mark: str, start: str, listed: Sequence[str]) -> str:
    """Return a note of ``row_notes`` as a sentence."""
    return f"{mark and mark + ': '}{start}{'; '.join(listed)}."


def grouping_title(grouping: str) -> str:
    """Return the printable title of a grouping, which is its key if a later version has defined it."""
    return GROUPINGS[grouping].title if grouping in GROUPINGS else printable(grouping)


def scaled_constants(results: Sequence[tuple[str, Table]]) -> dict[str, tuple[float, float]]:
    """Return AbsRel and RMSE (cm) of the scaled constants of one config that differ as text, by their titles.

    ``results`` are the method and table of each. The title of a constant has its methods, unless it is the
    only one, or that of complete predictions.
    """
    found: dict[tuple[str, ...], tuple[float, float]] = {}
    titles: dict[tuple[str, ...], str] = {}
    for method, table in results:
        abs_rel, rmse_cm = (table[column.place] for column in SCALED_CONSTANT)
        if not math.isnan(abs_rel):
            shown, complete = (tuple(texts(columns, table)) for columns in (SCALED_CONSTANT, CONSTANT))
            found.setdefault(shown, (abs_rel, rmse_cm))
            listed = f"{titles.get(shown, CONSTANT_TITLE)}, {printable(method)}"
            titles[shown] = CONSTANT_TITLE if shown == complete else listed
    return {titles[shown] if len(found) > 1 else CONSTANT_TITLE: errors for shown, errors in found.items()}


def reference_rows(results: Sequence[tuple[str, Table]]) -> list[tuple[str, dict[str, str]]]:
    """Return the name of each reference, and its errors as text by place of the column to compare them with.

    ``results`` are as in ``scaled_constants``.
    """
    rows = [(title, _reference_texts(SCALED, errors)) for title, errors in scaled_constants(results).items()]
    one_pixel = [tuple(table[column.place] for column in ONE_PIXEL) for _, table in results]
    shifted = [errors for errors in one_pixel if not math.isnan(errors[0])]
    return rows + [(ONE_PIXEL_TITLE, _reference_texts(NATIVE, errors)) for errors in shifted[:1]]


def _reference_texts(columns: Sequence[Column], errors: Sequence[float]) -> dict[str, str]:
    shown = zip(with_reference(columns), errors, strict=True)
    return {column.place: column.text(error) for column, error in shown}


def paper_reference_rows(results: Sequence[tuple[str, Table]]) -> list[tuple[str, list[str]]]:
    """Return name and cells of each reference for ``PAPER_COLUMNS``, empty where they do not apply."""
    return [
        (name, [shown.get(column.place, "") for column in PAPER_COLUMNS])
        for name, shown in reference_rows(results)
    ]


def rank_mark(declared: Declaration) -> str:
    """Return the mark of a row that declares the use of ground truth (‡), or ? if it declares nothing about it."""
    return {True: "‡", False: "", None: "?"}[declared.uses_ground_truth]


def row_name(result: Result, table: Table) -> str:
    """Return the method of a row of a table with its marks, that of ``row_notes`` included."""
    marks = (rank_mark(result.declared), "*" if incomparable_reasons(table) else "")
    return " ".join([printable(result.method, 40), *filter(None, marks)])


def reference_findings(table: Table) -> list[str]:
    """Return a sentence on each error of a table that its reference errors put into perspective."""
    findings = constant_findings(table)
    column, one_pixel = NATIVE[0], table[ONE_PIXEL[0].place]
    if table[column.place] < one_pixel:
        findings.append(
            f"The native AbsRel {column.text(table[column.place])} is below that of exact depth shifted by "
            f"one pixel ({column.text(one_pixel)}): it is smaller than the differences between neighbouring "
            "pixels."
        )
    return findings


def plural(noun: str, count: int) -> str:
    """Return the English noun in the singular or plural for ``count``."""
    return noun if count == 1 else f"{noun}s"


def config_title(name: str, split: str | None) -> str:
    """Return the printable name of a config, with the split of one that has several."""
    return printable(name) if split is None else f"{printable(name)} ({split})"


def counted(count: int, noun: str) -> str:
    """Return the count and the noun, such as ``1 view`` or ``3 views``."""
    return f"{count} {plural(noun, count)}"


def kind_blocks(results: Iterable[Result]) -> list[list[Result]]:
    """Return the results of each kind; others than metric ones by the aligned errors of their configs."""
    blocks: dict[str, list[Result]] = {kind: [] for kind in (METRIC, *ALIGNMENT_BY_KIND)}
    for result in results:
        blocks[result.kind].append(result)
    for kind in ALIGNMENT_BY_KIND:
        blocks[kind].sort(key=lambda result: [sort_error(table) for table in result.tables.values()])
    return [block for block in blocks.values() if block]


def kind_text(result: Result) -> str:
    """Return the kind of a result that is not metric and how it is aligned, and whether its archive is metric."""
    declared = f"{result.declared_prediction} predictions, scored as " if result.declared_prediction else ""
    return f"{declared}{result.kind}{' (--align)' if declared else ''}: {ALIGNMENT_BY_KIND[result.kind]}"


def sort_error(table: Table) -> float:
    """Return the error by which tables are ordered, rounded as in the JSON; inf if it is undefined."""
    error = rounded(table.error)
    return math.inf if error is None else error


def error_and_constant(table: Table) -> tuple[float, float]:
    """Return the scaled AbsRel of a table, of a kind that is not metric the aligned error, and a constant's."""
    if table.kind != METRIC:
        return table["aligned.error"], table["constant.error"]
    return table["scaled.abs_rel"], table["reference.scaled_constant.abs_rel"]


def constant_margin(table: Table) -> float | None:
    """Return the share by which the error is below a constant's, negative if above; None if undefined."""
    error, constant = error_and_constant(table)
    if not table.views_scored or not constant or math.isnan(error / constant):
        return None
    margin = round(1 - error / constant, SIGNIFICANT_DIGITS) + 0.0  # Neither rounding errors nor -0.0.
    return margin if math.isfinite(margin) else None


LEAST_MARGIN = 0.05
"""Share by which an error must be below a constant's; otherwise the predictions say little about depth."""


def is_like_constant(table: Table) -> bool:
    """Return whether the error of a table is not below the error of a constant by ``LEAST_MARGIN``."""
    margin = constant_margin(table)
    return margin is not None and margin < LEAST_MARGIN


def constant_findings(table: Table) -> list[str]:
    """Return a sentence on each sign that the predictions of a table say little about depth."""
    findings = []
    if is_like_constant(table):
        error, constant = error_and_constant(table)
        compared = f"{error:.4f} is not below {100 * (1 - LEAST_MARGIN):.0f} % of a constant's ({constant:.4f})"
        is_low = table["coverage"] < MIN_COMPARABLE_COVERAGE
        missing = ", or missing values are most of both errors" if is_low else ""
        findings.append(
            f"The scaled AbsRel {compared}: a plane at one depth is about as good, or better."
            if table.kind == METRIC
            else f"The aligned error {compared}: the fit hides that the predictions say little about "
            f"depth{missing}."
        )
    if table.views_scored and table["flat_views"] > table.views / 2:
        findings.append(
            f"In {table['flat_views']:.0f} of {table.views} views the fit has no positive slope and is a "
            "constant: it hides that the predictions say nothing about depth, or run the other way (depth "
            "declared as disparity, or disparity as depth)."
        )
    return findings
