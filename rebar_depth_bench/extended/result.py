"""What the extended measures say: per view, per config with intervals, and as a part of the result's JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from rebar_depth_bench.extended.measures import EXTENDED_PROTOCOL, STATISTICS, Measure, Samples, Statistic
from rebar_depth_bench.scoring.bootstrap import Interval, Resampling, interval, resample
from rebar_depth_bench.scoring.rounding import INTERVAL_DIGITS, rounded


@dataclass(frozen=True)
class Estimate:
    """A number of a table, its 95 % block bootstrap interval, and how many samples it stands on; None of none.

    A value that is None although there are samples is one that ``Measure.convert`` does not tell.
    """

    value: float | None
    interval: Interval | None
    samples: int


@dataclass(frozen=True, eq=False)
class ExtendedView:
    """One view's samples by alignment and name, as tables are made of them."""

    view_id: str
    samples: Mapping[str, Samples]


@dataclass(frozen=True)
class ViewNumbers:
    """One view's numbers by alignment and measure: what is kept of a view once its config has a table."""

    view_id: str
    numbers: Mapping[str, Mapping[str, float | None]]


@dataclass(frozen=True)
class ExtendedTable:
    """One config's numbers by alignment and measure."""

    views: int
    numbers: Mapping[str, Mapping[str, Estimate]]


@dataclass(frozen=True, eq=False)
class ExtendedResult:
    """Everything the extended measures say of an archive; ``measures`` holds those of each alignment, in order."""

    measures: Mapping[str, Sequence[Measure]]
    tables: Mapping[str, ExtendedTable]
    views: Sequence[ViewNumbers]

    def to_dict(self) -> dict[str, Any]:
        """Return the ``extended`` object of the result's JSON."""
        return {
            "protocol": EXTENDED_PROTOCOL,
            "tables": {name: _table_dict(table) for name, table in self.tables.items()},
            "views": [_view_dict(view) for view in self.views],
        }


def view_numbers(view: ExtendedView, measures: Mapping[str, Sequence[Measure]]) -> ViewNumbers:
    """Return the measures of one view by itself, None where it has no sample."""
    numbers = {
        alignment: {one.name: view_value(view, alignment, one) for one in of_alignment}
        for alignment, of_alignment in measures.items()
    }
    return ViewNumbers(view.view_id, numbers)


def view_value(view: ExtendedView, alignment: str, measure: Measure) -> float | None:
    """Return a measure of one view by itself, None where it has no sample."""
    samples = view.samples[alignment][measure.sample]
    return measure.number(STATISTICS[measure.statistic](samples)) if len(samples) else None


def tabulate_extended(
    views: Sequence[ExtendedView], indices: Sequence[int], measures: Mapping[str, Sequence[Measure]]
) -> ExtendedTable:
    """Return a config's table; ``indices`` are the views' in the full protocol, ascending."""
    resampling = resample(indices)
    numbers = {
        alignment: _estimates(of_alignment, [view.samples[alignment] for view in views], resampling)
        for alignment, of_alignment in measures.items()
    }
    return ExtendedTable(len(views), numbers)


def _estimates(
    measures: Sequence[Measure], by_view: Sequence[Samples], resampling: Resampling
) -> dict[str, Estimate]:
    """Return each measure's estimate by name; measures of the same statistic of the same samples share it."""
    statistics: dict[tuple[str, Statistic], Estimate] = {}
    for one in measures:
        key = (one.sample, one.statistic)
        if key not in statistics:
            statistics[key] = estimate(one, [samples[one.sample] for samples in by_view], resampling)
    return {one.name: converted(one, statistics[one.sample, one.statistic]) for one in measures}


def converted(measure: Measure, statistic: Estimate) -> Estimate:
    """Return a measure's estimate from that of its statistic: value and interval's ends through ``convert``.

    The ends change places, as ``convert`` falls. An end that tells no number is 0; an infinite one leaves none.
    """
    if measure.convert is None or statistic.value is None:
        return statistic
    value = measure.convert(statistic.value)
    ends = None
    if value is not None and statistic.interval is not None:
        low, high = (measure.convert(end) or 0.0 for end in reversed(statistic.interval))
        ends = (low, high) if math.isfinite(high) else None
    return Estimate(value, ends, statistic.samples)


def estimate(measure: Measure, by_view: Sequence[Float64[ndarray, " m"]], resampling: Resampling) -> Estimate:
    """Return a measure's statistic of the samples of all views, pooled, with its interval."""
    samples = np.concatenate([np.empty(0), *by_view])
    if not len(samples):
        return Estimate(None, None, 0)
    view = np.repeat(np.arange(len(by_view)), [len(one) for one in by_view])
    draws = _draws(measure, samples, view, resampling)
    return Estimate(STATISTICS[measure.statistic](samples), interval(draws), len(samples))


def _draws(
    measure: Measure, samples: Float64[ndarray, " m"], view: Int64[ndarray, " m"], resampling: Resampling
) -> Float64[ndarray, " draws"]:
    if measure.statistic == "mean":
        return resampling.pooled_means(samples, view)
    if measure.statistic == "std":
        from_mean = samples - samples.mean()
        means, squares = (resampling.pooled_means(from_mean**power, view) for power in (1, 2))
        return np.asarray(np.sqrt(np.maximum(squares - means**2, 0.0)))
    return resampling.percentile(samples, view, {"median": 50, "p95": 95}[measure.statistic])


def _view_dict(view: ViewNumbers) -> dict[str, Any]:
    numbers = {
        alignment: {name: rounded(value) for name, value in of_alignment.items()}
        for alignment, of_alignment in view.numbers.items()
    }
    return {"view_id": view.view_id, **numbers}


def _table_dict(table: ExtendedTable) -> dict[str, Any]:
    numbers = {
        alignment: {name: _estimate_dict(one) for name, one in of_alignment.items()}
        for alignment, of_alignment in table.numbers.items()
    }
    return {"views": table.views, **numbers}


def _estimate_dict(one: Estimate) -> dict[str, Any]:
    ends = None if one.interval is None else [rounded(end, INTERVAL_DIGITS) for end in one.interval]
    return {"value": rounded(one.value), "ci95": ends, "samples": one.samples}
