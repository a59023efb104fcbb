"""Text formatting of numbers, names and ranking reasons, shared by terminal tables and HTML reports."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from decimal import ROUND_DOWN, Decimal

from rebar_depth_bench.errors import printable
from rebar_depth_bench.scoring.bootstrap import MIN_BLOCKS
from rebar_depth_bench.scoring.groups import GROUPINGS
from rebar_depth_bench.scoring.metrics import METRICS, DepthMetrics
from rebar_depth_bench.scoring.protocol import MIN_COMPARABLE_COVERAGE, WITHIN_MM
from rebar_depth_bench.scoring.result import Table
from rebar_depth_bench.submission.declaration import Declaration

DASH = "–"
"""Text of an undefined number, which is null in the JSON."""

DASH_NOTE = f"{DASH}: undefined, because no pixel has a prediction or a number overflowed."

NATIVE_TITLE = "native (no alignment)"
SCALED_TITLE = "scaled (oracle median scale per view, s = median(z)/median(p))"
WITHIN_TITLE = "within t mm (native): share of all scored pixels with |p - z| <= t"

RANK_ERROR_NOTE = "Rank error: mean over all scored pixels of |p - z| / max(p, z), 1 without a valid prediction."

CONSTANT_TITLE = "constant"
ONE_PIXEL_TITLE = "one pixel"
REFERENCE_NOTE = (
    f"References, from ground truth: {CONSTANT_TITLE}, a constant after scaling on the predicted pixels, for "
    f"scaled errors; {ONE_PIXEL_TITLE}, exact depth shifted by one pixel, for native errors."
)

INTERVAL_NOTE = (
    "Small figures: 95 % interval, block bootstrap over views (other views of the same scene, not other scenes)."
)

_SCENES_NOTE = "bootstrap over scenes (other scenes of the same generator)."

METRIC_HEADS = tuple((info.title, info.unit, "↑" if info.higher_is_better else "↓") for info in METRICS.values())
"""Name, unit and better direction of each number that ``metric_cells`` formats."""

GROUP_METRICS = ("abs_rel", "rmse_cm")
"""Metrics in tables of groups: those that have reference errors."""

GROUP_NOTE = (
    "The group of a view follows from its ground truth. Beside the errors of a group are the reference errors of "
    f"its views: {ONE_PIXEL_TITLE} for native, {CONSTANT_TITLE} for scaled errors. A group with views of fewer "
    f"than {MIN_BLOCKS} scenes has no intervals."
)


def number(value: float | None, decimals: int) -> str:
    """Return a number with fixed decimals, in scientific notation if these would hide it, a dash if undefined.

    Scientific notation is used below half a unit of the last decimal and from 1e6 on.
    """
    if value is None or not math.isfinite(value):
        return DASH
    if value != 0 and not 0.5 * 10**-decimals <= abs(value) < 1e6:
        return f"{value:.1e}"
    return f"{value:.{decimals}f}"


def percent(share: float | None) -> str:
    """Return a share in per cent, rounded to one decimal."""
    return DASH if share is None else f"{share * 100:.1f}"


def coverage_percent(share: float | None) -> str:
    """Return a coverage in per cent with one decimal, rounded down.

    Incomplete coverage is therefore never shown as 100 %, and coverage below the threshold never as reaching it.
    """
    if share is None:
        return DASH
    return str((Decimal(repr(share)) * 100).quantize(Decimal("0.1"), rounding=ROUND_DOWN))


def rank_error_cell(rank_error: float | None) -> str:
    """Return a rank error with four decimals."""
    return number(rank_error, 4)


def inputs_text(declared: Declaration) -> str:
    """Return the input class that a submission declares."""
    return declared.inputs or "not declared"


def ground_truth_text(declared: Declaration) -> str:
    """Return what a submission declares about its use of ground truth."""
    if declared.uses_ground_truth is None:
        return "use not declared"
    return "used, as declared" if declared.uses_ground_truth else "not used, as declared"


def declaration_text(declared: Declaration) -> str:
    """Return a submission's declaration in one line."""
    return f"inputs: {declared.inputs or 'not declared'}; ground truth: {ground_truth_text(declared)}"


def metric_cell(metrics: DepthMetrics | None, name: str) -> str:
    """Return one field of ``metrics`` as text; a dash if ``metrics`` is None."""
    return number(getattr(metrics, name, None), METRICS[name].decimals)


def metric_cells(metrics: DepthMetrics | None) -> list[str]:
    """Return AbsRel, RMSE (cm), MAE (cm) and delta1 as text; dashes if ``metrics`` is None."""
    return [metric_cell(metrics, name) for name in METRICS]


def paper_cells(table: Table) -> list[str]:
    """Return RMSE (cm) and AbsRel native, AbsRel scaled and the median s as text, as in the paper's Table I."""
    native = (metric_cell(table.native, name) for name in ("rmse_cm", "abs_rel"))
    return [*native, metric_cell(table.scaled, "abs_rel"), scale_cell(table.scale_median)]


def scale_cell(scale: float | None) -> str:
    """Return a scale factor s with three decimals."""
    return number(scale, 3)


def within_cells(within_mm: Mapping[int, float | None] | Mapping[int, float]) -> list[str]:
    """Return the shares within each tolerance of ``WITHIN_MM``, per cent."""
    return [percent(within_mm[tolerance]) for tolerance in WITHIN_MM]


def interval_cell(interval: tuple[float, float] | None, decimals: int, factor: float = 1.0) -> str:
    """Return a 95 % interval times ``factor`` as ``low – high``; empty if it is undefined."""
    if interval is None or not all(math.isfinite(end) for end in interval):
        return ""
    low, high = (number(end * factor, decimals) for end in interval)
    return f"{low} – {high}"


def interval_text(interval: tuple[float, float] | None, decimals: int) -> str:
    """Return an interval as ``low to high``; a dash if it is None."""
    return DASH if interval is None else " to ".join(number(end, decimals) for end in interval)


def coverage_interval_cell(interval: tuple[float, float] | None) -> str:
    """Return the 95 % interval of a coverage in per cent, both ends rounded down like the coverage itself."""
    if interval is None or not all(math.isfinite(end) for end in interval):
        return ""
    return " – ".join(coverage_percent(end) for end in interval)


def metric_interval_cells(intervals: Mapping[str, tuple[float, float] | None], alignment: str) -> list[str]:
    """Return the intervals of the numbers of ``metric_cells``, with the same numbers of decimals.

    ``alignment`` is ``native`` or ``scaled``.
    """
    return [interval_cell(intervals.get(f"{alignment}.{name}"), info.decimals) for name, info in METRICS.items()]


def interval_note(tables: Iterable[Table]) -> str:
    """Return the sentence on intervals: how those of configs of one scene, and of several, are determined."""
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
    if reason := unranked_reason(table):
        notes.append(f"Not ranked: {reason}.")
    if reasons := incomparable_reasons(table):
        notes.append(f"Errors of valid predictions are not compared with those of others: {'; '.join(reasons)}.")
    return notes


def unranked_reason(table: Table) -> str:
    """Return the reason why a config's row is not ranked; empty for a ranked row."""
    if table.ranked:
        return ""
    if table.views == 0:
        return "no views"
    return "the submission declares that it uses ground truth"


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
    if table.coverage is not None and table.coverage < MIN_COMPARABLE_COVERAGE:
        minimum = f"{MIN_COMPARABLE_COVERAGE * 100:.0f} %"
        reasons.append(f"coverage {coverage_percent(table.coverage)} % is below {minimum}")
    if any(metrics is not None and not metrics.is_finite for metrics in (table.native, table.scaled)):
        reasons.append("a number overflowed")
    return reasons


def group_reference_cells(table: Table) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the errors ``GROUP_METRICS`` of the references one pixel and constant as text."""
    one_pixel = _error_texts(table.reference.one_pixel_abs_rel, table.reference.one_pixel_rmse_cm)
    return one_pixel, _error_texts(*table.scaled_constant)


def _error_texts(*errors: float | None) -> tuple[str, ...]:
    return tuple(number(error, METRICS[name].decimals) for name, error in zip(GROUP_METRICS, errors, strict=True))


def grouping_title(grouping: str) -> str:
    """Return the printable title of a grouping, which is its key if a later version has defined it."""
    return GROUPINGS[grouping].title if grouping in GROUPINGS else printable(grouping)


def scaled_constants(results: Sequence[tuple[str, Table]]) -> dict[str, tuple[float, float | None]]:
    """Return AbsRel and RMSE (cm) of the scaled constants of one config that differ as text, by their titles.

    ``results`` are the method and table of each. The title of a constant has its methods, unless it is the
    only one, or that of complete predictions.
    """
    found: dict[tuple[str, ...], tuple[float, float | None]] = {}
    titles: dict[tuple[str, ...], str] = {}
    for method, table in results:
        abs_rel, rmse_cm = table.scaled_constant
        if abs_rel is not None:
            texts = _error_texts(abs_rel, rmse_cm)
            complete = _error_texts(table.reference.constant_abs_rel, table.reference.constant_rmse_cm)
            found.setdefault(texts, (abs_rel, rmse_cm))
            listed = f"{titles.get(texts, CONSTANT_TITLE)}, {printable(method)}"
            titles[texts] = CONSTANT_TITLE if texts == complete else listed
    return {titles[texts] if len(found) > 1 else CONSTANT_TITLE: errors for texts, errors in found.items()}


def reference_rows(results: Sequence[tuple[str, Table]]) -> list[tuple[str, list[str], list[str]]]:
    """Return name, native and scaled cells (as ``metric_cells``, empty if they do not apply) of each reference.

    ``results`` are as in ``scaled_constants``.
    """
    empty = [""] * len(METRICS)
    rows = [
        (title, empty, _reference_cells(dict(zip(GROUP_METRICS, errors, strict=True))))
        for title, errors in scaled_constants(results).items()
    ]
    references = [table.reference for _, table in results if table.reference.one_pixel_abs_rel is not None]
    for reference in references[:1]:
        values = {"abs_rel": reference.one_pixel_abs_rel, "rmse_cm": reference.one_pixel_rmse_cm}
        rows.append((ONE_PIXEL_TITLE, _reference_cells(values), empty))
    return rows


def paper_reference_rows(results: Sequence[tuple[str, Table]]) -> list[tuple[str, list[str]]]:
    """Return name and cells of each reference in the columns of ``paper_cells``, empty where they do not apply."""
    abs_rel, rmse_cm = list(METRICS).index("abs_rel"), list(METRICS).index("rmse_cm")
    return [
        (name, [native[rmse_cm], native[abs_rel], scaled[abs_rel], ""])
        for name, native, scaled in reference_rows(results)
    ]


def rank_mark(declared: Declaration, table: Table) -> str:
    """Return the mark of a row that is not ranked (‡) or whose use of ground truth is not declared (?)."""
    if not table.ranked:
        return " ‡"
    return " ?" if declared.uses_ground_truth is None else ""


def reference_findings(table: Table) -> list[str]:
    """Return a sentence on each error of a table that its reference errors put into perspective."""
    findings, reference = [], table.reference
    if table.native and reference.one_pixel_abs_rel and table.native.abs_rel < reference.one_pixel_abs_rel:
        findings.append(
            f"The native AbsRel {metric_cell(table.native, 'abs_rel')} is below that of exact depth shifted by "
            f"one pixel ({number(reference.one_pixel_abs_rel, METRICS['abs_rel'].decimals)}): it is smaller than "
            "the differences between neighbouring pixels."
        )
    constant, _ = table.scaled_constant
    if table.scaled and constant and table.scaled.abs_rel > constant:
        findings.append(
            f"The scaled AbsRel {metric_cell(table.scaled, 'abs_rel')} is above that of a constant "
            f"({number(constant, METRICS['abs_rel'].decimals)}): a plane at one depth describes the shape better."
        )
    return findings


def _reference_cells(values: Mapping[str, float | None]) -> list[str]:
    return [number(values[name], info.decimals) if name in values else "" for name, info in METRICS.items()]


def has_dash(rows: Iterable[Iterable[str]]) -> bool:
    """Return whether any cell is undefined, so that ``DASH_NOTE`` must be shown."""
    return any(cell == DASH for row in rows for cell in row)


def plural(noun: str, count: int) -> str:
    """Return the English noun in the singular or plural for ``count``."""
    return noun if count == 1 else f"{noun}s"


def config_title(name: str, split: str | None) -> str:
    """Return the printable name of a config, with the split of one that has several."""
    return printable(name) if split is None else f"{printable(name)} ({split})"


def counted(count: int, noun: str) -> str:
    """Return the count and the noun, such as ``1 view`` or ``3 views``."""
    return f"{count} {plural(noun, count)}"
