"""Text formatting of numbers, names and ranking reasons, shared by terminal tables and HTML reports."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from decimal import ROUND_DOWN, Decimal

from rebar_depth_bench.scoring.metrics import METRICS, DepthMetrics
from rebar_depth_bench.scoring.protocol import MIN_RANKED_COVERAGE, WITHIN_MM
from rebar_depth_bench.scoring.result import Table

DASH = "–"
"""Text of an undefined number, which is null in the JSON."""

DASH_NOTE = f"{DASH}: undefined, because no pixel has a prediction or a number overflowed."

NATIVE_TITLE = "native (no alignment)"
SCALED_TITLE = "scaled (oracle median scale per view, s = median(z)/median(p))"
WITHIN_TITLE = "within t mm (native): share of all scored pixels with |p - z| <= t"

INTERVAL_NOTE = (
    "Small figures: 95 % interval, block bootstrap over views (other views of the same scene, not other scenes)."
)

METRIC_HEADS = tuple((info.title, info.unit, "↑" if info.higher_is_better else "↓") for info in METRICS.values())
"""Name, unit and better direction of each number that ``metric_cells`` formats."""


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


def short_digest(digest: str, digits: int = 12) -> str:
    """Return ``sha256:`` and the first digits of a digest, which suffice to distinguish two datasets."""
    algorithm, colon, value = digest.rpartition(":")
    return f"{algorithm}{colon}{value[:digits]}"


def unranked_reasons(table: Table) -> list[str]:
    """Return the reasons why a config's row is not ranked; empty for a ranked row."""
    if table.ranked:
        return []
    reasons = []
    if table.views == 0:
        reasons.append("no views")
    missing = table.views - table.views_scored
    if missing:
        reasons.append(f"{missing} of {counted(table.views, 'view')} without any prediction")
    if table.coverage is not None and table.coverage < MIN_RANKED_COVERAGE:
        reasons.append(f"coverage {coverage_percent(table.coverage)} % is below {MIN_RANKED_COVERAGE * 100:.0f} %")
    if any(_overflowed(metrics) for metrics in (table.native, table.scaled)):
        reasons.append("a number overflowed")
    return reasons or ["not ranked by the scorer"]


def has_dash(rows: Iterable[Iterable[str]]) -> bool:
    """Return whether any cell is undefined, so that ``DASH_NOTE`` must be shown."""
    return any(cell == DASH for row in rows for cell in row)


def plural(noun: str, count: int) -> str:
    """Return the English noun in the singular or plural for ``count``."""
    return noun if count == 1 else f"{noun}s"


def counted(count: int, noun: str) -> str:
    """Return the count and the noun, such as ``1 view`` or ``3 views``."""
    return f"{count} {plural(noun, count)}"


def _overflowed(metrics: DepthMetrics | None) -> bool:
    return metrics is not None and not all(math.isfinite(value) for value in vars(metrics).values())
