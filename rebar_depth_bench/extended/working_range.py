"""Working range of a depth method for one task: the distances at which nearly all of it is done within a limit.

A task is judged by samples, each of which has a true distance and the error of a measurement, and passes if this
error is at most the limit. Samples are binned by distance (``EDGES_M``). A bin is tested if it has enough samples
of enough views, and if it tells a useful method from a useless one: exact depth passes there, and a plane, one
constant depth per view, fails. A tested bin is

- ``met``, if 95 % or more of its samples pass, and the lower end of the share's 95 % interval is 90 % or more;
- ``likely``, if only the share is high enough;
- ``not met`` otherwise.

Samples of one view are alike. The interval of a share is Wilson's ("Probable inference, the law of succession,
and statistical inference", 1927), with the number of samples divided by their design effect over views (Kish,
"Survey Sampling", 1965). The design effect of a few views is uncertain, so that Student's quantile for one degree
of freedom less than views takes the place of the normal one; where all samples agree, there is no design effect
to estimate, and the quantile is normal. ``benchmarks.working_ranges`` simulates how often a bin is called ``met``
whose true share is 90 %.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from rebar_depth_bench.scoring.bootstrap import Interval
from rebar_depth_bench.scoring.columns import rounded

EDGES_M = (0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0, 14.0, 20.0)
"""Edges of the bins of true distance, metres; a bin includes its lower edge."""

MIN_SAMPLES, MIN_VIEWS = 40, 10
"""Numbers of samples, and of views that they are of, from which on a bin is tested."""

MIN_EXACT_SHARE, MAX_PLANE_SHARE = 0.95, 0.5
"""Share of the samples that exact depth passes at least, and that a plane passes at most, in a tested bin."""

MET_SHARE, MET_LOW = 0.95, 0.9
"""Share, and lower end of its interval, from which on a bin is met."""

_QUANTILE, _Z = 0.975, 1.959963984540054
"""Upper end of the intervals as a probability, and its quantile of the normal distribution."""

State = Literal["met", "likely", "not met", "not tested"]


@dataclass(frozen=True, eq=False)
class TaskSamples:
    """Samples of one task and alignment: parallel arrays.

    ``distance_m`` is the true planar depth and ``view`` the position of the view. ``error_mm`` passes if its
    absolute value is at most ``limit_mm``; NaN or inf: the measurement failed. ``exact_error_mm`` and
    ``plane_error_mm`` are the errors of exact depth and of the plane. ``signed_mm`` is what bias and spread are
    taken of, for errors that are lengths; None: of ``error_mm``.
    """

    limit_mm: float
    view: Int64[ndarray, " n"]
    distance_m: Float64[ndarray, " n"]
    error_mm: Float64[ndarray, " n"]
    exact_error_mm: Float64[ndarray, " n"]
    plane_error_mm: Float64[ndarray, " n"]
    signed_mm: Float64[ndarray, " n"] | None = None


@dataclass(frozen=True)
class RangeBin:
    """Bin of distance: its samples and their views, the share that passes with its interval, and its state.

    ``bias_mm`` and ``spread_mm`` are mean and standard deviation of the errors of what was measured, NaN without
    any. ``exact`` and ``plane`` are the shares that exact depth and a plane pass.
    """

    from_m: float
    to_m: float
    samples: int
    views: int
    share: float
    low: float
    high: float
    bias_mm: float
    spread_mm: float
    exact: float
    plane: float
    state: State

    @property
    def reasons(self) -> dict[str, str]:
        """Reasons why the bin is not tested, as text by the number that each is about; empty if it is tested."""
        found = {
            "samples": (self.samples < MIN_SAMPLES, f"fewer than {MIN_SAMPLES} samples"),
            "views": (self.views < MIN_VIEWS, f"fewer than {MIN_VIEWS} views"),
            "exact": (self.exact < MIN_EXACT_SHARE, f"exact depth passes less than {100 * MIN_EXACT_SHARE:g} %"),
            "plane": (self.plane > MAX_PLANE_SHARE, f"a plane passes more than {100 * MAX_PLANE_SHARE:g} %"),
        }
        return {name: reason for name, (applies, reason) in found.items() if applies}


@dataclass(frozen=True)
class RangeRun:
    """Adjacent tested bins of the same state, from the lower edge of the first to the upper of the last."""

    from_m: float
    to_m: float
    state: State


@dataclass(frozen=True)
class WorkingRange:
    """Working range for one task and alignment: the bins that have samples, nearest first, and their runs.

    ``unbinned`` is the number of samples nearer than the first of ``EDGES_M``, or from the last one on.
    """

    bins: tuple[RangeBin, ...]
    runs: tuple[RangeRun, ...]
    unbinned: int

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object of the working range."""
        return {
            "bins": [
                {key: rounded(value) if isinstance(value, float) else value for key, value in asdict(one).items()}
                for one in self.bins
            ],
            "runs": [asdict(run) for run in self.runs],
        }


def working_range(samples: TaskSamples) -> WorkingRange:
    """Return the working range that the samples of a task show."""
    signed_mm = samples.error_mm if samples.signed_mm is None else samples.signed_mm
    bins = []
    for from_m, to_m, inside in bin_positions(samples.distance_m):
        passes, exact, plane = (
            np.abs(error_mm[inside]) <= samples.limit_mm  # NaN does not pass.
            for error_mm in (samples.error_mm, samples.exact_error_mm, samples.plane_error_mm)
        )
        view, measured_mm = samples.view[inside], signed_mm[inside & np.isfinite(samples.error_mm)]
        low, high = share_interval(passes, view)
        one = RangeBin(
            from_m=from_m,
            to_m=to_m,
            samples=len(view),
            views=len(np.unique(view)),
            share=float(passes.mean()),
            low=low,
            high=high,
            bias_mm=float(measured_mm.mean()) if len(measured_mm) else math.nan,
            spread_mm=float(measured_mm.std()) if len(measured_mm) else math.nan,
            exact=float(exact.mean()),
            plane=float(plane.mean()),
            state="not tested",
        )
        bins.append(one if one.reasons else replace(one, state=verdict(one.share, low)))
    return WorkingRange(tuple(bins), _runs(bins), len(signed_mm) - sum(one.samples for one in bins))


def bin_positions(distance_m: Float64[ndarray, " n"]) -> Iterator[tuple[float, float, Bool[ndarray, " n"]]]:
    """Yield the edges of each bin that has samples, and which samples it has."""
    for from_m, to_m in pairwise(EDGES_M):
        inside = (distance_m >= from_m) & (distance_m < to_m)
        if inside.any():
            yield from_m, to_m, inside


def share_interval(passes: Bool[ndarray, " n"], view: Int64[ndarray, " n"]) -> Interval:
    """Return Wilson's 95 % interval of the share that passes, for samples that are alike within a view.

    Its quantile is Student's for k - 1 degrees of freedom, k views, and normal where all samples agree.
    """
    from scipy.special import stdtrit  # A tenth of a second to import.

    share, k = float(passes.mean()), len(np.unique(view))
    n = len(passes) / design_effect(passes, view)
    z = _Z if share in (0.0, 1.0) else float(stdtrit(max(k - 1, 1), _QUANTILE))
    centre, half = share + z**2 / (2 * n), z * math.sqrt(share * (1 - share) / n + (z / (2 * n)) ** 2)
    low, high = (centre - half) / (1 + z**2 / n), (centre + half) / (1 + z**2 / n)
    return (max(0.0, low) if share > 0 else 0.0, min(1.0, high) if share < 1 else 1.0)


def design_effect(passes: Bool[ndarray, " n"], view: Int64[ndarray, " n"]) -> float:
    """Return the variance of the share over that of independent samples: at least 1, and 1 where all agree.

    The variance is that of a ratio of the sums of k views, k / (k - 1) sum (passed_v - share n_v)^2 / n^2.
    """
    n, share = len(passes), float(passes.mean())
    _, position = np.unique(view, return_inverse=True)
    k = int(position.max()) + 1
    if share in (0.0, 1.0) or k < 2:
        return 1.0
    deviation = np.bincount(position, passes - share)
    variance = k / (k - 1) * float(deviation @ deviation) / n**2
    return max(1.0, variance / (share * (1 - share) / n))


def verdict(share: float, low: float) -> State:
    """Return the state of a tested bin by the share that passes and the lower end of its interval."""
    if share < MET_SHARE:
        return "not met"
    return "met" if low >= MET_LOW else "likely"


def _runs(bins: Sequence[RangeBin]) -> tuple[RangeRun, ...]:
    """Return all runs of adjacent tested bins of the same state."""
    runs: list[RangeRun] = []
    for one in bins:
        if one.state == "not tested":
            continue
        last = runs[-1] if runs else None
        if last is not None and last.to_m == one.from_m and last.state == one.state:
            runs[-1] = RangeRun(last.from_m, one.to_m, one.state)
        else:
            runs.append(RangeRun(one.from_m, one.to_m, one.state))
    return tuple(runs)
