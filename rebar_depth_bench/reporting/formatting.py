"""How numbers, names and verdicts are spelled: the same in the terminal's table and in the HTML report."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from decimal import ROUND_DOWN, Decimal

from rebar_depth_bench.scoring.metrics import DepthMetrics
from rebar_depth_bench.scoring.protocol import MIN_RANKED_COVERAGE, WITHIN_MM
from rebar_depth_bench.scoring.result import Table

DASH = "–"
"""Stands for an undefined number, null in the JSON."""

DASH_NOTE = f"{DASH}: undefined, because no pixel has a prediction or a number overflowed."

NATIVE_TITLE = "native (no alignment)"
SCALED_TITLE = "scaled (oracle median scale per view, s = median(z)/median(p))"
WITHIN_TITLE = "within t mm (native): share of all scored pixels with |p - z| <= t"

INTERVAL_NOTE = (
    "Small figures: 95 % interval, block bootstrap over views (other views of the same scene, not other scenes)."
)

METRIC_HEADS = (("AbsRel", "", "↓"), ("RMSE", "cm", "↓"), ("MAE", "cm", "↓"), ("δ1", "", "↑"))
"""Name, unit and better direction of each number that ``metric_cells`` spells."""


def number(value: float | None, decimals: int) -> str:
    """Return a number with fixed decimals, scientific where these would hide it, a dash if undefined."""
    if value is None or not math.isfinite(value):
        return DASH
    if value != 0 and not 0.5 * 10**-decimals <= abs(value) < 1e6:
        return f"{value:.1e}"
    return f"{value:.{decimals}f}"


def percent(share: float | None) -> str:
    """Return a share in per cent, one decimal, rounded."""
    return DASH if share is None else f"{share * 100:.1f}"


def coverage_percent(share: float | None) -> str:
    """Return a coverage in per cent, one decimal, rounded down: no gap reads as full, no miss as a pass."""
    if share is None:
        return DASH
    return str((Decimal(repr(share)) * 100).quantize(Decimal("0.1"), rounding=ROUND_DOWN))


def metric_cells(metrics: DepthMetrics | None) -> list[str]:
    """Return AbsRel, RMSE in cm, MAE in cm, delta1."""
    if metrics is None:
        return [DASH] * len(METRIC_HEADS)
    return [
        number(metrics.abs_rel, 4),
        number(metrics.rmse_cm, 2),
        number(metrics.mae_cm, 2),
        number(metrics.delta1, 3),
    ]


def scale_cell(scale: float | None) -> str:
    """Return a scale factor s."""
    return number(scale, 3)


def within_cells(within_mm: Mapping[int, float | None] | Mapping[int, float]) -> list[str]:
    """Return the shares within 3, 5, 10 and 20 mm, per cent."""
    return [percent(within_mm[tolerance]) for tolerance in WITHIN_MM]


def interval_cell(interval: tuple[float, float] | None, decimals: int, factor: float = 1.0) -> str:
    """Return a 95 % interval times ``factor`` as low – high, empty where there is none."""
    if interval is None or not all(math.isfinite(end) for end in interval):
        return ""
    low, high = (number(end * factor, decimals) for end in interval)
    return f"{low} – {high}"


def coverage_interval_cell(interval: tuple[float, float] | None) -> str:
    """Return the 95 % interval of a coverage in per cent, both ends rounded down as the coverage is."""
    if interval is None or not all(math.isfinite(end) for end in interval):
        return ""
    return " – ".join(coverage_percent(end) for end in interval)


def metric_interval_cells(intervals: Mapping[str, tuple[float, float] | None], alignment: str) -> list[str]:
    """Return the intervals of what ``metric_cells`` spells, with as many decimals; ``native`` or ``scaled``."""
    decimals = {"abs_rel": 4, "rmse_cm": 2, "mae_cm": 2, "delta1": 3}
    return [interval_cell(intervals.get(f"{alignment}.{name}"), places) for name, places in decimals.items()]


def printable(text: str, limit: int = 200) -> str:
    """Return a name from an archive without control or direction-changing characters, cut to ``limit``."""
    clean = "".join(char if char.isprintable() else "\N{REPLACEMENT CHARACTER}" for char in text[: limit + 1])
    return clean if len(clean) <= limit else clean[: limit - 1] + "…"


def short_digest(digest: str, digits: int = 12) -> str:
    """Return ``sha256:`` and the first digits of a digest, enough to tell two datasets apart."""
    algorithm, colon, value = digest.rpartition(":")
    return f"{algorithm}{colon}{value[:digits]}"


def unranked_reasons(table: Table) -> list[str]:
    """Return in words why a config's row is not ranked; empty where it is."""
    if table.ranked:
        return []
    reasons = []
    if table.views == 0:
        reasons.append("no views")
    missing = table.views - table.views_scored
    if missing:
        reasons.append(f"{missing} of {table.views} {plural('view', table.views)} without any prediction")
    if table.coverage is not None and table.coverage < MIN_RANKED_COVERAGE:
        reasons.append(f"coverage {coverage_percent(table.coverage)} % is below {MIN_RANKED_COVERAGE * 100:.0f} %")
    if any(_overflowed(metrics) for metrics in (table.native, table.scaled)):
        reasons.append("a number overflowed")
    return reasons or ["not ranked by the scorer"]


def has_dash(rows: Iterable[Iterable[str]]) -> bool:
    """Return whether any cell is undefined, so that the footnote is due."""
    return any(cell == DASH for row in rows for cell in row)


def plural(noun: str, count: int) -> str:
    """Return an English noun for that many of it."""
    return noun if count == 1 else f"{noun}s"


def _overflowed(metrics: DepthMetrics | None) -> bool:
    return metrics is not None and not all(math.isfinite(value) for value in vars(metrics).values())
