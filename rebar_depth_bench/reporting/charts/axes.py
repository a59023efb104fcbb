"""Logarithmic axes, tick selection, and the SVG elements of all charts: figure frame and escaped text."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

from markupsafe import Markup, escape


class Axis(Protocol):
    """Mapping of values to pixels, with the tick values that are labelled."""

    def at(self, value: float) -> float:
        """Return the pixel coordinate of a value."""

    def ticks(self) -> list[float]:
        """Return the labelled values."""


@dataclass(frozen=True)
class LogAxis:
    """Logarithmic mapping of values from ``low`` to ``high`` (both > 0) to pixels from ``start`` to ``end``."""

    low: float
    high: float
    start: float
    end: float

    def at(self, value: float) -> float:
        """Return the pixel coordinate of ``value``, clipped to the ends of the axis (also for values <= 0)."""
        if value <= self.low:
            return self.start
        if value >= self.high:
            return self.end
        share = math.log(value / self.low) / math.log(self.high / self.low)
        return self.start + share * (self.end - self.start)

    def ticks(self) -> list[float]:
        """Return three to nine round values from ``low`` to ``high``."""
        decades = math.log10(self.high / self.low)
        if decades < 0.7:
            return _even_ticks(self.low, self.high)
        steps = (1, 2, 5) if decades < 2.5 else (1,)
        stride = max(1, math.ceil(decades / 8))
        powers = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1, stride)
        candidates = [float(f"{step}e{power}") for power in powers for step in steps]
        return [value for value in candidates if self.low * (1 - 1e-9) <= value <= self.high * (1 + 1e-9)]


def decade_axis(values: Iterable[float], start: float, end: float) -> LogAxis:
    """Return a logarithmic axis over the finite positive ``values`` whose ends are 1, 2 or 5 x 10^k."""
    positive = [value for value in values if math.isfinite(value) and value > 0] or [1e-3, 1.0]
    low, high = (max(min(positive), 1e-12), min(max(positive), 1e12))
    low, high = _step_below(min(low, 1e12)), _step_above(max(high, 1e-12))
    return LogAxis(low if high > low else low / 10, high, start, end)


def log_axis_with_one(values: Iterable[float], start: float, end: float) -> LogAxis:
    """Return a logarithmic axis over the finite positive ``values`` and 1, with a margin at both ends."""
    logs = [math.log(value) for value in values if math.isfinite(value) and value > 0]
    low, high = max(min([0.0, *logs]), -28.0), min(max([0.0, *logs]), 28.0)
    margin = max(0.06 * (high - low), 0.01)
    return LogAxis(math.exp(low - margin), math.exp(high + margin), start, end)


def select_spaced(values: Iterable[float], axis: Axis, min_distance_px: float) -> list[float]:
    """Return the values that are at least ``min_distance_px`` away from every value selected before, in order."""
    selected: list[float] = []
    for value in values:
        if all(abs(axis.at(value) - axis.at(other)) >= min_distance_px for other in selected):
            selected.append(value)
    return selected


def tick_label(value: float) -> str:
    """Return the label of a tick, short and without trailing zeros."""
    return f"{value:.6g}" if value == 0 or 1e-4 <= abs(value) < 1e6 else f"{value:.0e}"


def _even_ticks(low: float, high: float) -> list[float]:
    span = high - low
    power = 10.0 ** math.floor(math.log10(span))
    step = next(s * power for s in (0.1, 0.2, 0.5, 1, 2, 5) if span / (s * power) <= 6)
    return multiples(step, low, high)


def multiples(step: float, low: float, high: float) -> list[float]:
    """Return the multiples of ``step`` from ``low`` to ``high``, both included."""
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [float(f"{index * step:.9g}") for index in range(first, last + 1)]


def _step_below(value: float) -> float:
    power = math.floor(math.log10(value))
    return max(step for step in _steps_around(power) if step <= value * (1 + 1e-9))


def _step_above(value: float) -> float:
    power = math.floor(math.log10(value))
    return min(step for step in _steps_around(power) if step >= value * (1 - 1e-9))


def _steps_around(power: int) -> list[float]:
    return [float(f"{step}e{exponent}") for exponent in (power - 1, power, power + 1) for step in (1, 2, 5)]


WIDTH = 460
"""View box width, small enough that 13 px text stays readable when a phone shrinks the chart."""


def svg_figure(title: str, description: str, height: float, body: str) -> Markup:
    """Return an SVG of width ``WIDTH`` with a title and a text description for screen readers.

    ``body`` is markup and is not escaped.
    """
    return Markup(  # noqa: S704 -- Texts are escaped here and by ``svg_text``.
        f'<svg class="chart" role="img" viewBox="0 0 {WIDTH} {height:g}">'
        f"<title>{escape(title)}</title><desc>{escape(description)}</desc>{body}</svg>"
    )


def svg_text(x: float, y: float, content: str, classes: str = "start", *, number_format: str = "g") -> str:
    """Return a text element with escaped ``content``; ``classes`` sets its anchor (start, middle, end).

    ``number_format`` is the format specification of the coordinates.
    """
    return f'<text class="{classes}" x="{x:{number_format}}" y="{y:{number_format}}">{escape(content)}</text>'
