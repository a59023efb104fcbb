"""Score results: per view, per config, and as JSON."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from statistics import median
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.errors import printable
from rebar_depth_bench.scoring.bootstrap import Interval, Resampling, interval, resample
from rebar_depth_bench.scoring.frames import tables_frame, views_frame
from rebar_depth_bench.scoring.metrics import METRIC_NAMES, DepthMetrics
from rebar_depth_bench.scoring.protocol import MIN_RANKED_COVERAGE, PROTOCOL, WITHIN_MM
from rebar_depth_bench.scoring.rounding import rounded, rounded_interval

if TYPE_CHECKING:
    from pandas import DataFrame

    from rebar_depth_bench.extended.result import ExtendedResult

SCALE_MEDIAN = "scale_median"
"""Key of the median over views of the scale factor in ``VIEW_METRICS``."""

_VIEW_INDEX = re.compile("[0-9]{4}")
_MAX_CONFIGS_SHOWN = 10
_NOTEBOOK_COLUMNS = (
    *("config", "views", "views_scored", "coverage", "ranked"),
    *("native_abs_rel", "native_rmse_cm", "scaled_abs_rel", "scaled_rmse_cm", "scale_median"),
)


@dataclass(frozen=True)
class ViewScore:
    """Metrics of one view; ``scale``, ``native`` and ``scaled`` are None without valid predictions."""

    view_id: str
    scored_px: int
    coverage: float
    scale: float | None
    native: DepthMetrics | None
    scaled: DepthMetrics | None
    within_mm: Mapping[int, float]


def _metric_getter(alignment: str, name: str) -> Callable[[ViewScore], float | None]:
    return lambda view: getattr(getattr(view, alignment), name, None)


def _within_getter(tolerance_mm: int) -> Callable[[ViewScore], float | None]:
    return lambda view: view.within_mm[tolerance_mm]


VIEW_METRICS: Mapping[str, Callable[[ViewScore], float | None]] = {
    "coverage": lambda view: view.coverage,
    **{
        f"{alignment}.{name}": _metric_getter(alignment, name)
        for alignment in ("native", "scaled")
        for name in METRIC_NAMES
    },
    SCALE_MEDIAN: lambda view: view.scale,
    **{f"within_mm.{tolerance_mm}": _within_getter(tolerance_mm) for tolerance_mm in WITHIN_MM},
}
"""Functions that return a view's value of each table metric, by metric name; None where the view has no value."""


@dataclass(frozen=True)
class Table:
    """Metrics of one config: means over its views, and the median of their scale factors.

    ``intervals`` has the 95 % block bootstrap interval of each of ``VIEW_METRICS``, None where it is undefined.
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


@dataclass(frozen=True, repr=False)
class Result:
    """Result of scoring one submission, with the digests and versions of its inputs."""

    method: str
    submission_sha256: str
    dataset_digest: str
    dataset_version: str
    software_version: str
    tables: Mapping[str, Table]
    views: Sequence[ViewScore]
    extended: ExtendedResult | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the result as a JSON-compatible object; extended measures, if computed, are its last entry."""
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

    def to_pandas(self, rows: Literal["tables", "views", "extended"] = "tables") -> DataFrame:
        """Return the numbers of the JSON as a frame.

        ``"tables"`` has one row per config, with the 95 % interval of each metric in the columns
        ``<metric>_low`` and ``<metric>_high``; ``"views"`` has one row per view; ``"extended"`` has one row per
        config, alignment and extended measure. Raises ``ValueError`` for other rows, and for ``"extended"`` if the
        result has no extended measures.
        """
        if rows == "tables":
            return tables_frame([self.to_dict()])
        if rows == "views":
            return views_frame(self.to_dict())
        if rows == "extended" and self.extended is not None:
            return self.extended.to_pandas()
        raise ValueError(f"rows is {rows!r}, expected 'tables', 'views', or 'extended' for a result that has them")

    def __repr__(self) -> str:
        """Return the method, the numbers of the first ten configs, and the number of views."""
        shown = [f"  {printable(name)}: {_describe_table(table)}" for name, table in self.tables.items()]
        omitted = [f"  ... and {len(shown) - _MAX_CONFIGS_SHOWN} more"] if len(shown) > _MAX_CONFIGS_SHOWN else []
        head = f"<Result of {printable(self.method)}: {len(shown)} configs, {len(self.views)} views"
        return "\n".join([head, *shown[:_MAX_CONFIGS_SHOWN], *omitted]) + ">"

    def _repr_html_(self) -> str:
        """Return the method, its provenance and the tables for notebooks."""
        frame = self.to_pandas()[[*_NOTEBOOK_COLUMNS]]
        frame["config"] = frame["config"].map(printable)
        provenance = f"protocol {PROTOCOL}, dataset {self.dataset_version} ({self.dataset_digest[:19]})"
        head = f"<p><b>{escape(printable(self.method))}</b>, {escape(printable(provenance))}</p>"
        return head + str(frame.to_html(index=False, na_rep="–", float_format="{:.4g}".format, border=0))

    def to_json(self) -> bytes:
        """Return the result as UTF-8 JSON; the same archive and dataset give the same bytes on every machine."""
        return (json.dumps(self.to_dict(), indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()


def tabulate(views: Sequence[ViewScore]) -> Table:
    """Return the table of a config from the scores of its scored views.

    A config with an infinite metric (a prediction so large that its square overflows) is not ranked, and the
    metric is written as null: an overflow must not improve the rank.
    """
    predicted = [view for view in views if view.native is not None]
    native = _mean_metrics([view.native for view in predicted if view.native])
    scaled = _mean_metrics([view.scaled for view in predicted if view.scaled])
    coverage = mean([view.coverage for view in views])
    complete = bool(views) and len(predicted) == len(views)
    finite = all(_is_finite(metrics) for metrics in (native, scaled))
    return Table(
        views=len(views),
        views_scored=len(predicted),
        coverage=coverage,
        ranked=complete and finite and coverage is not None and coverage >= MIN_RANKED_COVERAGE,
        native=native,
        scaled=scaled,
        scale_median=median([view.scale for view in predicted if view.scale is not None]) if predicted else None,
        within_mm={t: mean([view.within_mm[t] for view in views]) for t in WITHIN_MM},
        intervals=view_intervals(views) if views else dict.fromkeys(VIEW_METRICS),
    )


def view_intervals(views: Sequence[ViewScore]) -> dict[str, Interval | None]:
    """Return the 95 % interval of every table metric of the given views."""
    estimates = bootstrap_estimates(views, resample(protocol_indices([view.view_id for view in views])))
    return {name: interval(estimates[:, k]) for k, name in enumerate(VIEW_METRICS)}


def bootstrap_estimates(views: Sequence[ViewScore], resampling: Resampling) -> Float64[ndarray, "draws k"]:
    """Return the table's ``VIEW_METRICS`` in each resample of the views; NaN where undefined."""
    values = view_metric_values(views)
    draws = resampling.means(values)
    scale = list(VIEW_METRICS).index(SCALE_MEDIAN)
    draws[:, scale] = resampling.medians(values[:, scale])
    return draws


def view_metric_values(views: Sequence[ViewScore]) -> Float64[ndarray, "n k"]:
    """Return the ``VIEW_METRICS`` of each view, one row per view; NaN where it has no value."""
    rows = [[get(view) for get in VIEW_METRICS.values()] for view in views]
    return np.array(rows, dtype=np.float64).reshape(len(views), len(VIEW_METRICS))


def protocol_indices(view_ids: Sequence[str]) -> list[int]:
    """Return each view's index in its full camera protocol: the four digits at the end of its view_id.

    If the ids do not all end with four digits, or are not in ascending order, return the positions in the
    sequence.
    """
    suffixes = [view_id.rpartition("/")[2] for view_id in view_ids]
    if all(_VIEW_INDEX.fullmatch(suffix) for suffix in suffixes) and suffixes == sorted(suffixes):
        return [int(suffix) for suffix in suffixes]
    return list(range(len(suffixes)))


def sort_key_worst_first(view: ViewScore) -> float:
    """Return the sort key of a view: native AbsRel, or ``inf`` without predictions or on overflow."""
    if view.native is None or not math.isfinite(view.native.abs_rel):
        return math.inf
    return view.native.abs_rel


def mean(values: Sequence[float]) -> float | None:
    """Return the correctly rounded mean; None for no values, ``inf`` for non-finite values or on overflow."""
    if not values:
        return None
    if not all(math.isfinite(value) for value in values):
        return math.inf
    try:
        return math.fsum(values) / len(values)
    except OverflowError:
        return math.inf


def _mean_metrics(metrics: Sequence[DepthMetrics]) -> DepthMetrics | None:
    means = {name: mean([getattr(view_metrics, name) for view_metrics in metrics]) for name in METRIC_NAMES}
    defined = {name: value for name, value in means.items() if value is not None}
    return DepthMetrics(**defined) if defined else None


def _is_finite(metrics: DepthMetrics | None) -> bool:
    return metrics is not None and all(math.isfinite(value) for value in vars(metrics).values())


def _describe_table(table: Table) -> str:
    if table.native is None or table.scaled is None:
        return "no predictions"
    note = "" if table.ranked else ", not ranked"
    return f"AbsRel {table.native.abs_rel:.4g} native, {table.scaled.abs_rel:.4g} scaled{note}"


def _metrics_dict(metrics: DepthMetrics | None) -> dict[str, float | None]:
    return {name: rounded(getattr(metrics, name, None)) for name in METRIC_NAMES}


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
    """Return the intervals nested like the metrics of the table."""
    nested: dict[str, Any] = {}
    for name, bounds in intervals.items():
        group, _, key = name.rpartition(".")
        target = nested.setdefault(group, {}) if group else nested
        target[key] = rounded_interval(bounds)
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
