"""How extended measures are named: a view yields samples, a measure is a statistic of them.

Fewer pixels, evenly, where a measure does not need all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

EXTENDED_PROTOCOL = "rebar-extended-1"
"""Names the definitions of all extended measures; changing one changes this name."""

Samples = Mapping[str, Float64[ndarray, " n"]]
"""What one view yields: float64 values by name, none where the view has nothing to say. No NaN."""

Statistic = Literal["mean", "median", "std", "p95"]


def percentile(values: Float64[ndarray, " n"], percent: int) -> float:
    """Return the smallest of one or more values with at least that share of them at or below it.

    Of a median where the share is met exactly, the mean of it and the next, as ``Resampling.percentile`` takes it.
    Infinite values are the largest.
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


@dataclass(frozen=True)
class Measure:
    """A number of a table: ``statistic`` of the samples called ``sample``, pooled over a config's views.

    ``better`` is "lower" or "higher" only where a missing pixel fails, or a bar that is not found does; else "".
    ``unit`` is "mm", "cm", "%" (samples are shares 0 to 1 and shown times 100), "m" or "". ``definition`` is one
    sentence with the formula. ``convert``, where given, makes the number from the statistic: it falls as the
    statistic grows, and is None where a statistic says no more than that something was missed.
    """

    name: str
    sample: str
    statistic: Statistic
    title: str
    unit: str
    better: Literal["lower", "higher", ""]
    definition: str
    convert: Callable[[float], float | None] | None = None

    def number(self, statistic: float) -> float | None:
        """Return the measure's number from the statistic of its samples; None where that tells none."""
        return statistic if self.convert is None else self.convert(statistic)


def thinned(position: Int64[ndarray, " n"], most: int) -> Int64[ndarray, " m"]:
    """Return at most ``most`` of the positions, evenly strided: of n, the m at floor(i n / m)."""
    count = min(len(position), most)
    return np.asarray(position[np.arange(count) * len(position) // max(count, 1)])
