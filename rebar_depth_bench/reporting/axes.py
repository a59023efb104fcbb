"""Axes of charts and figures: mapping of values to coordinates, and the values that are labelled."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

_STEPS = [float(f"{step}e{power}") for power in range(-14, 14) for step in (1, 2, 5)]


@dataclass(frozen=True)
class Axis:
    """Mapping of values from ``low`` to ``high`` to coordinates from ``start`` to ``end``.

    It is logarithmic, with both values > 0, unless it is ``linear``.
    """

    low: float
    high: float
    start: float
    end: float
    linear: bool = False

    def at(self, value: float) -> float:
        """Return the coordinate of ``value``, clipped to the ends of the axis (also for values <= 0)."""
        if value <= self.low:
            return self.start
        if value >= self.high:
            return self.end
        if self.linear:
            share = (value - self.low) / (self.high - self.low)
        else:
            share = math.log(value / self.low) / math.log(self.high / self.low)
        return self.start + share * (self.end - self.start)

    def ticks(self) -> list[float]:
        """Return three to nine round values from ``low`` to ``high``."""
        decades = 0.0 if self.linear else math.log10(self.high / self.low)
        if decades < 0.7:
            return _even_ticks(self.low, self.high)
        steps = (1, 2, 5) if decades < 2.5 else (1,)
        stride = max(1, math.ceil(decades / 8))
        powers = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1, stride)
        candidates = [float(f"{step}e{power}") for power in powers for step in steps]
        return [value for value in candidates if self.low * (1 - 1e-9) <= value <= self.high * (1 + 1e-9)]


def _even_ticks(low: float, high: float) -> list[float]:
    """Return the multiples of a round step from ``low`` to ``high``, both included."""
    span = high - low
    power = 10.0 ** math.floor(math.log10(span))
    step = next(s * power for s in (0.1, 0.2, 0.5, 1, 2, 5) if span / (s * power) <= 6)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [float(f"{index * step:.9g}") for index in range(first, last + 1)]


def decade_axis(values: Iterable[float], start: float, end: float) -> Axis:
    """Return a logarithmic axis over the finite positive ``values`` whose ends are 1, 2 or 5 x 10^k."""
    positive = [value for value in values if math.isfinite(value) and value > 0] or [1e-3, 1.0]
    smallest, largest = (min(max(value, 1e-12), 1e12) for value in (min(positive), max(positive)))
    low = max(step for step in _STEPS if step <= smallest * (1 + 1e-9))
    high = min(step for step in _STEPS if step >= largest * (1 - 1e-9))
    return Axis(low if high > low else low / 10, high, start, end)


def log_axis_with_one(values: Iterable[float], start: float, end: float) -> Axis:
    """Return a logarithmic axis over the finite positive ``values`` and 1, with a margin at both ends."""
    logs = [math.log(value) for value in values if math.isfinite(value) and value > 0]
    low, high = max(min([0.0, *logs]), -28.0), min(max([0.0, *logs]), 28.0)
    margin = max(0.06 * (high - low), 0.01)
    return Axis(math.exp(low - margin), math.exp(high + margin), start, end)


def select_spaced(values: Iterable[float], axis: Axis, min_distance: float) -> list[float]:
    """Return the values that are at least ``min_distance`` away from every value selected before, in order."""
    selected: list[float] = []
    for value in values:
        if all(abs(axis.at(value) - axis.at(other)) >= min_distance for other in selected):
            selected.append(value)
    return selected


def tick_label(value: float) -> str:
    """Return the label of a tick, short and without trailing zeros."""
    return f"{value:.6g}" if value == 0 or 1e-4 <= abs(value) < 1e6 else f"{value:.0e}"
