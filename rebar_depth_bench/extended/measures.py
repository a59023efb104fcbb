"""Extended measure definitions: a view yields samples, and a measure is a statistic of the pooled samples.

``families`` lists all measures. Also samples of single values, and pixel subsampling for measures that do not need
every pixel.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from rebar_depth_bench.scoring.columns import Better, Column, coverage_percent

EXTENDED_PROTOCOL = "rebar-extended-6"
"""Version of the definitions of all extended measures; any change of a definition changes it."""

ONCE, NATIVE, SCALED = "once", "native", "scaled"
"""Alignments of a prediction (keys of the result's JSON).

``ONCE``: measures that are invariant to scale or apply their own alignment, computed from the native prediction.
``NATIVE``: the prediction as submitted. ``SCALED``: the prediction times the median scale s.
"""

Samples = Mapping[str, Float64[ndarray, " n"]]
"""Samples of one view: float64 values by name, without NaN; empty where the measure does not apply."""

Statistic = Literal["mean", "median", "std", "p95"]
"""Statistics of pooled samples."""


def percentile(values: Float64[ndarray, " n"], percent: int) -> float:
    """Return the smallest value with at least ``percent`` % of the values at or below it; needs one value or more.

    For the median (50), if the share is met exactly, it is the mean of that value and the next, as in
    ``Resampling.percentile``. Infinite values are the largest.
    """
    ordered = np.sort(values)
    lower = float(ordered[-(-len(ordered) * percent // 100) - 1])
    if percent != 50:
        return lower
    upper = float(ordered[min(len(ordered) * percent // 100, len(ordered) - 1)])
    return lower if lower == upper else (lower + upper) / 2


STATISTICS: Mapping[Statistic, Callable[[Float64[ndarray, " n"]], float]] = {
    "mean": lambda values: float(np.mean(values)),
    "median": lambda values: percentile(values, 50),
    "std": lambda values: float(np.std(values)),
    "p95": lambda values: percentile(values, 95),
}
"""Population statistics of one or more values."""

_DECIMALS: Mapping[str, int] = {"mm": 2, "cm": 2, "m": 3, "px": 3, "%": 1, "": 4}


@dataclass(frozen=True)
class Measure:
    """Definition of one table entry: ``statistic`` of the samples named ``sample``, pooled over a config's views.

    ``unit`` is "mm", "cm", "%" (samples are shares from 0 to 1, shown times 100), "m", "px" or "". ``better`` is
    "lower" or "higher" only if missing pixels, or bars that were not found, count as failures; otherwise "".
    ``definition`` is one sentence with the formula. ``sample_name`` names the samples if the measure's name does
    not. Raises ``ValueError`` for an unknown statistic or unit.
    """

    name: str
    title: str
    unit: str
    better: Better
    definition: str
    sample_name: str = ""
    statistic: Statistic = "mean"

    def __post_init__(self) -> None:
        for found, known in ((self.statistic, STATISTICS), (self.unit, _DECIMALS)):
            if found not in known:
                raise ValueError(f"{self.name}: got {found!r}, expected one of {', '.join(map(repr, known))}")

    @property
    def sample(self) -> str:
        """Name of the samples."""
        return self.sample_name or self.name

    @property
    def column(self) -> Column:
        """Column of the measure in tables and pages."""
        return Column(
            place=self.name,
            title=self.title,
            unit=self.unit,
            better=self.better,
            decimals=2 if self.name.endswith("_deg") else _DECIMALS[self.unit],
            factor=100.0 if self.unit == "%" else 1.0,
            as_text=coverage_percent if self.name.endswith("_coverage") else None,
        )


@dataclass(frozen=True)
class MeasureFamily:
    """Related measures under one heading, taken at each of ``alignments``.

    ``note`` explains the single column of measures that are taken ``ONCE``.
    """

    key: str
    title: str
    measures: tuple[Measure, ...]
    alignments: tuple[str, ...] = (NATIVE, SCALED)
    note: str = ""

    @property
    def by_name(self) -> dict[str, Measure]:
        """Measures by name."""
        return {measure.name: measure for measure in self.measures}


def pooled(by_view: Sequence[Samples], name: str) -> tuple[Float64[ndarray, " m"], Int64[ndarray, " m"]]:
    """Return the samples of all views one after the other, and the position of each one's view."""
    samples = [samples.get(name, np.empty(0)) for samples in by_view]
    return np.concatenate([np.empty(0), *samples]), np.repeat(np.arange(len(samples)), list(map(len, samples)))


def finite_sample(value: float | None) -> Float64[ndarray, " one"]:
    """Return a sample of one value, empty if the value is None or not finite."""
    return np.array([value] if value is not None and math.isfinite(value) else [], dtype=np.float64)


def share_sample(count: int | np.integer, total: int | np.integer) -> Float64[ndarray, " one"]:
    """Return a sample that holds ``count / total``, empty for a total of 0."""
    return np.array([count / total] if total else [], dtype=np.float64)


def subsample(position: Int64[ndarray, " n"], max_count: int) -> Int64[ndarray, " m"]:
    """Return at most ``max_count`` of the positions, evenly strided: of n, the m at floor(i n / m)."""
    count = min(len(position), max_count)
    return np.asarray(position[np.arange(count) * len(position) // max(count, 1)])
