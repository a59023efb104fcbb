"""Extended results: measures per view, tables per config with confidence intervals, and their JSON form."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from rebar_depth_bench.bar_crossings.crossings_file import CrossingsSource
from rebar_depth_bench.extended.frames import BarSamples, CrossingSamples, SpacingSamples, SteelFrames
from rebar_depth_bench.extended.measures import (
    EXTENDED_PROTOCOL,
    STATISTICS,
    Measure,
    Samples,
    Statistic,
    pooled,
)
from rebar_depth_bench.extended.tasks import ConfigTasks, config_tasks
from rebar_depth_bench.scoring.bootstrap import Interval, Resampling, interval
from rebar_depth_bench.scoring.columns import rounded, rounded_interval
from rebar_depth_bench.scoring.spreadsheet import Sheet

ViewSamples = Mapping[str, Samples]
"""Samples of one view by alignment and name, the input of the tables."""

ViewMeasures = Mapping[str, Mapping[str, float | None]]
"""Measures of one view by alignment and name."""

_ESTIMATE_COLUMNS = ("config", "alignment", "measure", "unit", "statistic", "value", "low", "high", "samples")


@dataclass(frozen=True)
class MeasureEstimate:
    """Value of a measure, its 95 % block bootstrap interval, and the number of pooled samples.

    ``value`` and ``interval`` are None without samples.
    """

    value: float | None
    interval: Interval | None
    samples: int

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object of the estimate, rounded."""
        return {"value": rounded(self.value), "ci95": rounded_interval(self.interval), "samples": self.samples}


@dataclass(frozen=True)
class ExtendedTable:
    """Estimates of one config by alignment and measure name."""

    views: int
    numbers: Mapping[str, Mapping[str, MeasureEstimate]]

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object of the table."""
        numbers = {
            alignment: {name: estimate.to_dict() for name, estimate in of_alignment.items()}
            for alignment, of_alignment in self.numbers.items()
        }
        return {"views": self.views, **numbers}


@dataclass(frozen=True, eq=False)
class ExtendedResult:
    """Extended measures of a submission; ``measures`` holds the definitions of each alignment, in order.

    ``views`` holds the measures of each view by id, alignment and name. ``frames`` are the samples of bars and
    crossings of each config that has bar ids and views, and ``scenes`` the scene of each of these views by its id,
    in order. ``crossings`` is None if no config has bar ids.
    """

    measures: Mapping[str, Sequence[Measure]]
    tables: Mapping[str, ExtendedTable]
    views: Mapping[str, ViewMeasures]
    frames: Mapping[str, SteelFrames] = field(default_factory=dict)
    scenes: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    crossings: CrossingsSource | None = None

    @cached_property
    def tasks(self) -> Mapping[str, ConfigTasks]:
        """Working ranges of each config that has ``frames``, computed on the first access."""
        return {config: config_tasks(frames, self.tables[config].views) for config, frames in self.frames.items()}

    def to_dict(self) -> dict[str, Any]:
        """Return the ``extended`` object of the result's JSON."""
        return {
            "protocol": EXTENDED_PROTOCOL,
            "crossings": None if self.crossings is None else asdict(self.crossings),
            "tables": {name: table.to_dict() for name, table in self.tables.items()},
            "views": [
                {
                    "view_id": view_id,
                    **{
                        alignment: {name: rounded(value) for name, value in of_alignment.items()}
                        for alignment, of_alignment in numbers.items()
                    },
                }
                for view_id, numbers in self.views.items()
            ],
        }

    def to_sheet(self) -> Sheet:
        """Return one row per config, alignment and measure: value, 95 % interval and number of samples.

        Shares are from 0 to 1 and have no unit.
        """
        rows = [
            (
                *(config, alignment, measure.name, "" if measure.unit == "%" else measure.unit),
                *(measure.statistic, estimate.value),
                *(rounded_interval(estimate.interval) or (None, None)),
                estimate.samples,
            )
            for config, alignment, measure, estimate in self.estimates()
        ]
        return Sheet(_ESTIMATE_COLUMNS, rows)

    def to_samples_sheet(self, rows: Literal["bars", "spacings", "crossings"]) -> Sheet:
        """Return one row per sample of native predictions: of judged bars, pairs of neighbours, or crossings.

        A vector has a column for each of x, y and z. What was not found, or is not judged, is undefined.
        """
        kind = {"bars": BarSamples, "spacings": SpacingSamples, "crossings": CrossingSamples}[rows]
        names = [one.name for one in fields(kind) if one.name != "view"]
        axes = {
            "point_m": [f"point_{axis}_m" for axis in "xyz"],
            "direction": [f"direction_{axis}" for axis in "xyz"],
        }
        heads = {name: axes.get(name, [name]) for name in names}
        cells: list[list[Any]] = []
        for config, frames in self.frames.items():
            samples = getattr(frames.native.predicted, rows)
            scenes = list(self.scenes[config].items())
            views = [(config, scenes[view][1], scenes[view][0]) for view in samples.view.tolist()]
            columns = [getattr(samples, name).reshape(len(views), len(heads[name])).tolist() for name in names]
            for view, *values in zip(views, *columns, strict=True):
                cells.append([*view, *(value for part in values for value in part)])
        return Sheet(
            ["config", "scene", "view_id", *(head for of_name in heads.values() for head in of_name)], cells
        )

    def estimates(self) -> Iterator[tuple[str, str, Measure, MeasureEstimate]]:
        """Yield config, alignment, measure and estimate, in order."""
        for config, table in self.tables.items():
            for alignment, measures in self.measures.items():
                for measure in measures:
                    yield config, alignment, measure, table.numbers[alignment][measure.name]


def view_measures(view: ViewSamples, measures: Mapping[str, Sequence[Measure]]) -> ViewMeasures:
    """Return all measures of a single view, None where it has no sample."""
    values: dict[str, dict[str, float | None]] = {}
    for alignment, of_alignment in measures.items():
        values[alignment] = {}
        for measure in of_alignment:
            samples = view[alignment].get(measure.sample, np.empty(0))
            value = STATISTICS[measure.statistic](samples) if len(samples) else None
            values[alignment][measure.name] = value
    return values


def tabulate_extended(
    views: Sequence[ViewSamples], resampling: Resampling, measures: Mapping[str, Sequence[Measure]]
) -> ExtendedTable:
    """Return a config's table; ``resampling`` are the resamples of the views, from which its intervals follow."""
    return ExtendedTable(
        views=len(views),
        numbers={
            alignment: _estimates(of_alignment, [view[alignment] for view in views], resampling)
            for alignment, of_alignment in measures.items()
        },
    )


def _estimates(
    measures: Sequence[Measure], by_view: Sequence[Samples], resampling: Resampling
) -> dict[str, MeasureEstimate]:
    """Return each measure's estimate by name; measures of the same samples and statistic share it."""
    statistics: dict[tuple[str, Statistic], MeasureEstimate] = {}
    for measure in measures:
        key = (measure.sample, measure.statistic)
        if key not in statistics:
            statistics[key] = estimate(measure, by_view, resampling)
    return {measure.name: statistics[measure.sample, measure.statistic] for measure in measures}


def estimate(measure: Measure, by_view: Sequence[Samples], resampling: Resampling) -> MeasureEstimate:
    """Return a measure's statistic of the samples of all views, pooled, with its bootstrap interval."""
    samples, view = pooled(by_view, measure.sample)
    if not len(samples):
        return MeasureEstimate(None, None, 0)
    ends = interval(_draws(measure, samples, view, resampling), resampling.blocks(view))
    return MeasureEstimate(STATISTICS[measure.statistic](samples), ends, len(samples))


def _draws(
    measure: Measure, samples: Float64[ndarray, " m"], view: Int64[ndarray, " m"], resampling: Resampling
) -> Float64[ndarray, " draws"]:
    """Return the statistic in each bootstrap resample."""
    if measure.statistic == "mean":
        return resampling.pooled_means(samples, view)
    if measure.statistic == "std":
        deviation = samples - samples.mean()
        means, squares = (resampling.pooled_means(deviation**power, view) for power in (1, 2))
        return np.asarray(np.sqrt(np.maximum(squares - means**2, 0.0)))
    return resampling.percentile(samples, view, {"median": 50, "p95": 95}[measure.statistic])
