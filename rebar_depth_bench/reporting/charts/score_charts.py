"""Score charts of a result as inline SVG: native and scaled error, scale factors, error by view.

Colours are CSS classes of the page (``native``, ``scaled``, ``axis``, ...), so that the charts follow light and
dark mode. Many points of one kind are drawn as one path of zero-length round strokes, which takes a tenth of the
bytes of circles.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

from markupsafe import Markup

from rebar_depth_bench.errors import printable
from rebar_depth_bench.reporting.charts.axes import (
    WIDTH,
    LogAxis,
    decade_axis,
    log_axis_with_one,
    svg_figure,
    svg_text,
    tick_label,
)
from rebar_depth_bench.scoring.columns import SCALE, number
from rebar_depth_bench.scoring.table import Table, ViewScore

_LEFT, _RIGHT = 14.0, WIDTH - 14.0
_ROW_HEIGHT_PX = 50
_GOLDEN_RATIO = 0.6180339887498949
_ABS_REL_KEYS = ("native.abs_rel", "scaled.abs_rel")


def alignment_chart(tables: Mapping[str, Table]) -> Markup:
    """Return the chart of AbsRel by config on a logarithmic axis, native (disc) connected to scaled (ring)."""
    metrics_by_config = {name: (table.native, table.scaled) for name, table in tables.items()}
    values = [metrics.abs_rel for pair in metrics_by_config.values() for metrics in pair if metrics]
    values += [end for table in tables.values() for key in _ABS_REL_KEYS for end in table.intervals.get(key) or ()]
    axis = decade_axis(values, _LEFT, _RIGHT)
    rows = []
    for index, (name, (native, scaled)) in enumerate(metrics_by_config.items()):
        y = _row_y(index)
        if native is None or scaled is None:
            rows.append(_row_title(name, "no prediction", y))
            continue
        x = [axis.at(metrics.abs_rel) for metrics in (native, scaled)]
        numbers = f"{number(native.abs_rel, 4)} → {number(scaled.abs_rel, 4)} scaled"
        rows.append(_row_title(name, numbers, y))
        rows.append(f'<path class="link" d="M{x[0]:.1f} {y}H{x[1]:.1f}"/>')
        rows += [
            _interval_bar(tables[name].intervals.get(key), axis, y, key.partition(".")[0]) for key in _ABS_REL_KEYS
        ]
        rows.append(f'<circle class="native fill" cx="{x[0]:.1f}" cy="{y}" r="6"/>')
        rows.append(f'<circle class="scaled ring" cx="{x[1]:.1f}" cy="{y}" r="5"/>')
    bottom = _row_y(len(metrics_by_config)) - 20
    body = _vertical_grid(axis, bottom) + "".join(rows)
    description = "AbsRel of each config, native and after the oracle scale: " + _description(
        tables, _abs_rel_text
    )
    return svg_figure("Native and scaled AbsRel by config", description, bottom + 22, body)


def scale_chart(tables: Mapping[str, Table], views: Mapping[str, Sequence[ViewScore]]) -> Markup:
    """Return the chart of every view's scale factor, one strip per config, with its median and the line s = 1."""
    scales = {name: [v.scale for v in views.get(name, ()) if v.scale is not None] for name in tables}
    axis = log_axis_with_one([scale for strip in scales.values() for scale in strip], _LEFT, _RIGHT)
    bottom = _row_y(len(tables)) - 20
    rows = [f'<path class="one" d="M{axis.at(1.0):.1f} 14V{bottom}"/>']
    for index, (name, strip) in enumerate(scales.items()):
        y = _row_y(index)
        points = [(axis.at(s), y - 9 + 18 * (i * _GOLDEN_RATIO % 1)) for i, s in enumerate(strip)]
        rows.append(_row_title(name, f"median s {SCALE.text(tables[name].scale_median)}", y))
        rows.append(_dots(points, "points"))
        rows.append(_median_mark(tables[name].scale_median, axis, y))
    description = (
        "Scale factor s = median(z)/median(p) of every view: 1 is metric, below 1 the prediction is too far. "
        + _description(tables, lambda table: f"median {SCALE.text(table.scale_median)}")
    )
    return svg_figure(
        "Scale factor of each view", description, bottom + 22, _vertical_grid(axis, bottom) + "".join(rows)
    )


def views_chart(config: str, views: Sequence[ViewScore]) -> Markup:
    """Return the chart of AbsRel by view in protocol order, native and scaled.

    Views without any prediction are marked along the top.
    """
    top, bottom, left = 26.0, 170.0, 52.0
    errors = [m.abs_rel for view in views for m in (view.native, view.scaled) if m]
    axis = decade_axis(errors, bottom, top)
    x = [left + 6 + (_RIGHT - left - 12) * (i + 0.5) / max(len(views), 1) for i in range(len(views))]
    native = [(at, axis.at(v.native.abs_rel)) for at, v in zip(x, views, strict=True) if v.native]
    scaled = [(at, axis.at(v.scaled.abs_rel)) for at, v in zip(x, views, strict=True) if v.scaled]
    missing = "".join(f"M{at:.1f} 8v10" for at, v in zip(x, views, strict=True) if v.native is None)
    body = _horizontal_grid(axis, left) + _dots(scaled, "scaled points") + _dots(native, "native points")
    body += f'<path class="missing" d="{missing}"/>' if missing else ""
    body += svg_text(left + 6, bottom + 18, "first view") + svg_text(_RIGHT, bottom + 18, "last view", "end")
    without = sum(view.native is None for view in views)
    description = f"AbsRel of the {len(views)} views of {printable(config)}, {without} without any prediction."
    return svg_figure(f"AbsRel by view, {printable(config)}", description, bottom + 26, body)


def _row_y(index: int) -> int:
    return 42 + index * _ROW_HEIGHT_PX


def _row_title(name: str, numbers: str, y: float) -> str:
    """Return a row's name on the left and its numbers on the right, above the row's markers."""
    return svg_text(_LEFT, y - 17, printable(name), "start name") + svg_text(_RIGHT, y - 17, numbers, "end")


def _vertical_grid(axis: LogAxis, bottom: float) -> str:
    lines = "".join(f"M{axis.at(tick):.1f} 10V{bottom:g}" for tick in axis.ticks())
    labels = "".join(
        svg_text(round(axis.at(t), 1), bottom + 15, tick_label(t), _text_anchor(axis, t)) for t in axis.ticks()
    )
    return f'<path class="axis" d="{lines}"/>{labels}'


def _text_anchor(axis: LogAxis, tick: float) -> str:
    """Return the text anchor of a tick's label that keeps it inside the view box."""
    x = axis.at(tick)
    if x < _LEFT + 14:
        return "start"
    return "end" if x > _RIGHT - 14 else "middle"


def _horizontal_grid(axis: LogAxis, left: float) -> str:
    lines = "".join(f"M{left:g} {axis.at(tick):.1f}H{_RIGHT:g}" for tick in axis.ticks())
    labels = "".join(svg_text(left - 6, round(axis.at(t) + 4, 1), tick_label(t), "end") for t in axis.ticks())
    return f'<path class="axis" d="{lines}"/>{labels}'


def _dots(points: Sequence[tuple[float, float]], classes: str) -> str:
    if not points:
        return ""
    path = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in points)
    return f'<path class="{classes}" d="{path}"/>'


def _median_mark(scale: float | None, axis: LogAxis, y: float) -> str:
    if scale is None or not math.isfinite(scale):
        return ""
    return f'<path class="median" d="M{axis.at(scale):.1f} {y - 12}v24"/>'


def _interval_bar(interval: tuple[float, float] | None, axis: LogAxis, y: float, kind: str) -> str:
    """Return a config's interval as a wide pale bar behind its marker."""
    if interval is None:
        return ""
    low, high = (axis.at(end) for end in interval)
    return f'<path class="{kind} interval" d="M{low:.1f} {y}H{high:.1f}"/>'


def _abs_rel_text(table: Table) -> str:
    native, scaled = (m.abs_rel if m else None for m in (table.native, table.scaled))
    return f"native {number(native, 4)}, scaled {number(scaled, 4)}"


def _description(tables: Mapping[str, Table], describe: Callable[[Table], str]) -> str:
    return "; ".join(f"{printable(name)}: {describe(table)}" for name, table in tables.items()) + "."
