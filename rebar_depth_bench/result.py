"""What a score says: per view, per config, and as the bytes of the contract's JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

from rebar_depth_bench.metrics import DepthMetrics
from rebar_depth_bench.protocol import MIN_RANKED_COVERAGE, PROTOCOL, WITHIN_MM

SIGNIFICANT_DIGITS = 12
"""Numbers are written with this many digits: sums may differ in their last bits between processors."""


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


@dataclass(frozen=True)
class Table:
    """One config's numbers: means over its views, the median of their scales."""

    views: int
    views_scored: int
    coverage: float | None
    ranked: bool
    native: DepthMetrics | None
    scaled: DepthMetrics | None
    scale_median: float | None
    within_mm: Mapping[int, float | None]


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

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's JSON object."""
        return {
            "protocol": PROTOCOL,
            "dataset": {"digest": self.dataset_digest, "version": self.dataset_version},
            "submission": {"method": self.method, "sha256": self.submission_sha256},
            "software": {"version": self.software_version},
            "tables": {name: _table_dict(table) for name, table in self.tables.items()},
            "views": [_view_dict(view) for view in self.views],
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
    )


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
    names = ("abs_rel", "rmse_cm", "mae_cm", "delta1")
    means = {name: _mean([getattr(one, name) for one in metrics]) for name in names}
    if any(mean is None for mean in means.values()):
        return None
    return DepthMetrics(**{name: mean for name, mean in means.items() if mean is not None})


def _is_finite(metrics: DepthMetrics | None) -> bool:
    return metrics is not None and all(math.isfinite(value) for value in vars(metrics).values())


def _number(value: float | None) -> float | None:
    """Return a number as it is written: None where undefined."""
    if value is None or not math.isfinite(value):
        return None
    return float(f"{value:.{SIGNIFICANT_DIGITS}g}")


def _metrics_dict(metrics: DepthMetrics | None) -> dict[str, float | None]:
    if metrics is None:
        return dict.fromkeys(("abs_rel", "rmse_cm", "mae_cm", "delta1"))
    return {
        "abs_rel": _number(metrics.abs_rel),
        "rmse_cm": _number(metrics.rmse_cm),
        "mae_cm": _number(metrics.mae_cm),
        "delta1": _number(metrics.delta1),
    }


def _within_dict(within_mm: Mapping[int, float | None] | Mapping[int, float]) -> dict[str, float | None]:
    return {str(tolerance): _number(share) for tolerance, share in within_mm.items()}


def _table_dict(table: Table) -> dict[str, Any]:
    return {
        "views": table.views,
        "views_scored": table.views_scored,
        "coverage": _number(table.coverage),
        "ranked": table.ranked,
        "native": _metrics_dict(table.native),
        "scaled": _metrics_dict(table.scaled),
        "scale_median": _number(table.scale_median),
        "within_mm": _within_dict(table.within_mm),
    }


def _view_dict(view: ViewScore) -> dict[str, Any]:
    return {
        "view_id": view.view_id,
        "scored_px": view.scored_px,
        "coverage": _number(view.coverage),
        "scale": _number(view.scale),
        "native": _metrics_dict(view.native),
        "scaled": _metrics_dict(view.scaled),
        "within_mm": _within_dict(view.within_mm),
    }
