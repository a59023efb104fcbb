"""Reach of a depth method: the distance up to which nearly all judged crossings are within a limit.

Judged crossings are binned by the true depth z of their tie points (``CROSSING_EDGES_M``). A bin is tested if it
has ``MIN_CROSSINGS`` or more judged crossings from ``MIN_REACH_VIEWS`` or more views, and it fulfils the limit
if at least ``SHARE`` of them are within it; a crossing that is not located fails. From the nearest tested bin
on, the reach is the farthest edge up to which every bin is tested and fulfils the limit.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.extended.crossings import CROSSING_EDGES_M
from rebar_depth_bench.extended.measures import Samples
from rebar_depth_bench.scoring.bootstrap import Interval, Resampling, interval
from rebar_depth_bench.scoring.columns import rounded, rounded_interval

SHARE = 0.95
"""Share of the judged crossings of a bin that must be within the limit."""

MIN_CROSSINGS = 50
MIN_REACH_VIEWS = 5

REACH_MM = (5, 2)
"""Limits whose reach is stated, mm."""

Verdict = Literal["up to", "at least", "not met", "none tested"]
"""Kind of a reach.

``up to``: the next bin is tested and does not fulfil the limit; ``at least``: it is not tested; ``not met``: the
nearest tested bin does not fulfil it; ``none tested``: there is no tested bin.
"""


@dataclass(frozen=True)
class ReachBin:
    """Bin of distance: the numbers of its judged crossings and of their views, and the share within the limit.

    ``interval`` is the 95 % interval of the share, None for few views.
    """

    low_m: float
    high_m: float
    crossings: int
    views: int
    share: float
    interval: Interval | None

    @property
    def tested(self) -> bool:
        """Whether the bin has enough crossings of enough views."""
        return self.crossings >= MIN_CROSSINGS and self.views >= MIN_REACH_VIEWS


@dataclass(frozen=True)
class Reach:
    """Reach for one limit: see the module docstring.

    ``distance_m`` is None for the verdicts ``not met`` and ``none tested``. ``interval`` holds edges of bins,
    where 0 stands for ``not met``; it is None if no bin is tested, or one has few blocks of views. ``bins`` are
    the bins with judged crossings.
    """

    limit_mm: int
    verdict: Verdict
    distance_m: float | None
    interval: Interval | None
    bins: tuple[ReachBin, ...]

    @property
    def tested_m(self) -> Interval | None:
        """Nearest and farthest edge of the tested bins that follow each other, metres; None without any."""
        run = self.bins_tested
        return (run[0].low_m, run[-1].high_m) if run else None

    @property
    def bins_tested(self) -> tuple[ReachBin, ...]:
        """Tested bins that follow each other without a gap, from the nearest one on."""
        return tuple(_tested_run(self.bins))

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object of the reach."""
        return {
            "limit_mm": self.limit_mm,
            "verdict": self.verdict,
            "distance_m": self.distance_m,
            "ci95": rounded_interval(self.interval),
            "tested_m": None if self.tested_m is None else list(self.tested_m),
            "bins": [
                {
                    "low_m": one.low_m,
                    "high_m": one.high_m,
                    "crossings": one.crossings,
                    "views": one.views,
                    "share": rounded(one.share),
                    "ci95": rounded_interval(one.interval),
                }
                for one in self.bins
            ],
        }


def reaches(by_view: Sequence[Samples], resampling: Resampling) -> tuple[Reach, ...]:
    """Return the reach for each of ``REACH_MM`` from the crossing samples of all views of a config.

    ``resampling`` draws the views for the intervals; where there are several scenes, it draws whole scenes.
    """
    z_m, view = pooled(by_view, "crossing_z_m")
    error_mm, _ = pooled(by_view, "tie_judged_mm")
    return tuple(_reach(z_m, error_mm <= limit, view, resampling, limit) for limit in REACH_MM)


def pooled(by_view: Sequence[Samples], name: str) -> tuple[Float64[ndarray, " m"], ndarray]:
    """Return the samples of all views one after the other, and the position of each one's view."""
    samples = [samples.get(name, np.empty(0)) for samples in by_view]
    return np.concatenate([np.empty(0), *samples]), np.repeat(np.arange(len(samples)), list(map(len, samples)))


def _reach(
    z_m: Float64[ndarray, " m"], passes: ndarray, view: ndarray, resampling: Resampling, limit_mm: int
) -> Reach:
    bins, draws, blocks = [], [], []
    for low_m, high_m in pairwise(CROSSING_EDGES_M):
        inside = (z_m >= low_m) & (z_m < high_m)
        if not inside.any():
            continue
        values, views = passes[inside].astype(np.float64), view[inside]
        draws.append(resampling.pooled_means(values, views))
        blocks.append(resampling.blocks(views))
        count, ends = len(np.unique(views)), interval(draws[-1], blocks[-1])
        bins.append(ReachBin(low_m, high_m, len(values), count, float(values.mean()), ends))
    run = _tested_run(bins)
    if not run:
        return Reach(limit_mm, "none tested", None, None, tuple(bins))
    edges_m = np.array([0.0, *(one.high_m for one in run)])
    met = np.array([one.share >= SHARE for one in run])
    reached = _leading(met[None])[0]
    tested = slice(bins.index(run[0]), bins.index(run[-1]) + 1)
    shares = np.stack(draws[tested], axis=1)
    drawn_m = edges_m[_leading(shares >= SHARE)[np.isfinite(shares).all(axis=1)]]
    verdict: Verdict = "not met" if not reached else "at least" if reached == len(run) else "up to"
    return Reach(
        limit_mm,
        verdict,
        float(edges_m[reached]) if reached else None,
        interval(drawn_m, min(blocks[tested], key=lambda one: one.degrees_of_freedom), "inverted_cdf"),
        tuple(bins),
    )


def _tested_run(bins: Iterable[ReachBin]) -> list[ReachBin]:
    """Return the tested bins that follow each other without a gap, from the nearest one on."""
    run: list[ReachBin] = []
    for one in bins:
        if one.tested and (not run or run[-1].high_m == one.low_m):
            run.append(one)
        elif run:
            break
    return run


def _leading(met: ndarray) -> ndarray:
    """Return the number of leading true values of each row."""
    return np.asarray(np.cumprod(met, axis=1).sum(axis=1))
