"""Scatter chart of native and oracle-scaled AbsRel, as in the paper's Figure 2.

Published points are hollow, those of the submission are filled.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from markupsafe import Markup, escape

from rebar_depth_bench.errors import printable
from rebar_depth_bench.reporting.charts.axes import WIDTH, LogAxis, decade_axis, svg_figure, svg_text, tick_label
from rebar_depth_bench.scoring.columns import number

_LEFT, _RIGHT, _TOP, _BOTTOM = 64.0, WIDTH - 14.0, 14.0, 286.0
_POINT_RADIUS_PX, _LABEL_RADIUS_PX, _CELL_PX = 5.0, 7.0, 2.0
_MAX_DESCRIBED = 20
_MAX_TITLE_CHARACTERS = 40
_LABEL_DIRECTIONS = ((1, 0), (-1, 0), (0, -1), (0, 1), (1, -1), (-1, 1), (1, 1), (-1, -1))
_LABEL_DISTANCE_PX = 14.0
_MARGIN_FACTORS = (0.93, 1.07)

OptionalInterval = tuple[float, float] | None


@dataclass(frozen=True)
class ScatterPoint:
    """Point of a table row: native and scaled AbsRel, their intervals or None, and the ``mark`` shown in both."""

    mark: str
    name: str
    native: float
    scaled: float
    published: bool
    native_interval: OptionalInterval = None
    scaled_interval: OptionalInterval = None


def scatter_chart(title: str, points: Sequence[ScatterPoint]) -> Markup:
    """Return the chart of the points on two logarithmic axes: native AbsRel along x, scaled AbsRel along y.

    The dashed line is native = scaled. On it, one scale per view changes nothing; far below it, the error is
    almost entirely one of scale.
    """
    x_axis = decade_axis(_axis_values((p.native, p.native_interval) for p in points), _LEFT, _RIGHT)
    y_axis = decade_axis(_axis_values((p.scaled, p.scaled_interval) for p in points), _BOTTOM, _TOP)
    points_px = [(x_axis.at(p.native), y_axis.at(p.scaled)) for p in points]
    marks = [_mark(point, *place, x_axis, y_axis) for point, place in zip(points, points_px, strict=True)]
    labels = [
        svg_text(
            round(place[0], 1), round(place[1] + 4.5, 1), point.mark, "middle" + " name" * (not point.published)
        )
        for point, place in zip(points, place_labels(points_px), strict=True)
        if place is not None
    ]
    body = _grid(x_axis, y_axis) + _diagonal(x_axis, y_axis) + "".join(marks) + "".join(labels)
    values_text = "; ".join(
        f"{p.mark}: {printable(p.name)}{', published' if p.published else ''}, "
        f"native {number(p.native, 4)}, scaled {number(p.scaled, 4)}"
        for p in points[:_MAX_DESCRIBED]
    )
    if len(points) > _MAX_DESCRIBED:
        values_text += f"; and {len(points) - _MAX_DESCRIBED} more"
    return svg_figure(title, f"AbsRel native and after the oracle scale. {values_text}.", _BOTTOM + 42, body)


def place_labels(points_px: Sequence[tuple[float, float]]) -> list[tuple[float, float] | None]:
    """Return the centre of each point's label, pixels, or None where it would overlap a point or another label.

    A label touches its point, so that it needs no line to it.
    """
    occupied = {cell for x, y in points_px for cell in _cells(x, y, _POINT_RADIUS_PX)}
    labels: list[tuple[float, float] | None] = []
    for x, y in points_px:
        candidates = ((x + _LABEL_DISTANCE_PX * dx, y + _LABEL_DISTANCE_PX * dy) for dx, dy in _LABEL_DIRECTIONS)
        free = (
            (cx, cy)
            for cx, cy in candidates
            if _LEFT + 8 < cx < _RIGHT - 8
            and _TOP + 4 < cy < _BOTTOM - 8
            and occupied.isdisjoint(_cells(cx, cy, _LABEL_RADIUS_PX))
        )
        label = next(free, None)
        if label is not None:
            occupied.update(_cells(*label, _LABEL_RADIUS_PX))
        labels.append(label)
    return labels


def _cells(x: float, y: float, radius_px: float) -> list[tuple[int, int]]:
    """Return the cells of a raster that a square of the half width ``radius_px`` overlaps."""
    columns, rows = (
        range(math.floor((centre - radius_px) / _CELL_PX), math.floor((centre + radius_px) / _CELL_PX) + 1)
        for centre in (x, y)
    )
    return [(column, row) for column in columns for row in rows]


def _axis_values(values: Iterable[tuple[float, OptionalInterval]]) -> list[float]:
    numbers = [number for value, ends in values for number in (value, *(ends or ()))]
    return [number * margin for number in numbers for margin in _MARGIN_FACTORS]


def _mark(point: ScatterPoint, x: float, y: float, x_axis: LogAxis, y_axis: LogAxis) -> str:
    title = f"<title>{escape(f'{point.mark} {printable(point.name, _MAX_TITLE_CHARACTERS)}')}</title>"
    if point.published:
        return f'<circle class="published ring" cx="{x:.1f}" cy="{y:.1f}" r="5">{title}</circle>'
    bars = ""
    if point.native_interval:
        low, high = map(x_axis.at, point.native_interval)
        bars += f'<path class="bars" d="M{low:.1f} {y:.1f}H{high:.1f}"/>'
    if point.scaled_interval:
        low, high = map(y_axis.at, point.scaled_interval)
        bars += f'<path class="bars" d="M{x:.1f} {low:.1f}V{high:.1f}"/>'
    return f'{bars}<circle class="native fill" cx="{x:.1f}" cy="{y:.1f}" r="5">{title}</circle>'


def _diagonal(x_axis: LogAxis, y_axis: LogAxis) -> str:
    low, high = max(x_axis.low, y_axis.low), min(x_axis.high, y_axis.high)
    if low >= high:
        return ""
    ends = ((x_axis.at(low), y_axis.at(low)), (x_axis.at(high), y_axis.at(high)))
    return '<path class="one" d="M{:.1f} {:.1f}L{:.1f} {:.1f}"/>'.format(*ends[0], *ends[1])


def _grid(x_axis: LogAxis, y_axis: LogAxis) -> str:
    lines = "".join(f"M{x_axis.at(t):.1f} {_TOP:g}V{_BOTTOM:g}" for t in x_axis.ticks())
    lines += "".join(f"M{_LEFT:g} {y_axis.at(t):.1f}H{_RIGHT:g}" for t in y_axis.ticks())
    labels = [svg_text(round(x_axis.at(t), 1), _BOTTOM + 17, tick_label(t), "middle") for t in x_axis.ticks()]
    labels += [svg_text(_LEFT - 7, round(y_axis.at(t) + 4.5, 1), tick_label(t), "end") for t in y_axis.ticks()]
    titles = svg_text((_LEFT + _RIGHT) / 2, _BOTTOM + 36, "native AbsRel", "middle")
    titles += (
        f'<g transform="rotate(-90 12 {_BOTTOM / 2:g})">{svg_text(12, _BOTTOM / 2, "scaled AbsRel", "middle")}</g>'
    )
    return f'<path class="axis" d="{lines}"/>{"".join(labels)}{titles}'
