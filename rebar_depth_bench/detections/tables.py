"""Result of a detector of crossings: numbers of each config and of all together, with intervals, and JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from rebar_depth_bench import software_version
from rebar_depth_bench.bar_crossings.crossings_file import CrossingsSource
from rebar_depth_bench.detections.matching import CHANCE_DRAWS, DETECTIONS_PROTOCOL, HEADLINE_MM, LIMITS_MM, SUMS
from rebar_depth_bench.extended.measures import percentile, pooled
from rebar_depth_bench.scoring.bootstrap import INTERVALS, Interval, Resampling, interval
from rebar_depth_bench.scoring.columns import rounded, rounded_interval
from rebar_depth_bench.submission.declaration import SubmissionMeta

COUNTS = SUMS[:7]
"""Sums that a table has as numbers."""

# Precision over recall of detections by confidence, and its average.

_MAX_CURVE_POINTS = 50


@dataclass(frozen=True, eq=False)
class RankedDetections:
    """Detections that count, of all views: confidence, whether they are correct, and the position of their view.

    ``positives`` holds the number of judged crossings of each view.
    """

    confidence: Float64[ndarray, " n"]
    correct: Bool[ndarray, " n"]
    view: Int64[ndarray, " n"]
    positives: Int64[ndarray, " v"]

    def curve(self) -> tuple[Float64[ndarray, " k"], Float64[ndarray, " k"]]:
        """Return recall and precision of all detections from each confidence on, most confident first."""
        ordered, ends = self._order()
        recall, precision = _curve(self.correct[ordered].astype(np.float64), np.ones(len(ordered)), ends)
        return recall / max(int(self.positives.sum()), 1), precision

    def drawn_points(self) -> list[tuple[float, float]]:
        """Return at most 50 points (recall, precision) of the curve."""
        recall, precision = self.curve()
        chosen = np.unique(np.linspace(0, len(recall) - 1, min(len(recall), _MAX_CURVE_POINTS)).astype(np.int64))
        return [(float(recall[i]), float(precision[i])) for i in chosen]

    def average(self) -> float | None:
        """Return the area below the highest precision at each recall or above; None without crossings."""
        total = int(self.positives.sum())
        return _area(*self.curve()) if total else None

    def interval(self, resampling: Resampling) -> Interval | None:
        """Return the interval of the average precision over resampled views."""
        ordered, ends = self._order()
        correct, view = self.correct[ordered].astype(np.float64), self.view[ordered]
        blocks = resampling.blocks(np.flatnonzero(self.positives))
        view_counts = resampling.view_counts if blocks.are_enough else np.empty((0, 0))
        draws = np.full(len(view_counts), np.nan)
        for draw, counts in enumerate(view_counts):
            total = float(counts @ self.positives)
            if total:
                weight = counts[view]
                recall, precision = _curve(correct * weight, weight, ends)
                draws[draw] = _area(recall / total, precision)
        return interval(draws, blocks)

    def _order(self) -> tuple[Int64[ndarray, " n"], Int64[ndarray, " k"]]:
        """Return the detections by descending confidence, and the last one of each confidence."""
        ordered = np.argsort(-self.confidence, kind="stable")
        values = self.confidence[ordered]
        ends = np.flatnonzero(np.append(values[:-1] != values[1:], True)) if len(values) else np.empty(0, np.int64)
        return ordered, ends


def _curve(
    correct: Float64[ndarray, " n"], weight: Float64[ndarray, " n"], ends: Int64[ndarray, " k"]
) -> tuple[Float64[ndarray, " k"], Float64[ndarray, " k"]]:
    """Return the numbers of correct detections and the precision at ``ends``."""
    found, all_ = np.cumsum(correct)[ends], np.cumsum(weight)[ends]
    return found, found / np.maximum(all_, 1e-300)


def _area(recall: Float64[ndarray, " k"], precision: Float64[ndarray, " k"]) -> float:
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    return float(np.sum(np.diff(recall, prepend=0.0) * envelope))


@dataclass(frozen=True, eq=False)
class ViewDetections:
    """Detections of one view compared with its crossings.

    ``sums`` are the ``SUMS`` of the rows with enough confidence, and ``position_mm`` and ``normal_deg`` the errors
    of the correct ones among them, the latter where a normal is given. ``confidence``, ``counts`` and ``correct``
    describe all rows for average precision, the last two by limit in mm: whether a row counts, and whether it is
    correct.

    ``chance`` has the sums of as many random points as detections that count, for each draw, and
    ``chance_position_mm`` the errors of the correct ones of all draws; ``chance_at`` has, by limit in mm, how many
    are correct and how many count in each draw.
    """

    view_id: str
    sums: Mapping[str, float]
    position_mm: Float64[ndarray, " k"]
    normal_deg: Float64[ndarray, " l"]
    confidence: Float64[ndarray, " n"]
    counts: Mapping[int, Bool[ndarray, " n"]]
    correct: Mapping[int, Bool[ndarray, " n"]]
    chance: Mapping[str, Float64[ndarray, " d"]]
    chance_at: Mapping[int, Int64[ndarray, "d 2"]]
    chance_position_mm: Float64[ndarray, " m"]

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object of the view."""
        return {
            "view_id": self.view_id,
            "crossings": int(self.sums["crossings"]),
            **{name: int(self.sums[name]) for name in ("detections", "matched", "false", "ignored")},
            "position_mm": rounded(percentile(self.position_mm, 50)) if len(self.position_mm) else None,
        }


@dataclass(frozen=True, eq=False)
class DetectionTable:
    """Numbers of one config, or of all together.

    ``counts`` are sums over the views. ``numbers`` has the numbers of ``ratios``, the average precisions and
    ``ERRORS`` by name, ``intervals`` their 95 % intervals, and ``chance`` the numbers of random points; None where
    undefined or unknown. ``curves`` has the points (recall, precision) by limit in mm.
    """

    views: int
    counts: Mapping[str, int]
    numbers: Mapping[str, float | None]
    intervals: Mapping[str, Interval | None]
    chance: Mapping[str, float | None]
    curves: Mapping[int, Sequence[tuple[float, float]]]

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object of the table."""
        numbers = {name: rounded(value) for name, value in self.numbers.items()}
        average = {str(limit): numbers.pop(f"average_precision_{limit}mm") for limit in LIMITS_MM}
        return {
            "views": self.views,
            **self.counts,
            **numbers,
            "average_precision": average,
            "ci95": {name: rounded_interval(ends) for name, ends in self.intervals.items()},
            "chance": {name: rounded(value) for name, value in self.chance.items()},
            "precision_recall": {
                str(limit): [[rounded(recall), rounded(precision)] for recall, precision in curve]
                for limit, curve in self.curves.items()
            },
        }


@dataclass(frozen=True, eq=False)
class DetectionResult:
    """Result of a file of detections; ``least_confidence`` is the threshold of the headline, None for all rows.

    ``outside`` counts rows of views that are not part of the protocol, because they have no scored pixel.
    """

    meta: SubmissionMeta
    sha256: str
    dataset_digest: str
    dataset_version: str
    source: CrossingsSource
    least_confidence: float | None
    has_confidence: bool
    pooled: DetectionTable
    tables: Mapping[str, DetectionTable]
    views: Sequence[ViewDetections]
    outside: int

    def to_dict(self) -> dict[str, Any]:
        """Return the result as a JSON-compatible object."""
        return {
            "protocol": DETECTIONS_PROTOCOL,
            "dataset": {
                "digest": self.dataset_digest,
                "version": self.dataset_version,
                "crossings": asdict(self.source),
            },
            "submission": {
                "method": self.meta.method,
                "sha256": self.sha256,
                **self.meta.declaration.to_dict(),
            },
            "software": {"version": software_version()},
            "intervals": dict(INTERVALS),
            "limit_mm": HEADLINE_MM,
            "least_confidence": rounded(self.least_confidence),
            "has_confidence": self.has_confidence,
            "rows_outside_of_protocol": self.outside,
            "views_scored": self.pooled.views,
            **{name: value for name, value in self.pooled.to_dict().items() if name != "views"},
            "tables": {name: table.to_dict() for name, table in self.tables.items()},
            "views": [view.to_dict() for view in self.views],
        }

    def to_json(self) -> str:
        """Return the result as JSON, the same bytes for the same input."""
        return json.dumps(self.to_dict(), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


ERRORS = {
    "position_mm": ("position_mm", 50),
    "position_p95_mm": ("position_mm", 95),
    "normal_deg": ("normal_deg", 50),
    "normal_p95_deg": ("normal_deg", 95),
}
"""Errors of correct detections: sample and percentile."""


def ratios(sums: Mapping[str, Float64[ndarray, " *k"]]) -> dict[str, Float64[ndarray, " *k"]]:
    """Return the shares, bias and spread that follow from ``SUMS``, NaN where undefined.

    The bias is the mean offset of detections near judged crossings along an axis of the camera, and the spread the
    root mean square distance of these detections from their mean offset.
    """
    matched, counted, near = sums["matched"], sums["matched"] + sums["false"], sums["near"]
    with np.errstate(invalid="ignore", divide="ignore"):
        bias = {f"{axis}_bias_mm": sums[f"{axis}_mm"] / near for axis in ("right", "down", "along")}
        variance = sums["square_mm2"] / near - sum(mean**2 for mean in bias.values())
        return {
            "precision": matched / counted,
            "recall": matched / sums["crossings"],
            "f1": 2 * matched / (counted + sums["crossings"]),
            "node_recall": sums["nodes_found"] / sums["nodes"],
            **bias,
            "spread_mm": np.sqrt(np.maximum(variance, 0.0)),
        }


def tabulate_detections(views: Sequence[ViewDetections], resampling: Resampling | None) -> DetectionTable:
    """Return the table of some views, without intervals if there is no ``resampling``."""
    by_view = {name: np.array([view.sums[name] for view in views], dtype=np.float64) for name in SUMS}
    defined = ratios(by_view)
    totals = {name: values.sum(keepdims=True) for name, values in by_view.items()}
    numbers = {name: _number(value.item()) for name, value in ratios(totals).items()}
    random = {name: np.zeros(CHANCE_DRAWS) + sum(view.chance[name] for view in views) for name in SUMS}
    chance = {name: _mean(values) for name, values in ratios(random).items()}
    intervals: dict[str, Interval | None] = dict.fromkeys(numbers)
    if resampling is not None:
        draws = ratios({name: resampling.view_counts @ values for name, values in by_view.items()})
        for name, values in draws.items():
            intervals[name] = interval(values, resampling.blocks(np.flatnonzero(~np.isnan(defined[name]))))

    curves = {}
    for limit in LIMITS_MM:
        name, ranked = f"average_precision_{limit}mm", _ranked(views, limit)
        numbers[name] = ranked.average()
        intervals[name] = None if resampling is None else ranked.interval(resampling)
        matched, counted = np.zeros((2, CHANCE_DRAWS)) + sum(view.chance_at[limit].T for view in views)
        with np.errstate(invalid="ignore", divide="ignore"):  # One point of the curve: precision times recall.
            chance[name] = _mean(matched**2 / (counted * totals["crossings"]))
        curves[limit] = ranked.drawn_points()

    samples = [{"position_mm": view.position_mm, "normal_deg": view.normal_deg} for view in views]
    random_mm = np.concatenate([np.empty(0), *(view.chance_position_mm for view in views)])
    for name, (sample, percent) in ERRORS.items():
        errors, of_view = pooled(samples, sample)
        numbers[name] = percentile(errors, percent) if len(errors) else None
        intervals[name] = None
        if resampling is not None:
            estimates = resampling.percentile(errors, of_view, percent)
            intervals[name] = interval(estimates, resampling.blocks(of_view))
        has_chance = sample == "position_mm" and len(random_mm) > 0
        chance[name] = percentile(random_mm, percent) if has_chance else None
    return DetectionTable(
        views=len(views),
        counts={name: int(totals[name].item()) for name in COUNTS},
        numbers=numbers,
        intervals=intervals,
        chance=chance,
        curves=curves,
    )


def _mean(values: Float64[ndarray, " d"]) -> float | None:
    """Return the mean over the draws in which a number is defined."""
    defined = values[~np.isnan(values)]
    return _number(defined.mean()) if len(defined) else None


def _number(value: float) -> float | None:
    return round(float(value), 12) + 0.0 if math.isfinite(value) else None  # Without rounding errors, not -0.0.


def _ranked(views: Sequence[ViewDetections], limit_mm: int) -> RankedDetections:
    """Return the detections of all views that count for the average precision at a limit."""
    kept = [view.counts[limit_mm] for view in views]
    confidence = [view.confidence[rows] for view, rows in zip(views, kept, strict=True)]
    correct = [view.correct[limit_mm][rows] for view, rows in zip(views, kept, strict=True)]
    return RankedDetections(
        np.concatenate([np.empty(0), *confidence]),
        np.concatenate([np.empty(0, bool), *correct]),
        np.repeat(np.arange(len(views)), list(map(len, confidence))),
        np.array([view.sums["crossings"] for view in views], dtype=np.int64),
    )
