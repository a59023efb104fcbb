"""Result of a detector of crossings: numbers of each config and of all together, with intervals, and JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from rebar_depth_bench import software_version
from rebar_depth_bench.bar_crossings.crossings_file import CrossingsSource
from rebar_depth_bench.bar_crossings.definition import CROSSINGS_PROTOCOL
from rebar_depth_bench.extended.measures import Samples, percentile
from rebar_depth_bench.extended.reach import pooled
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

    ``judged`` counts crossings, ``nodes`` their nodes and ``nodes_found`` the nodes with a match; ``detections``
    counts rows with enough confidence, of which ``matched`` have a crossing, ``ignored`` are excused and the
    others false. ``position_mm`` and ``normal_deg`` are the errors of matched detections, the latter where a
    normal is given. ``confidence``, ``counts`` and ``correct`` describe all rows for average precision, the last
    two by limit: whether a row counts, and whether it is correct.
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

    @property
    def shares(self) -> dict[str, tuple[int, int]]:
        """Numerator and denominator of each of ``SHARES``; both are summed over views."""
        return {
            "precision": (self.matched, self.matched + self.false),
            "recall": (self.matched, self.judged),
            "f1": (2 * self.matched, self.matched + self.false + self.judged),
            "node_recall": (self.nodes_found, self.nodes),
        }

    @property
    def errors(self) -> Samples:
        """Errors of matched detections by name."""
        return {"position_mm": self.position_mm, "normal_deg": self.normal_deg}

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

    ``counts`` are sums over the views. ``numbers`` has ``SHARES``, the average precisions and ``ERRORS`` by name,
    and ``intervals`` their 95 % intervals; None where undefined or unknown. ``curves`` has the points (recall,
    precision) by limit in mm.
    """

    views: int
    counts: Mapping[str, int]
    numbers: Mapping[str, float | None]
    intervals: Mapping[str, Interval | None]
    curves: Mapping[int, Sequence[tuple[float, float]]]

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object of the table."""
        numbers = {name: rounded(value) for name, value in self.numbers.items()}
        average = {str(limit): numbers.pop(f"average_precision_{limit}mm") for limit in AVERAGE_PRECISION_MM}
        return {
            "views": self.views,
            **self.counts,
            **numbers,
            "average_precision": average,
            "ci95": {name: rounded_interval(ends) for name, ends in self.intervals.items()},
            "precision_recall": {
                str(limit): [[rounded(recall), rounded(precision)] for recall, precision in curve]
                for limit, curve in self.curves.items()
            },
        }


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
        return {
            "protocol": CROSSINGS_PROTOCOL,
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


SHARES = ("precision", "recall", "f1", "node_recall")
"""Shares over all views: see ``ViewDetections.shares``."""

ERRORS = {
    "position_mm": ("position_mm", 50),
    "position_p95_mm": ("position_mm", 95),
    "normal_deg": ("normal_deg", 50),
    "normal_p95_deg": ("normal_deg", 95),
}
"""Errors of matched detections: sample and percentile."""


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
    numbers: dict[str, float | None] = {}
    intervals: dict[str, Interval | None] = {}
    curves = {}
    for name in SHARES:
        parts = np.array([view.shares[name] for view in views], dtype=np.float64).reshape(-1, 2)
        numerator, denominator = parts.sum(axis=0)
        numbers[name] = float(numerator / denominator) if denominator else None
        intervals[name] = None
        if resampling is not None:
            sums = resampling.view_counts @ parts
            with np.errstate(invalid="ignore", divide="ignore"):
                draws = sums[:, 0] / sums[:, 1]
            intervals[name] = interval(draws, resampling.blocks(np.flatnonzero(parts[:, 1])))
    for limit in AVERAGE_PRECISION_MM:
        name, ranked = f"average_precision_{limit}mm", _ranked(views, limit)
        numbers[name] = ranked.average()
        intervals[name] = None if resampling is None else ranked.interval(resampling)
        curves[limit] = ranked.drawn_points()
    for name, (sample, percent) in ERRORS.items():
        errors, view = pooled([view.errors for view in views], sample)
        numbers[name] = percentile(errors, percent) if len(errors) else None
        intervals[name] = None
        if resampling is not None:
            draws = resampling.percentile(errors, view, percent)
            intervals[name] = interval(draws, resampling.blocks(view))
    return DetectionTable(len(views), counts, numbers, intervals, curves)


def _ranked(views: Sequence[ViewDetections], limit_mm: int) -> RankedDetections:
    """Return the detections of all views that count for the average precision at a limit."""
    kept = [view.counts[limit_mm] for view in views]
    confidence = [view.confidence[rows] for view, rows in zip(views, kept, strict=True)]
    correct = [view.correct[limit_mm][rows] for view, rows in zip(views, kept, strict=True)]
    return RankedDetections(
        np.concatenate([np.empty(0), *confidence]),
        np.concatenate([np.empty(0, bool), *correct]),
        np.repeat(np.arange(len(views)), list(map(len, confidence))),
        np.array([view.judged for view in views], dtype=np.int64),
    )
