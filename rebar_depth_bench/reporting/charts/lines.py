"""Inline SVG charts of the studies: bands of draws, points of views, lines of means.

Colours are classes of ``study.css`` (``c0``, ``c1``, ...), so that the charts follow light and dark.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from markupsafe import Markup, escape

from rebar_depth_bench.reporting.charts.axes import LogAxis, label
from rebar_depth_bench.reporting.formatting import printable

WIDTH = 460
"""View box width, as the report's charts."""

COLOURS = 7
"""Classes ``c0`` to ``c6``; further series start again."""

LEFT, RIGHT, TOP, HEIGHT = 62.0, WIDTH - 14.0, 30.0, 230.0
_LEGEND_ROW = 18.0
_LEGEND_COLUMNS = 3

Point = tuple[float, float]


class Axis(Protocol):
    """What places values in pixels and says which of them carry a label."""

    def at(self, value: float) -> float:
        """Return the pixel of a value."""

    def ticks(self) -> list[float]:
        """Return the values that carry a label."""


@dataclass(frozen=True)
class LinearAxis:
    """Maps values from ``low`` to ``high`` evenly to ``start`` to ``end`` in pixels."""

    low: float
    high: float
    start: float
    end: float

    def at(self, value: float) -> float:
        """Return the pixel of ``value``; what lies beyond an end is drawn at that end."""
        share = (min(max(value, self.low), self.high) - self.low) / (self.high - self.low)
        return self.start + share * (self.end - self.start)

    def ticks(self) -> list[float]:
        """Return three to seven round values from ``low`` to ``high``."""
        step = _round_step((self.high - self.low) / 6)
        first, last = math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)
        return [float(f"{index * step:.9g}") for index in range(first, last + 1)]


@dataclass(frozen=True)
class Series:
    """Marks of one name and colour: points of views, a line with markers, bars from low to high, an area.

    ``hollow`` draws rings and a dashed line, for what is scaled; values are those of the axes.
    """

    name: str
    colour: int
    cloud: Sequence[Point] = ()
    line: Sequence[Point] = ()
    bars: Sequence[tuple[float, float, float]] = ()
    area: Sequence[tuple[float, float, float]] = ()
    hollow: bool = False


@dataclass(frozen=True)
class ChartWords:
    """What stands on a chart and what is read out of it."""

    title: str
    description: str
    x: str
    y: str


_MOST = 1e12
"""Larger values are drawn at the end of an axis."""


def zero_axis(values: Sequence[float], start: float, end: float) -> LinearAxis:
    """Return a linear axis over the finite ``values`` and 0, with a margin on either side."""
    finite = [min(max(value, -_MOST), _MOST) for value in values if math.isfinite(value)]
    low, high = min([0.0, *finite]), max([0.0, *finite])
    margin = 0.08 * (high - low) or 1e-6
    return LinearAxis(low - margin, high + margin, start, end)


def span_axis(values: Sequence[float], start: float, end: float) -> LogAxis:
    """Return a logarithmic axis over the finite positive ``values``, with a margin on either side."""
    positive = [min(max(value, 1 / _MOST), _MOST) for value in values if math.isfinite(value) and value > 0]
    low, high = min(positive, default=1.0), max(positive, default=1.0)
    margin = max((high / low) ** 0.04, 1.02) if high > low else 1.5
    return LogAxis(low / margin, high * margin, start, end)


def chart(
    series: Sequence[Series],
    x_axis: Axis,
    y_axis: Axis,
    words: ChartWords,
    *,
    x_ticks: Sequence[float] | None = None,
    reference: float | None = None,
) -> Markup:
    """Return a chart of ``series``, with a dashed line at y = ``reference`` and a legend of two names or more."""
    ticks = x_axis.ticks() if x_ticks is None else list(x_ticks)
    body = _grid(x_axis, y_axis, ticks)
    if reference is not None:
        body += f'<path class="one" d="M{LEFT:g} {y_axis.at(reference):.1f}H{RIGHT:g}"/>'
    layers = (_area, _cloud, _bars, _line)
    body += "".join(draw(one, x_axis, y_axis) for draw in layers for one in series)
    body += _text(LEFT, 16, words.y) + _text(RIGHT, HEIGHT + 36, words.x, "end")
    names = list(dict.fromkeys((one.name, one.colour) for one in series))
    legend = _legend(names) if len(names) > 1 else ""
    rows = math.ceil(len(names) / _LEGEND_COLUMNS) if legend else 0
    height = HEIGHT + 44 + rows * _LEGEND_ROW
    return Markup(
        f'<svg class="chart" role="img" viewBox="0 0 {WIDTH} {height:g}"><title>{escape(words.title)}</title>'
        f"<desc>{escape(words.description)}</desc>{body}{legend}</svg>"
    )


def _grid(x_axis: Axis, y_axis: Axis, x_ticks: Sequence[float]) -> str:
    lines = "".join(f"M{LEFT:g} {y_axis.at(tick):.1f}H{RIGHT:g}" for tick in y_axis.ticks())
    lines += "".join(f"M{x_axis.at(tick):.1f} {HEIGHT:g}v4" for tick in x_ticks)
    labels = "".join(_text(LEFT - 6, y_axis.at(tick) + 4, _label(tick), "end") for tick in y_axis.ticks())
    labels += "".join(
        _text(x_axis.at(tick), HEIGHT + 18, label(tick), "middle") for tick in _spaced(x_axis, x_ticks)
    )
    return f'<path class="axis" d="{lines}"/>{labels}'


def _spaced(axis: Axis, ticks: Sequence[float]) -> list[float]:
    """Return the ticks whose labels have room beside the one before."""
    kept: list[float] = []
    for tick in ticks:
        if not kept or abs(axis.at(tick) - axis.at(kept[-1])) >= 26:
            kept.append(tick)
    return kept


def _area(one: Series, x_axis: Axis, y_axis: Axis) -> str:
    drawn = [(x, low, high) for x, low, high in one.area if math.isfinite(low) and math.isfinite(high)]
    if not drawn:
        return ""
    upper = [f"{x_axis.at(x):.1f} {y_axis.at(high):.1f}" for x, _, high in drawn]
    lower = [f"{x_axis.at(x):.1f} {y_axis.at(low):.1f}" for x, low, _ in reversed(drawn)]
    return f'<path class="area {_colour(one)}" d="M{"L".join([*upper, *lower])}Z"/>'


def _cloud(one: Series, x_axis: Axis, y_axis: Axis) -> str:
    path = "".join(f"M{x_axis.at(x):.1f} {y_axis.at(y):.1f}h0" for x, y in _finite(one.cloud))
    return f'<path class="cloud {_colour(one)}" d="{path}"/>' if path else ""


def _bars(one: Series, x_axis: Axis, y_axis: Axis) -> str:
    path = "".join(
        f"M{x_axis.at(x):.1f} {y_axis.at(low):.1f}V{y_axis.at(high):.1f}"
        for x, low, high in one.bars
        if math.isfinite(low) and math.isfinite(high)
    )
    return f'<path class="bars {_colour(one)}" d="{path}"/>' if path else ""


def _line(one: Series, x_axis: Axis, y_axis: Axis) -> str:
    points = [(x_axis.at(x), y_axis.at(y)) for x, y in _finite(one.line)]
    if not points:
        return ""
    path = "L".join(f"{x:.1f} {y:.1f}" for x, y in points)
    dashed, marker = (" dashed", "hollow") if one.hollow else ("", "disc")
    discs = "".join(
        f'<circle class="{marker} {_colour(one)}" cx="{x:.1f}" cy="{y:.1f}" r="3.4"/>' for x, y in points
    )
    return f'<path class="line{dashed} {_colour(one)}" d="M{path}"/>{discs}'


def _legend(names: Sequence[tuple[str, int]]) -> str:
    width = (RIGHT - LEFT) / _LEGEND_COLUMNS
    parts = []
    for index, (name, colour) in enumerate(names):
        x, y = LEFT + width * (index % _LEGEND_COLUMNS), HEIGHT + 54 + _LEGEND_ROW * (index // _LEGEND_COLUMNS)
        parts.append(f'<circle class="disc c{colour % COLOURS}" cx="{x + 4:.1f}" cy="{y - 4:g}" r="4"/>')
        parts.append(_text(x + 13, y, printable(name, 24)))
    return "".join(parts)


def _finite(points: Sequence[Point]) -> list[Point]:
    return [(x, y) for x, y in points if math.isfinite(x) and math.isfinite(y)]


def _colour(one: Series) -> str:
    return f"c{one.colour % COLOURS}"


def _label(value: float) -> str:
    """Return a y tick's label; small numbers are written out while six decimals will do."""
    if value == 0:
        return "0"
    text = f"{value:.6f}".rstrip("0") if 1e-6 <= abs(value) < 1e-4 else label(value)
    return text.replace("-", "−") if value < 0 else text


def _text(x: float, y: float, content: str, classes: str = "start") -> str:
    return f'<text class="{classes}" x="{x:.1f}" y="{y:.1f}">{escape(content)}</text>'


def _round_step(least: float) -> float:
    power = 10.0 ** math.floor(math.log10(least))
    return next(step * power for step in (1, 2, 5, 10) if step * power >= least * (1 - 1e-9))
