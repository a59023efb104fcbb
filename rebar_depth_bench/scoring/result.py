"""What a score says: per view, per config, and as the bytes of the contract's JSON."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.extended.result import ExtendedResult
from rebar_depth_bench.scoring.bootstrap import Interval, Resampling, interval, resample
from rebar_depth_bench.scoring.metrics import DepthMetrics
from rebar_depth_bench.scoring.protocol import MIN_RANKED_COVERAGE, PROTOCOL, WITHIN_MM
from rebar_depth_bench.scoring.rounding import INTERVAL_DIGITS, rounded

_METRICS = ("abs_rel", "rmse_cm", "mae_cm", "delta1")
SCALE = "scale_median"
_INDEX = re.compile("[0-9]{4}")


@dataclass(frozen=True)
class ViewScore:
    """One view's numbers. ``scale``, ``native`` and ``scaled`` are None where no pixel has a prediction."""

    view_id: str
    scored_px: int
    coverage: float
    scale: float | None
    native: DepthMetrics | None
    scaled: DepthMetrics | None
    within_mm: Mapping[int, float]


def _metric(alignment: str, name: str) -> Callable[[ViewScore], float | None]:
    return lambda view: getattr(getattr(view, alignment), name, None)


def _within(tolerance_mm: int) -> Callable[[ViewScore], float | None]:
    return lambda view: view.within_mm[tolerance_mm]


VIEW_NUMBERS: Mapping[str, Callable[[ViewScore], float | None]] = {
    "coverage": lambda view: view.coverage,
    **{f"{alignment}.{name}": _metric(alignment, name) for alignment in ("native", "scaled") for name in _METRICS},
    SCALE: lambda view: view.scale,
    **{f"within_mm.{tolerance_mm}": _within(tolerance_mm) for tolerance_mm in WITHIN_MM},
}
"""What a view contributes to each number of a table; None where it has no value."""


@dataclass(frozen=True)
class Table:
    """One config's numbers: means over its views, the median of their scales.

    ``intervals`` has the 95 % block bootstrap interval of each of ``VIEW_NUMBERS``, None where there is none.
    """

    views: int
    views_scored: int
    coverage: float | None
    ranked: bool
    native: DepthMetrics | None
    scaled: DepthMetrics | None
    scale_median: float | None
    within_mm: Mapping[int, float | None]
    intervals: Mapping[str, Interval | None] = field(default_factory=dict)


@dataclass(frozen=True)
class Result:
    """Everything a score says, and the stamps of what it was computed from."""

    method: str
    submission_sha256: str
    dataset_digest: str
    dataset_version: str
    software_version: str
    tables: Mapping[str, Table]
    views: Sequence[ViewScore]
    extended: ExtendedResult | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's JSON object; extended measures, where there are any, stand at its end."""
        extended = {} if self.extended is None else {"extended": self.extended.to_dict()}
        return {
            "protocol": PROTOCOL,
            "dataset": {"digest": self.dataset_digest, "version": self.dataset_version},
            "submission": {"method": self.method, "sha256": self.submission_sha256},
            "software": {"version": self.software_version},
            "tables": {name: _table_dict(table) for name, table in self.tables.items()},
            "views": [_view_dict(view) for view in self.views],
            **extended,
        }

    def to_json(self) -> bytes:
        """Return the JSON's bytes: the same for the same archive and dataset, wherever computed."""
        return (json.dumps(self.to_dict(), indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()


def tabulate(views: Sequence[ViewScore]) -> Table:
    """Return a config's table from the scores of its views in the protocol.

    A number that is not finite (a prediction so large that its square overflows) is kept out of the table
    and the row out of the ranking: it must not help by vanishing.
    """
    with_value = [view for view in views if view.native is not None]
    native = _mean_metrics([view.native for view in with_value if view.native])
    scaled = _mean_metrics([view.scaled for view in with_value if view.scaled])
    coverage = _mean([view.coverage for view in views])
    complete = bool(views) and len(with_value) == len(views)
    finite = all(_is_finite(metrics) for metrics in (native, scaled))
    return Table(
        views=len(views),
        views_scored=len(with_value),
        coverage=coverage,
        ranked=complete and finite and coverage is not None and coverage >= MIN_RANKED_COVERAGE,
        native=native,
        scaled=scaled,
        scale_median=median([view.scale for view in with_value if view.scale is not None]) if with_value else None,
        within_mm={t: _mean([view.within_mm[t] for view in views]) for t in WITHIN_MM},
        intervals=view_intervals(views) if views else dict.fromkeys(VIEW_NUMBERS),
    )


def view_intervals(views: Sequence[ViewScore]) -> dict[str, Interval | None]:
    """Return the 95 % interval of every number of the table that these views make."""
    estimates = estimate_draws(views, resample(protocol_indices([view.view_id for view in views])))
    return {name: interval(estimates[:, k]) for k, name in enumerate(VIEW_NUMBERS)}


def estimate_draws(views: Sequence[ViewScore], resampling: Resampling) -> Float64[ndarray, "draws k"]:
    """Return the ``VIEW_NUMBERS`` of the table that each resample of the views makes; NaN where undefined."""
    values = view_numbers(views)
    draws = resampling.means(values)
    scale = list(VIEW_NUMBERS).index(SCALE)
    present = np.flatnonzero(~np.isnan(values[:, scale]))
    draws[:, scale] = resampling.percentile(values[present, scale], present, 50)
    return draws


def view_numbers(views: Sequence[ViewScore]) -> Float64[ndarray, "n k"]:
    """Return the ``VIEW_NUMBERS`` of each view, NaN where it has no value."""
    rows = [[get(view) for get in VIEW_NUMBERS.values()] for view in views]
    return np.array(rows, dtype=np.float64).reshape(len(views), len(VIEW_NUMBERS))


def protocol_indices(view_ids: Sequence[str]) -> list[int]:
    """Return each view's index in its full protocol, the four digits its id ends with; else every view's place."""
    tails = [view_id.rpartition("/")[2] for view_id in view_ids]
    if all(_INDEX.fullmatch(tail) for tail in tails) and tails == sorted(tails):
        return [int(tail) for tail in tails]
    return list(range(len(tails)))


def badness(view: ViewScore) -> float:
    """Return what views are sorted by: native AbsRel; no prediction at all and overflows are the worst."""
    if view.native is None or not math.isfinite(view.native.abs_rel):
        return math.inf
    return view.native.abs_rel


def _mean(values: Sequence[float]) -> float | None:
    """Return the correctly rounded mean, None of nothing, inf where a value is not finite."""
    if not values:
        return None
    if not all(math.isfinite(value) for value in values):
        return math.inf
    try:
        return math.fsum(values) / len(values)
    except OverflowError:
        return math.inf


def _mean_metrics(metrics: Sequence[DepthMetrics]) -> DepthMetrics | None:
    means = {name: _mean([getattr(one, name) for one in metrics]) for name in _METRICS}
    if any(mean is None for mean in means.values()):
        return None
    return DepthMetrics(**{name: mean for name, mean in means.items() if mean is not None})


def _is_finite(metrics: DepthMetrics | None) -> bool:
    return metrics is not None and all(math.isfinite(value) for value in vars(metrics).values())


def _metrics_dict(metrics: DepthMetrics | None) -> dict[str, float | None]:
    if metrics is None:
        return dict.fromkeys(_METRICS)
    return {
        "abs_rel": rounded(metrics.abs_rel),
        "rmse_cm": rounded(metrics.rmse_cm),
        "mae_cm": rounded(metrics.mae_cm),
        "delta1": rounded(metrics.delta1),
    }


def _within_dict(within_mm: Mapping[int, float | None] | Mapping[int, float]) -> dict[str, float | None]:
    return {str(tolerance): rounded(share) for tolerance, share in within_mm.items()}


def _table_dict(table: Table) -> dict[str, Any]:
    return {
        "views": table.views,
        "views_scored": table.views_scored,
        "coverage": rounded(table.coverage),
        "ranked": table.ranked,
        "native": _metrics_dict(table.native),
        "scaled": _metrics_dict(table.scaled),
        "scale_median": rounded(table.scale_median),
        "within_mm": _within_dict(table.within_mm),
        "ci95": _intervals_dict(table.intervals),
    }


def _intervals_dict(intervals: Mapping[str, Interval | None]) -> dict[str, Any]:
    """Return the intervals nested as the table's own numbers are."""
    nested: dict[str, Any] = {}
    for name, ends in intervals.items():
        group, _, key = name.rpartition(".")
        target = nested.setdefault(group, {}) if group else nested
        target[key] = None if ends is None else [rounded(end, INTERVAL_DIGITS) for end in ends]
    return nested


def _view_dict(view: ViewScore) -> dict[str, Any]:
    return {
        "view_id": view.view_id,
        "scored_px": view.scored_px,
        "coverage": rounded(view.coverage),
        "scale": rounded(view.scale),
        "native": _metrics_dict(view.native),
        "scaled": _metrics_dict(view.scaled),
        "within_mm": _within_dict(view.within_mm),
    }
