"""Result of a detector of crossings: numbers of each config and of all together, with intervals, and JSON."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from rebar_depth_bench import software_version
from rebar_depth_bench.bar_crossings.crossings_file import CrossingsSource
from rebar_depth_bench.bar_crossings.definition import CROSSINGS_PROTOCOL
from rebar_depth_bench.extended.measures import percentile
from rebar_depth_bench.scoring.bootstrap import INTERVALS, Interval, Resampling, interval
from rebar_depth_bench.scoring.columns import rounded, rounded_interval
from rebar_depth_bench.submission.declaration import SubmissionMeta

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


AVERAGE_PRECISION_MM = (5, 10, 20)
"""Limits of average precision, mm."""


@dataclass(frozen=True, eq=False)
class ViewDetections:
    """Detections of one view compared with its crossings.

    ``judged`` counts crossings, ``nodes`` the nodes that they belong to and ``nodes_found`` those with a match;
    ``detections`` counts rows with enough confidence, of which ``matched`` have a crossing, ``ignored`` are
    excused and the others false. ``position_mm`` and ``normal_deg`` are the errors of matched ones, the latter of
    those with a normal. ``confidence``, ``counts`` and ``correct`` describe all rows for average precision, the
    last two by limit: whether a row counts, and whether it is correct.
    """

    view_id: str
    judged: int
    nodes: int
    nodes_found: int
    detections: int
    matched: int
    ignored: int
    position_mm: Float64[ndarray, " k"]
    normal_deg: Float64[ndarray, " l"]
    confidence: Float64[ndarray, " n"]
    counts: Mapping[int, Bool[ndarray, " n"]]
    correct: Mapping[int, Bool[ndarray, " n"]]

    @property
    def false(self) -> int:
        """Number of detections that are neither matched nor ignored."""
        return self.detections - self.matched - self.ignored

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object of the view."""
        return {
            "view_id": self.view_id,
            "crossings": self.judged,
            "detections": self.detections,
            "matched": self.matched,
            "false": self.false,
            "ignored": self.ignored,
            "position_mm": rounded(percentile(self.position_mm, 50)) if len(self.position_mm) else None,
        }


@dataclass(frozen=True, eq=False)
class DetectionTable:
    """Numbers of one config, or of all together.

    ``numbers`` are those of ``tabulate_detections``, ``intervals`` their 95 % intervals (None where unknown), and
    ``curves`` the points (recall, precision) by limit in mm. ``counts`` are sums over the views.
    """

    views: int
    counts: Mapping[str, int]
    numbers: Mapping[str, float | None]
    intervals: Mapping[str, Interval | None]
    curves: Mapping[int, Sequence[tuple[float, float]]]

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object of the table."""
        average = {
            str(limit): rounded(self.numbers[f"average_precision_{limit}mm"]) for limit in AVERAGE_PRECISION_MM
        }
        plain = {name: rounded(value) for name, value in self.numbers.items() if "average_precision" not in name}
        curves = {
            str(limit): [[rounded(recall), rounded(precision)] for recall, precision in curve]
            for limit, curve in self.curves.items()
        }
        intervals = {name: rounded_interval(ends) for name, ends in self.intervals.items()}
        return {
            "views": self.views, **self.counts, **plain, "average_precision": average, "ci95": intervals,
            "precision_recall": curves,
        }  # fmt: skip


@dataclass(frozen=True, eq=False)
class DetectionResult:
    """Result of a file of detections; ``least_confidence`` is the threshold of matching, None for all rows.

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
        source = {"file": self.source.file, "sha256": self.source.sha256}
        return {
            "protocol": CROSSINGS_PROTOCOL,
            "dataset": {"digest": self.dataset_digest, "version": self.dataset_version, "crossings": source},
            "submission": {
                "method": self.meta.method,
                "sha256": self.sha256,
                **self.meta.declaration.to_dict(),
            },
            "software": {"version": software_version()},
            "intervals": dict(INTERVALS),
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


def tabulate_detections(views: Sequence[ViewDetections], resampling: Resampling | None) -> DetectionTable:
    """Return the table of some views, without intervals if there is no ``resampling``."""
    counts = {
        "crossings": sum(view.judged for view in views),
        "nodes": sum(view.nodes for view in views),
        "detections": sum(view.detections for view in views),
        "matched": sum(view.matched for view in views),
        "false": sum(view.false for view in views),
        "ignored": sum(view.ignored for view in views),
    }
    ranked = {limit: _ranked(views, limit) for limit in AVERAGE_PRECISION_MM}
    shares = {
        name: _share(np.array([[top(view), all_(view)] for view in views]))
        for name, (top, all_) in _SHARES.items()
    }
    errors = {name: _error(views, attribute, percent) for name, (attribute, percent) in _ERRORS.items()}
    average = {f"average_precision_{limit}mm": of_one.average() for limit, of_one in ranked.items()}
    intervals: dict[str, Interval | None] = dict.fromkeys((*shares, *average, *errors))
    if resampling is not None:
        intervals = _intervals(views, resampling, ranked)
    curves = {limit: of_one.drawn_points() for limit, of_one in ranked.items()}
    return DetectionTable(len(views), counts, {**shares, **average, **errors}, intervals, curves)


_Counter = Callable[[ViewDetections], int]

_SHARES: Mapping[str, tuple[_Counter, _Counter]] = {
    "precision": (lambda view: view.matched, lambda view: view.matched + view.false),
    "recall": (lambda view: view.matched, lambda view: view.judged),
    "f1": (lambda view: 2 * view.matched, lambda view: view.matched + view.false + view.judged),
    "node_recall": (lambda view: view.nodes_found, lambda view: view.nodes),
}
"""Shares as numerator and denominator of one view; both are summed over views."""

_ERRORS = {
    "position_mm": ("position_mm", 50),
    "position_p95_mm": ("position_mm", 95),
    "normal_deg": ("normal_deg", 50),
    "normal_p95_deg": ("normal_deg", 95),
}
"""Errors of matched detections: sample and percentile."""


def _ranked(views: Sequence[ViewDetections], limit_mm: int) -> RankedDetections:
    kept = [view.counts[limit_mm] for view in views]
    return RankedDetections(
        np.concatenate([np.empty(0), *(view.confidence[keep] for view, keep in zip(views, kept, strict=True))]),
        np.concatenate(
            [
                np.empty(0, bool),
                *(view.correct[limit_mm][keep] for view, keep in zip(views, kept, strict=True)),
            ]
        ),
        np.repeat(np.arange(len(views)), [int(np.count_nonzero(keep)) for keep in kept]),
        np.array([view.judged for view in views], dtype=np.int64),
    )


def _share(parts: ndarray) -> float | None:
    numerator, denominator = parts.reshape(-1, 2).sum(axis=0)
    return float(numerator / denominator) if denominator else None


def _error(views: Sequence[ViewDetections], attribute: str, percent: int) -> float | None:
    values = np.concatenate([np.empty(0), *(getattr(view, attribute) for view in views)])
    return percentile(values, percent) if len(values) else None


def _intervals(
    views: Sequence[ViewDetections], resampling: Resampling, ranked: Mapping[int, RankedDetections]
) -> dict[str, Interval | None]:
    """Return the 95 % intervals over resampled views."""
    intervals: dict[str, Interval | None] = {}
    for name, (top, all_) in _SHARES.items():
        parts = np.array([[top(view), all_(view)] for view in views], dtype=np.float64)
        sums = resampling.view_counts @ parts
        with np.errstate(invalid="ignore", divide="ignore"):
            draws = sums[:, 0] / sums[:, 1]
        intervals[name] = interval(draws, resampling.blocks(np.flatnonzero(parts[:, 1])))
    for limit, of_one in ranked.items():
        intervals[f"average_precision_{limit}mm"] = of_one.interval(resampling)
    for name, (attribute, percent) in _ERRORS.items():
        values = [getattr(view, attribute) for view in views]
        samples = np.concatenate([np.empty(0), *values])
        view = np.repeat(np.arange(len(views)), [len(of_one) for of_one in values])
        draws = resampling.percentile(samples, view, percent) if len(samples) else np.empty(0)
        intervals[name] = interval(draws, resampling.blocks(view))
    return intervals
