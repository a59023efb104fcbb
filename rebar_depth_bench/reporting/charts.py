"""Charts of pages as inline SVG, made of the same grids, lines and marks.

Colours are CSS classes of the page (``native``, ``scaled``, ``axis``, ...), so that the charts follow light and
dark mode. Many points of one kind are drawn as one path of zero-length round strokes, which takes a tenth of the
bytes of circles.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from markupsafe import Markup, escape

from rebar_depth_bench.base.errors import printable
from rebar_depth_bench.reporting.axes import Axis, decade_axis, log_axis_with_one, select_spaced, tick_label
from rebar_depth_bench.scoring.columns import NATIVE, SCALE, SCALED
from rebar_depth_bench.scoring.table import Table, ViewScore

if TYPE_CHECKING:
    from rebar_depth_bench.extended.working_range import WorkingRange

WIDTH = 460
"""View box width, small enough that 13 px text stays readable when a phone shrinks the chart."""
_ROW_LEFT, RIGHT = 14.0, WIDTH - 14.0
"""Ends of the x axis of charts with rows, pixels."""
_DIGIT_WIDTH_PX, _LABEL_LINE_PX = 7.4, 15.0
_GOLDEN_RATIO = 0.6180339887498949


def _figure(title: str, description: str, height: float, body: str) -> Markup:
    """Return an SVG around ``body``, which is markup, with a title and a description for screen readers."""
    return Markup(  # noqa: S704 -- Texts are escaped here and by ``_text``.
        f'<svg class="chart" role="img" viewBox="0 0 {WIDTH} {height:g}">'
        f"<title>{escape(title)}</title><desc>{escape(description)}</desc>{body}</svg>"
    )


def _text(x: float, y: float, content: str, classes: str = "start") -> str:
    """Return a text element with escaped ``content``; ``classes`` sets its anchor (start, middle, end)."""
    return f'<text class="{classes}" x="{round(x, 1):g}" y="{round(y, 1):g}">{escape(content)}</text>'


def _path(classes: str, commands: str) -> str:
    """Return a path element; empty without any commands."""
    return f'<path class="{classes}" d="{commands}"/>' if commands else ""


def _circle(classes: str, x: float, y: float, radius_px: float) -> str:
    return f'<circle class="{classes}" cx="{x:.1f}" cy="{y:.1f}" r="{radius_px:g}"/>'


def _across(low: float, high: float, y: float) -> str:
    """Return the path commands of a horizontal line."""
    return f"M{low:.1f} {y:.1f}H{high:.1f}"


def _down(x: float, top: float, bottom: float) -> str:
    """Return the path commands of a vertical line."""
    return f"M{x:.1f} {top:.1f}V{bottom:.1f}"


def _dots(kind: str, points: Sequence[tuple[float, float]]) -> str:
    """Return a path with a dot at each point, which is larger if they are few."""
    size = "large points" if len(points) <= 60 else "points"
    return _path(f"{kind} {size}", "".join(f"M{x:.1f} {y:.1f}h0" for x, y in points))


def _x_grid(axis: Axis, top: float, bottom: float) -> str:
    """Return vertical lines at the ticks of an axis, and labels below them.

    Labels that would overlap others are left out; those at the border of the figure are aligned to it.
    """
    ticks = axis.ticks()
    lines = "".join(_down(axis.at(value), top, bottom) for value in ticks)
    width_px = _DIGIT_WIDTH_PX * max(len(tick_label(value)) for value in ticks)
    labels = []
    for value in select_spaced(ticks, axis, width_px):
        x = axis.at(value)
        anchor = "start" if x < 28 else "end" if x > WIDTH - 28 else "middle"
        labels.append(_text(x, bottom + 17, tick_label(value), anchor))
    return _path("axis", lines) + "".join(labels)


def _y_grid(axis: Axis, left: float) -> str:
    """Return horizontal lines from ``left`` on at the ticks of an axis, with labels that do not overlap."""
    shown = select_spaced(axis.ticks(), axis, _LABEL_LINE_PX)
    lines = "".join(_across(left, RIGHT, axis.at(value)) for value in shown)
    labels = [_text(left - 7, axis.at(value) + 4.5, tick_label(value), "end") for value in shown]
    return _path("axis", lines) + "".join(labels)


_ABS_REL = {"native": NATIVE[0], "scaled": SCALED[0]}


def alignment_chart(tables: Mapping[str, Table]) -> Markup:
    """Return the chart of AbsRel by config on a logarithmic axis, native (disc) connected to scaled (ring)."""
    cells = [(table, column) for table in tables.values() for column in _ABS_REL.values()]
    errors = [end for table, column in cells for end in (table[column.place], *(table.interval(column) or ()))]
    axis = decade_axis(errors, _ROW_LEFT, RIGHT)
    rows = []
    for name, table in tables.items():
        native, scaled = (table[column.place] for column in _ABS_REL.values())
        if math.isnan(native):
            rows.append((name, "no prediction", ""))
            continue
        marks = _path("link", _across(axis.at(native), axis.at(scaled), 0))
        for kind, column in _ABS_REL.items():
            if ends := table.interval(column):
                marks += _path(f"{kind} interval", _across(axis.at(ends[0]), axis.at(ends[1]), 0))
        marks += _circle("scaled ring", axis.at(scaled), 0, 6) + _circle("native fill", axis.at(native), 0, 4.5)
        rows.append((name, f"{NATIVE[0].text(native)} → {SCALED[0].text(scaled)} scaled", marks))
    description = "AbsRel of each config, native and after the oracle scale"
    return _rows_chart("Native and scaled AbsRel by config", description, axis, rows)


def scale_chart(tables: Mapping[str, Table], views: Mapping[str, Sequence[ViewScore]]) -> Markup:
    """Return the chart of every view's scale factor, one strip per config, with its median and the line s = 1."""
    axis = log_axis_with_one([view["scale"] for scores in views.values() for view in scores], _ROW_LEFT, RIGHT)
    rows = []
    for name, table in tables.items():
        median = table[SCALE.place]
        scales = [view["scale"] for view in views.get(name, ()) if not math.isnan(view["scale"])]
        points = [(axis.at(scale), -9 + 18 * (i * _GOLDEN_RATIO % 1)) for i, scale in enumerate(scales)]
        marks = _path("one", _down(axis.at(1.0), -13, 13)) + _dots("scaled", points)
        if math.isfinite(median):
            marks += _path("median", _down(axis.at(median), -12, 12))
        rows.append((name, f"median s {SCALE.text(median)}", marks))
    description = "Scale factor s = median(z)/median(p) of every view; below 1 the prediction is too far"
    return _rows_chart("Scale factor of each view", description, axis, rows)


def _rows_chart(title: str, description: str, axis: Axis, rows: Sequence[tuple[str, str, str]]) -> Markup:
    """Return a chart with a row per config: its name on the left and its numbers on the right, above its marks.

    ``rows`` are (name, numbers, marks), marks around y = 0.
    """
    bottom = 22 + 50 * len(rows)
    body = _x_grid(axis, 10, bottom)
    for index, (name, numbers, marks) in enumerate(rows):
        texts = _text(_ROW_LEFT, -17, printable(name), "start name") + _text(RIGHT, -17, numbers, "end")
        body += f'<g transform="translate(0 {42 + 50 * index})">{marks}{texts}</g>'
    described = "; ".join(f"{printable(name)}: {numbers}" for name, numbers, _ in rows)
    return _figure(title, f"{description}. {described}.", bottom + 22, body)


def views_chart(config: str, views: Sequence[ViewScore]) -> Markup:
    """Return the chart of AbsRel by view, native and scaled; views without any prediction have a mark on top."""
    top, bottom, left = 26.0, 170.0, 52.0
    errors = {kind: [view[column.place] for view in views] for kind, column in _ABS_REL.items()}
    x = Axis(0, len(views), left + 6, RIGHT - 6, linear=True)
    y = decade_axis([*errors["native"], *errors["scaled"]], bottom, top)
    body = _y_grid(y, left)
    for kind in ("scaled", "native"):
        points = [(x.at(i + 0.5), y.at(error)) for i, error in enumerate(errors[kind]) if not math.isnan(error)]
        body += _dots(kind, points)
    without = [x.at(i + 0.5) for i, error in enumerate(errors["native"]) if math.isnan(error)]
    body += _path("missing", "".join(_down(at, 8, 18) for at in without))
    body += _text(left + 6, bottom + 18, "first view") + _text(RIGHT, bottom + 18, "last view", "end")
    name = printable(config)
    description = f"AbsRel of the {len(views)} views of {name}, {len(without)} without any prediction."
    return _figure(f"AbsRel by view, {name}", description, bottom + 26, body)


def precision_chart(title: str, description: str, curves: Mapping[str, Sequence[tuple[float, float]]]) -> Markup:
    """Return the chart of named curves of precision over recall, with a legend."""
    top, bottom, left = 30.0, 230.0, 64.0
    x, y = Axis(0, 1, left, RIGHT, linear=True), Axis(0, 1, bottom, top, linear=True)
    body = _x_grid(x, top, bottom) + _y_grid(y, left)
    for index, (name, curve) in enumerate(curves.items()):
        points = [(x.at(recall), y.at(precision)) for recall, precision in curve]
        body += _polyline(f"line c{index}", points)
        body += "".join(_circle(f"disc c{index}", *point, 3.4) for point in points)
        legend_x, legend_y = left + index * (RIGHT - left) / len(curves), bottom + 54
        body += _circle(f"disc c{index}", legend_x + 4, legend_y - 4, 4) + _text(legend_x + 13, legend_y, name)
    body += _text(left, 16, "precision") + _text(RIGHT, bottom + 36, "recall", "end")
    return _figure(title, description, bottom + 62, body)


SERIES_COLOURS = 6
"""Number of colours of lines, ``c0`` and so on; the next lines have the same ones, dashed."""


def series_classes(index: int) -> str:
    """Return the classes of the line of a series, and of its sign in a legend."""
    return f"c{index % SERIES_COLOURS}{' dashed' if index // SERIES_COLOURS % 2 else ''}"


def range_chart(title: str, panels: Mapping[str, Mapping[str, WorkingRange]]) -> Markup | None:
    """Return the chart of working ranges for one task: the share that passes against distance, on a log axis.

    ``panels`` have the title of an alignment and the working range of each method, a line with intervals. Exact
    depth and the plane are grey, and tested bins have a band. An alignment without bins has no panel, and the
    result is None if none has any.
    """
    panels = {name: by_method for name, by_method in panels.items() if next(iter(by_method.values())).bins}
    if not panels:
        return None
    edges_m = {
        edge_m
        for by_method in panels.values()
        for one in by_method.values()
        for of_bin in one.bins
        for edge_m in (of_bin.from_m, of_bin.to_m)
    }
    top, bottom, left, gap = 34.0, 170.0, 40.0, 22.0
    width = (RIGHT - left - gap * (len(panels) - 1)) / len(panels)
    y = Axis(0, 100, bottom, top, linear=True)
    body, described = "", []
    for place, (name, by_method) in enumerate(panels.items()):
        start = left + place * (width + gap)
        x = Axis(min(edges_m), max(edges_m), start, start + width)
        first = next(iter(by_method.values())).bins  # Samples, exact depth and the plane are the truth's.
        for one in first:
            if not one.reasons:
                body += _path("tested", _across(x.at(one.from_m), x.at(one.to_m), (top + bottom) / 2))
        lines = [_across(start, start + width, y.at(percent)) for percent in range(0, 101, 25)]
        body += _path("axis", "".join([*lines, *(_down(x.at(edge_m), top, bottom) for edge_m in sorted(edges_m))]))
        body += _path("one", _across(start, start + width, y.at(95)))
        for edge_m in select_spaced([x.low, x.high, *sorted(edges_m)], x, 4.5 * _DIGIT_WIDTH_PX):
            anchor = {x.low: "start", x.high: "end"}.get(edge_m, "middle")
            body += _text(x.at(edge_m), bottom + 17, tick_label(edge_m), anchor)
        body += _text(start, top - 12, name, "start")
        middles = [x.at(math.sqrt(one.from_m * one.to_m)) for one in first]
        for kind in ("exact", "plane"):
            body += _polyline(
                f"{kind} line", zip(middles, (y.at(100 * getattr(one, kind)) for one in first), strict=True)
            )
        for index, (method, of_method) in enumerate(by_method.items()):
            # Intervals at one distance would hide each other.
            shift = (index - (len(by_method) - 1) / 2) * min(5.0, 0.6 * width / len(first) / len(by_method))
            points = [
                (x.at(math.sqrt(one.from_m * one.to_m)) + shift, y.at(100 * one.share)) for one in of_method.bins
            ]
            classes = series_classes(index)
            ends = (
                _down(px, y.at(100 * one.low), y.at(100 * one.high))
                for (px, _), one in zip(points, of_method.bins, strict=True)
            )
            body += _path(f"whisker {classes}", "".join(ends)) + _polyline(f"line {classes}", points)
            body += "".join(
                _circle(f"disc {classes}" if not one.reasons else f"untested {classes}", *point, 3.2)
                for point, one in zip(points, of_method.bins, strict=True)
            )
            shares = ", ".join(f"{one.from_m:g} to {one.to_m:g} m: {one.share:.0%}" for one in of_method.bins)
            described.append(f"{name}, {printable(method)}: {shares}")
    for percent in (0, 50, 95):
        body += _text(left - 6, y.at(percent) + 4.5, str(percent), "end")
    return _figure(
        title, f"Share within the limit, per cent, by distance. {'; '.join(described)}.", bottom + 26, body
    )


def _polyline(classes: str, points: Iterable[tuple[float, float]]) -> str:
    """Return a path through the points."""
    commands = "L".join(f"{x:.1f} {y:.1f}" for x, y in points)
    return _path(classes, commands and f"M{commands}")
