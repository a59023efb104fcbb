"""Line charts as inline SVG: lines with markers on linear axes.

Colours are classes of ``table_page.css`` (``c0``, ``c1``, ...), so that the charts follow light and dark mode.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from markupsafe import Markup

from rebar_depth_bench.errors import printable
from rebar_depth_bench.reporting.charts.axes import (
    WIDTH,
    Axis,
    multiples,
    select_spaced,
    svg_figure,
    svg_text,
    tick_label,
)

COLOURS = 7
"""Number of colour classes, ``c0`` to ``c6``; further series repeat them."""

LEFT, RIGHT, TOP, HEIGHT = 62.0, WIDTH - 14.0, 30.0, 230.0
_LEGEND_ROW = 18.0
_LEGEND_COLUMNS = 3
_MIN_LABEL_DISTANCE_PX = 26

Point = tuple[float, float]

_text = partial(svg_text, number_format=".1f")


@dataclass(frozen=True)
class LinearAxis:
    """Linear mapping of values from ``low`` to ``high`` to pixels from ``start`` to ``end``."""

    low: float
    high: float
    start: float
    end: float

    def at(self, value: float) -> float:
        """Return the pixel coordinate of ``value``, clipped to the ends of the axis."""
        share = (min(max(value, self.low), self.high) - self.low) / (self.high - self.low)
        return self.start + share * (self.end - self.start)

    def ticks(self) -> list[float]:
        """Return three to seven round values from ``low`` to ``high``."""
        return multiples(_round_step((self.high - self.low) / 6), self.low, self.high)


@dataclass(frozen=True)
class Series:
    """Line with markers of one name and colour; values are in the units of the axes."""

    name: str
    colour: int
    line: Sequence[Point] = ()


@dataclass(frozen=True)
class ChartText:
    """Texts of a chart: title and description for screen readers, and the axis titles."""

    title: str
    description: str
    x: str
    y: str


def chart(series: Sequence[Series], x_axis: Axis, y_axis: Axis, text: ChartText) -> Markup:
    """Return the SVG chart of ``series``, with a legend if there are two or more names."""
    body = _grid(x_axis, y_axis)
    body += "".join(_line(entry, x_axis, y_axis) for entry in series)
    body += _text(LEFT, 16, text.y) + _text(RIGHT, HEIGHT + 36, text.x, "end")
    names = list(dict.fromkeys((entry.name, entry.colour) for entry in series))
    legend = _legend(names) if len(names) > 1 else ""
    rows = math.ceil(len(names) / _LEGEND_COLUMNS) if legend else 0
    height = HEIGHT + 44 + rows * _LEGEND_ROW
    return svg_figure(text.title, text.description, height, body + legend)


def _grid(x_axis: Axis, y_axis: Axis) -> str:
    x_ticks = x_axis.ticks()
    lines = "".join(f"M{LEFT:g} {y_axis.at(tick):.1f}H{RIGHT:g}" for tick in y_axis.ticks())
    lines += "".join(f"M{x_axis.at(tick):.1f} {HEIGHT:g}v4" for tick in x_ticks)
    labels = "".join(_text(LEFT - 6, y_axis.at(tick) + 4, _y_tick_label(tick), "end") for tick in y_axis.ticks())
    labels += "".join(
        _text(x_axis.at(tick), HEIGHT + 18, tick_label(tick), "middle")
        for tick in select_spaced(x_ticks, x_axis, _MIN_LABEL_DISTANCE_PX)
    )
    return f'<path class="axis" d="{lines}"/>{labels}'


def _line(series: Series, x_axis: Axis, y_axis: Axis) -> str:
    finite = [(x, y) for x, y in series.line if math.isfinite(x) and math.isfinite(y)]
    points = [(x_axis.at(x), y_axis.at(y)) for x, y in finite]
    if not points:
        return ""
    colour = f"c{series.colour % COLOURS}"
    path = "L".join(f"{x:.1f} {y:.1f}" for x, y in points)
    markers = "".join(f'<circle class="disc {colour}" cx="{x:.1f}" cy="{y:.1f}" r="3.4"/>' for x, y in points)
    return f'<path class="line {colour}" d="M{path}"/>{markers}'


def _legend(names: Sequence[tuple[str, int]]) -> str:
    width = (RIGHT - LEFT) / _LEGEND_COLUMNS
    parts = []
    for index, (name, colour) in enumerate(names):
        x, y = LEFT + width * (index % _LEGEND_COLUMNS), HEIGHT + 54 + _LEGEND_ROW * (index // _LEGEND_COLUMNS)
        parts.append(f'<circle class="disc c{colour % COLOURS}" cx="{x + 4:.1f}" cy="{y - 4:g}" r="4"/>')
        parts.append(_text(x + 13, y, printable(name, 24)))
    return "".join(parts)


def _y_tick_label(value: float) -> str:
    """Return the label of a y tick; numbers from 1e-6 to 1e-4 are written without scientific notation."""
    if value == 0:
        return "0"
    text = f"{value:.6f}".rstrip("0") if 1e-6 <= abs(value) < 1e-4 else tick_label(value)
    return text.replace("-", "−") if value < 0 else text


def _round_step(minimum: float) -> float:
    power = 10.0 ** math.floor(math.log10(minimum))
    return next(step * power for step in (1, 2, 5, 10) if step * power >= minimum * (1 - 1e-9))
