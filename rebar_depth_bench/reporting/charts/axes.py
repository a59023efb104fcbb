"""A logarithmic axis: where values fall on it and which of them carry a label.

What every inline SVG chart is made of: the picture's frame and escaped text.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from markupsafe import Markup, escape


@dataclass(frozen=True)
class LogAxis:
    """Maps values from ``low`` to ``high`` (both > 0) to ``start`` to ``end`` in pixels, evenly in log."""

    low: float
    high: float
    start: float
    end: float

    def at(self, value: float) -> float:
        """Return the pixel of ``value``; what lies beyond an end, zero too, is drawn at that end."""
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
    """Return an axis over the finite positive ``values`` that ends on 1, 2 or 5 x 10^k."""
    positive = [value for value in values if math.isfinite(value) and value > 0] or [1e-3, 1.0]
    low, high = (max(min(positive), 1e-12), min(max(positive), 1e12))
    low, high = _step_below(min(low, 1e12)), _step_above(max(high, 1e-12))
    return LogAxis(low if high > low else low / 10, high, start, end)


def unit_axis(values: Iterable[float], start: float, end: float) -> LogAxis:
    """Return an axis over the finite positive ``values`` and 1, with a margin on either side."""
    logs = [math.log(value) for value in values if math.isfinite(value) and value > 0]
    low, high = max(min([0.0, *logs]), -28.0), min(max([0.0, *logs]), 28.0)
    margin = max(0.06 * (high - low), 0.01)
    return LogAxis(math.exp(low - margin), math.exp(high + margin), start, end)


def label(value: float) -> str:
    """Return a tick's label: short, without trailing zeros."""
    return f"{value:.6g}" if 1e-4 <= abs(value) < 1e6 else f"{value:.0e}"


def _even_ticks(low: float, high: float) -> list[float]:
    span = high - low
    power = 10.0 ** math.floor(math.log10(span))
    step = next(s * power for s in (0.1, 0.2, 0.5, 1, 2, 5) if span / (s * power) <= 6)
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
"""View box width: small enough that 13 px text stays readable when a phone shrinks the chart."""


def svg_figure(title: str, description: str, height: float, body: str) -> Markup:
    """Return a chart ``WIDTH`` wide with its title and its description in words; ``body`` is markup."""
    return Markup(
        f'<svg class="chart" role="img" viewBox="0 0 {WIDTH} {height:g}">'
        f"<title>{escape(title)}</title><desc>{escape(description)}</desc>{body}</svg>"
    )


def svg_text(x: float, y: float, content: str, classes: str = "start") -> str:
    """Return ``content``, escaped, hung at ``x`` by ``classes``: start, middle or end."""
    return f'<text class="{classes}" x="{x:g}" y="{y:g}">{escape(content)}</text>'
