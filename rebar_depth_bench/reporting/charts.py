"""Charts of pages as inline SVG, made of the same grids, lines and marks.

Colours are CSS classes of the page (``native``, ``scaled``, ``axis``, ...), so that the charts follow light and
dark mode. Many points of one kind are drawn as one path of zero-length round strokes, which takes a tenth of the
bytes of circles.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from markupsafe import Markup, escape

from rebar_depth_bench.base.errors import printable
from rebar_depth_bench.reporting.axes import Axis, decade_axis, log_axis_with_one, select_spaced, tick_label
from rebar_depth_bench.scoring.bootstrap import Interval
from rebar_depth_bench.scoring.columns import NATIVE, SCALE, SCALED, number
from rebar_depth_bench.scoring.table import Table, ViewScore

if TYPE_CHECKING:
    from rebar_depth_bench.extended.estimates import MeasureEstimate

Point = tuple[float, float]

WIDTH = 460
"""View box width, small enough that 13 px text stays readable when a phone shrinks the chart."""

LEFT, RIGHT = 64.0, WIDTH - 14.0
"""Ends of the x axis of charts with labels on the left, pixels."""

_DIGIT_WIDTH_PX, _LABEL_LINE_PX = 7.4, 15.0
_GOLDEN_RATIO = 0.6180339887498949


def _figure(title: str, description: str, height: float, *body: str) -> Markup:
    """Return an SVG of width ``WIDTH`` with a title and a text description for screen readers.

    ``body`` is markup and is not escaped.
    """
    return Markup(  # noqa: S704 -- Texts are escaped here and by ``_text``.
        f'<svg class="chart" role="img" viewBox="0 0 {WIDTH} {height:g}">'
        f"<title>{escape(title)}</title><desc>{escape(description)}</desc>{''.join(body)}</svg>"
    )


def _text(x: float, y: float, content: str, classes: str = "start") -> str:
    """Return a text element with escaped ``content``; ``classes`` sets its anchor (start, middle, end)."""
    return f'<text class="{classes}" x="{round(x, 1):g}" y="{round(y, 1):g}">{escape(content)}</text>'


def _path(classes: str, commands: str) -> str:
    """Return a path element; empty without any commands."""
    return f'<path class="{classes}" d="{commands}"/>' if commands else ""


def _circle(classes: str, x: float, y: float, radius_px: float, title: str = "") -> str:
    return f'<circle class="{classes}" cx="{x:.1f}" cy="{y:.1f}" r="{radius_px:g}"' + (
        f"><title>{escape(title)}</title></circle>" if title else "/>"
    )


def _across(low: float, high: float, y: float) -> str:
    """Return the path commands of a horizontal line."""
    return f"M{low:.1f} {y:.1f}H{high:.1f}"


def _down(x: float, top: float, bottom: float) -> str:
    """Return the path commands of a vertical line."""
    return f"M{x:.1f} {top:.1f}V{bottom:.1f}"


def _line(points: Sequence[Point]) -> str:
    """Return the path commands of a line through two or more points."""
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points) if len(points) > 1 else ""


def _dots(classes: str, points: Iterable[Point]) -> str:
    return _path(classes, "".join(f"M{x:.1f} {y:.1f}h0" for x, y in points))


def _x_grid(axis: Axis, values: Iterable[float], *spans: tuple[float, float]) -> str:
    """Return vertical lines at ``values`` from the top to the bottom of each span, and labels below the last.

    Labels that would overlap others are left out; those at the border of the figure are aligned to it.
    """
    values = list(values)
    lines = "".join(_down(axis.at(value), top, bottom) for value in values for top, bottom in spans)
    width_px = _DIGIT_WIDTH_PX * max(len(tick_label(value)) for value in values)
    labels = []
    for value in select_spaced(values, axis, width_px):
        x = axis.at(value)
        anchor = "start" if x < 28 else "end" if x > WIDTH - 28 else "middle"
        labels.append(_text(x, spans[-1][1] + 17, tick_label(value), anchor))
    return _path("axis", lines) + "".join(labels)


def _y_grid(axis: Axis, values: Iterable[float], left: float) -> str:
    """Return horizontal lines from ``left`` on at ``values``, with labels that do not overlap."""
    shown = select_spaced(values, axis, _LABEL_LINE_PX)
    lines = "".join(_across(left, RIGHT, axis.at(value)) for value in shown)
    labels = [_text(left - 7, axis.at(value) + 4.5, tick_label(value), "end") for value in shown]
    return _path("axis", lines) + "".join(labels)


# Charts of a result: a row for each config, and the views of one.

_ROW_LEFT, _ROW_HEIGHT_PX = 14.0, 50
_ABS_REL = {"native": NATIVE[0], "scaled": SCALED[0]}


def alignment_chart(tables: Mapping[str, Table]) -> Markup:
    """Return the chart of AbsRel by config on a logarithmic axis, native (disc) connected to scaled (ring)."""
    columns = _ABS_REL.values()
    errors = [(table[column.place], table.interval(column)) for table in tables.values() for column in columns]
    axis = decade_axis(_with_margin(errors, 0.0), _ROW_LEFT, RIGHT)
    numbers, described, marks = {}, [], ""
    for index, (name, table) in enumerate(tables.items()):
        y = _row_y(index)
        native, scaled = (table[column.place] for column in columns)
        native_text, scaled_text = NATIVE[0].text(native), SCALED[0].text(scaled)
        described.append(f"{printable(name)}: native {native_text}, scaled {scaled_text}")
        if math.isnan(native):
            numbers[name] = "no prediction"
            continue
        numbers[name] = f"{native_text} → {scaled_text} scaled"
        marks += _path("link", _across(axis.at(native), axis.at(scaled), y))
        for kind, column in _ABS_REL.items():
            if ends := table.interval(column):
                marks += _path(f"{kind} interval", _across(axis.at(ends[0]), axis.at(ends[1]), y))
        marks += _circle("native fill", axis.at(native), y, 6) + _circle("scaled ring", axis.at(scaled), y, 5)
    return _row_figure(
        "Native and scaled AbsRel by config",
        f"AbsRel of each config, native and after the oracle scale: {'; '.join(described)}.",
        axis,
        numbers,
        marks,
    )


def scale_chart(tables: Mapping[str, Table], views: Mapping[str, Sequence[ViewScore]]) -> Markup:
    """Return the chart of every view's scale factor, one strip per config, with its median and the line s = 1."""
    scales = {
        name: [view["scale"] for view in views.get(name, ()) if not math.isnan(view["scale"])] for name in tables
    }
    axis = log_axis_with_one([scale for strip in scales.values() for scale in strip], _ROW_LEFT, RIGHT)
    rows = [_row_y(index) for index in range(len(tables))]
    marks = _path("one", "".join(_down(axis.at(1.0), y - 13, y + 13) for y in rows))  # Not through their texts.
    medians = {name: SCALE.text(table[SCALE.place]) for name, table in tables.items()}
    for index, (name, strip) in enumerate(scales.items()):
        y = _row_y(index)
        marks += _dots("points", ((axis.at(s), y - 9 + 18 * (i * _GOLDEN_RATIO % 1)) for i, s in enumerate(strip)))
        median = tables[name][SCALE.place]
        if math.isfinite(median):
            marks += _path("median", _down(axis.at(median), y - 12, y + 12))
    description = "; ".join(f"{printable(name)}: median {median}" for name, median in medians.items())
    return _row_figure(
        "Scale factor of each view",
        "Scale factor s = median(z)/median(p) of every view: 1 is metric, below 1 the prediction is too far. "
        f"{description}.",
        axis,
        {name: f"median s {median}" for name, median in medians.items()},
        marks,
    )


def _row_y(index: int) -> float:
    return 42.0 + index * _ROW_HEIGHT_PX


def _row_figure(title: str, description: str, axis: Axis, numbers: Mapping[str, str], marks: str) -> Markup:
    """Return a chart with a row per config: its name on the left and its numbers on the right, above its marks."""
    bottom = _row_y(len(numbers)) - 20
    texts = [
        _text(_ROW_LEFT, _row_y(index) - 17, printable(name), "start name")
        + _text(RIGHT, _row_y(index) - 17, text, "end")
        for index, (name, text) in enumerate(numbers.items())
    ]
    return _figure(title, description, bottom + 22, _x_grid(axis, axis.ticks(), (10, bottom)), marks, *texts)


def views_chart(config: str, views: Sequence[ViewScore]) -> Markup:
    """Return the chart of AbsRel by view in protocol order, native and scaled.

    Views without any prediction are marked along the top.
    """
    top, bottom, left = 26.0, 170.0, 52.0
    native, scaled = (column.place for column in _ABS_REL.values())
    predicted = [view for view in views if not math.isnan(view[native])]
    axis = decade_axis([view[place] for view in predicted for place in (native, scaled)], bottom, top)
    placed = [(left + 6 + (RIGHT - left - 12) * (i + 0.5) / len(views), view) for i, view in enumerate(views)]
    dots = "large points" if len(views) <= 60 else "points"
    without = [at for at, view in placed if math.isnan(view[native])]
    return _figure(
        f"AbsRel by view, {printable(config)}",
        f"AbsRel of the {len(views)} views of {printable(config)}, {len(without)} without any prediction.",
        bottom + 26,
        _y_grid(axis, axis.ticks(), left),
        *(
            _dots(
                f"{kind} {dots}",
                ((at, axis.at(view[place])) for at, view in placed if not math.isnan(view[place])),
            )
            for kind, place in (("scaled", scaled), ("native", native))
        ),
        _path("missing", "".join(_down(at, 8, 18) for at in without)),
        _text(left + 6, bottom + 18, "first view"),
        _text(RIGHT, bottom + 18, "last view", "end"),
    )


# Scatter chart of native and oracle-scaled AbsRel, as in the paper's Figure 2: published points are hollow, those
# of submissions are filled.

_SCATTER_TOP, _SCATTER_BOTTOM = 14.0, 286.0
_POINT_RADIUS_PX, _LABEL_RADIUS_PX, _CELL_PX = 5.0, 7.0, 2.0
_MAX_DESCRIBED, _MAX_TITLE_CHARACTERS = 20, 40
_LABEL_DIRECTIONS = ((1, 0), (-1, 0), (0, -1), (0, 1), (1, -1), (-1, 1), (1, 1), (-1, -1))
_LABEL_DISTANCE_PX = 14.0


@dataclass(frozen=True)
class ScatterPoint:
    """Point of a table row: native and scaled AbsRel, their intervals or None, and the ``mark`` shown in both."""

    mark: str
    name: str
    native: float
    scaled: float
    published: bool
    native_interval: Interval | None = None
    scaled_interval: Interval | None = None


def scatter_chart(title: str, points: Sequence[ScatterPoint]) -> Markup:
    """Return the chart of the points on two logarithmic axes: native AbsRel along x, scaled AbsRel along y.

    The dashed line is native = scaled. On it, one scale per view changes nothing; far below it, the error is
    almost entirely one of scale.
    """
    x_axis = decade_axis(_with_margin(((p.native, p.native_interval) for p in points), 0.07), LEFT, RIGHT)
    y_axis = decade_axis(
        _with_margin(((p.scaled, p.scaled_interval) for p in points), 0.07), _SCATTER_BOTTOM, _SCATTER_TOP
    )
    places = [(x_axis.at(p.native), y_axis.at(p.scaled)) for p in points]
    low, high = max(x_axis.low, y_axis.low), min(x_axis.high, y_axis.high)
    diagonal = [(x_axis.at(end), y_axis.at(end)) for end in (low, high)] if low < high else []
    described = "; ".join(
        f"{p.mark}: {printable(p.name)}{', published' if p.published else ''}, "
        f"native {number(p.native, 4)}, scaled {number(p.scaled, 4)}"
        for p in points[:_MAX_DESCRIBED]
    )
    omitted = f"; and {len(points) - _MAX_DESCRIBED} more" if len(points) > _MAX_DESCRIBED else ""
    middle = _SCATTER_BOTTOM / 2
    return _figure(
        title,
        f"AbsRel native and after the oracle scale. {described}{omitted}.",
        _SCATTER_BOTTOM + 42,
        _x_grid(x_axis, x_axis.ticks(), (_SCATTER_TOP, _SCATTER_BOTTOM)),
        _y_grid(y_axis, y_axis.ticks(), LEFT),
        _text((LEFT + RIGHT) / 2, _SCATTER_BOTTOM + 36, "native AbsRel", "middle"),
        f'<g transform="rotate(-90 12 {middle:g})">{_text(12, middle, "scaled AbsRel", "middle")}</g>',
        _path("one", _line(diagonal)),
        *(_mark(point, *place, x_axis, y_axis) for point, place in zip(points, places, strict=True)),
        *(
            _text(label[0], label[1] + 4.5, point.mark, "middle" + " name" * (not point.published))
            for point, label in zip(points, place_labels(places), strict=True)
            if label is not None
        ),
    )


def place_labels(points_px: Sequence[Point]) -> list[Point | None]:
    """Return the centre of each point's label, pixels, or None where it would overlap a point or another label.

    A label touches its point, so that it needs no line to it.
    """
    occupied = {cell for x, y in points_px for cell in _cells(x, y, _POINT_RADIUS_PX)}
    labels: list[Point | None] = []
    for x, y in points_px:
        candidates = ((x + _LABEL_DISTANCE_PX * dx, y + _LABEL_DISTANCE_PX * dy) for dx, dy in _LABEL_DIRECTIONS)
        free = (
            (cx, cy)
            for cx, cy in candidates
            if LEFT + 8 < cx < RIGHT - 8
            and _SCATTER_TOP + 4 < cy < _SCATTER_BOTTOM - 8
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


def _with_margin(numbers: Iterable[tuple[float | None, Interval | None]], margin: float = 0.05) -> list[float]:
    """Return values and ends of intervals, each smaller and larger by the share ``margin``."""
    values = [
        value
        for one, ends in numbers
        for value in (one, *(ends or ()))
        if value is not None and not math.isnan(value)
    ]
    return [value * factor for value in values for factor in (1 - margin, 1 + margin)]


def _mark(point: ScatterPoint, x: float, y: float, x_axis: Axis, y_axis: Axis) -> str:
    title = f"{point.mark} {printable(point.name, _MAX_TITLE_CHARACTERS)}"
    if point.published:
        return _circle("published ring", x, y, 5, title)
    bars = ""
    if point.native_interval:
        low, high = map(x_axis.at, point.native_interval)
        bars += _across(low, high, y)
    if point.scaled_interval:
        low, high = map(y_axis.at, point.scaled_interval)
        bars += _down(x, low, high)
    return _path("bars", bars) + _circle("native fill", x, y, 5, title)


# Profile of a config: error and scale by distance or by bar width in the image.

_ERROR_TOP, _ERROR_BOTTOM = 24.0, 164.0
_SCALE_TOP, _SCALE_BOTTOM = 200.0, 270.0
_PROFILE_LEFT, _MARKER_OFFSET_PX = 52.0, 6.0


@dataclass(frozen=True)
class ProfileBin:
    """Estimates of one bin between two edges: AbsRel native and scaled, and the native scale s."""

    low: float
    high: float
    native: MeasureEstimate
    scaled: MeasureEstimate
    scale: MeasureEstimate


def profile_chart(title: str, unit: str, bins: Sequence[ProfileBin]) -> Markup:
    """Return a chart with two panels by bin: AbsRel, native (disc) and scaled (ring), above the native scale s.

    ``unit`` is the unit of the bin edges. All axes are logarithmic; vertical bars are 95 % intervals. The chart is
    empty if no bin has a native AbsRel.
    """
    bins = [entry for entry in bins if entry.native.value is not None]
    if not bins:
        return Markup()
    x = Axis(bins[0].low, bins[-1].high, _PROFILE_LEFT, RIGHT)
    errors = [(one.value, one.interval) for entry in bins for one in (entry.native, entry.scaled)]
    error = decade_axis(_with_margin(errors), _ERROR_BOTTOM, _ERROR_TOP)
    scales = [(entry.scale.value, entry.scale.interval) for entry in bins]
    scale = log_axis_with_one(_with_margin(scales), _SCALE_BOTTOM, _SCALE_TOP)
    edges = sorted({edge for entry in bins for edge in (entry.low, entry.high)})
    centred = [((x.at(entry.low) + x.at(entry.high)) / 2, entry) for entry in bins]
    described = "; ".join(
        f"{entry.low:g} to {entry.high:g} {unit}: AbsRel native {number(entry.native.value, 4)}, "
        f"scaled {number(entry.scaled.value, 4)}, s {SCALE.text(entry.scale.value)}"
        for entry in bins
    )
    height = _SCALE_BOTTOM + 42
    return _figure(
        f"Against {title}",
        f"By {title}: {described}.",
        height,
        _x_grid(x, edges, (_ERROR_TOP, _ERROR_BOTTOM), (_SCALE_TOP, _SCALE_BOTTOM)),
        _y_grid(error, error.ticks(), _PROFILE_LEFT),
        _y_grid(scale, [1.0, *scale.ticks()], _PROFILE_LEFT),
        _path("one", _across(_PROFILE_LEFT, RIGHT, scale.at(1.0))),
        _estimates("scaled ring", [(at + _MARKER_OFFSET_PX, entry.scaled) for at, entry in centred], error),
        _estimates("native fill", [(at - _MARKER_OFFSET_PX, entry.native) for at, entry in centred], error),
        _estimates("native fill", [(at, entry.scale) for at, entry in centred], scale),
        _text(_PROFILE_LEFT, _ERROR_TOP - 10, "AbsRel"),
        _text(_PROFILE_LEFT, _SCALE_TOP - 10, "s, native"),
        _text((_PROFILE_LEFT + RIGHT) / 2, height - 4, f"{title}, {unit}", "middle"),
    )


def _estimates(classes: str, estimates: Sequence[tuple[float, MeasureEstimate]], y: Axis) -> str:
    """Return markers at some x, connected by a thin line, with their intervals behind them."""
    kind = classes.partition(" ")[0]
    points = [(x, y.at(one.value)) for x, one in estimates if one.value is not None]
    bars = [_down(x, *map(y.at, one.interval)) for x, one in estimates if one.interval is not None]
    markers = [_circle(classes, *point, 4.5) for point in points]
    return "".join(
        [_path(f"{kind} slim interval", "".join(bars)), _path(f"{kind} trend", _line(points)), *markers]
    )


_CURVES_TOP, _CURVES_BOTTOM = 30.0, 230.0


def precision_chart(title: str, description: str, curves: Mapping[str, Sequence[Point]]) -> Markup:
    """Return the chart of named curves of precision over recall, with a legend."""
    x, y = Axis(0, 1, LEFT, RIGHT, linear=True), Axis(0, 1, _CURVES_BOTTOM, _CURVES_TOP, linear=True)
    body = _x_grid(x, x.ticks(), (_CURVES_TOP, _CURVES_BOTTOM)) + _y_grid(y, y.ticks(), LEFT)
    for index, (name, curve) in enumerate(curves.items()):
        points = [(x.at(recall), y.at(precision)) for recall, precision in curve]
        body += _path(f"line c{index}", _line(points))
        body += "".join(_circle(f"disc c{index}", *point, 3.4) for point in points)
        legend_x, legend_y = LEFT + index * (RIGHT - LEFT) / len(curves), _CURVES_BOTTOM + 54
        body += _circle(f"disc c{index}", legend_x + 4, legend_y - 4, 4) + _text(legend_x + 13, legend_y, name)
    body += _text(LEFT, 16, "precision") + _text(RIGHT, _CURVES_BOTTOM + 36, "recall", "end")
    return _figure(title, description, _CURVES_BOTTOM + 62, body)
