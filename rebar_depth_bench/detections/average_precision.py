"""Precision over recall of detections by confidence, and its average."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from rebar_depth_bench.scoring.bootstrap import MIN_BLOCKS, Interval, Resampling, interval

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
        view_counts = resampling.view_counts if blocks >= MIN_BLOCKS else np.empty((0, 0))
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
