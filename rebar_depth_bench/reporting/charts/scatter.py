"""Native against oracle-scaled AbsRel, the paper's Figure 2: published points hollow, this archive's solid."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from markupsafe import Markup

from rebar_depth_bench.reporting.charts.axes import WIDTH, LogAxis, decade_axis, label, svg_figure, svg_text
from rebar_depth_bench.reporting.formatting import number, printable

_LEFT, _RIGHT, _TOP, _BOTTOM = 52.0, WIDTH - 14.0, 14.0, 286.0
_HALF_WIDTH, _HALF_HEIGHT = 8.0, 8.0
_DIRECTIONS = ((1, 0), (-1, 0), (0, -1), (0, 1), (1, -1), (-1, 1), (1, 1), (-1, -1))
_REACHES = (15.0, 24.0, 34.0)
_MARGINS = (0.93, 1.07)

Ends = tuple[float, float] | None


@dataclass(frozen=True)
class ScatterPoint:
    """One row's two AbsRel values, their intervals where known, and the ``mark`` that its row carries too."""

    mark: str
    name: str
    native: float
    scaled: float
    published: bool
    native_interval: Ends = None
    scaled_interval: Ends = None


def scatter_chart(title: str, points: Sequence[ScatterPoint]) -> Markup:
    """Return the points on two logarithmic axes: native AbsRel to the right, scaled AbsRel upwards.

    The dashed line is native = scaled: on it one scale per view changes nothing, far below it scale is all.
    """
    x_axis = decade_axis(_reached((p.native, p.native_interval) for p in points), _LEFT, _RIGHT)
    y_axis = decade_axis(_reached((p.scaled, p.scaled_interval) for p in points), _BOTTOM, _TOP)
    places = [(x_axis.at(p.native), y_axis.at(p.scaled)) for p in points]
    marks = [_mark(point, *place, x_axis, y_axis) for point, place in zip(points, places, strict=True)]
    labels = [
        svg_text(round(x, 1), round(y + 4.5, 1), point.mark, "middle" if point.published else "middle name")
        for point, (x, y) in zip(points, label_places(places), strict=True)
    ]
    body = _grid(x_axis, y_axis) + _diagonal(x_axis, y_axis) + "".join(marks) + "".join(labels)
    spoken = "; ".join(
        f"{p.mark}: {printable(p.name)}{', published' if p.published else ''}, "
        f"native {number(p.native, 4)}, scaled {number(p.scaled, 4)}"
        for p in points
    )
    return svg_figure(title, f"AbsRel native and after the oracle scale. {spoken}.", _BOTTOM + 42, body)


def label_places(places: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return a label's middle for each point, pixels: the nearest place where it meets no point and no label."""
    placed: list[tuple[float, float]] = []
    for x, y in places:
        candidates = [(x + reach * dx, y + reach * dy) for reach in _REACHES for dx, dy in _DIRECTIONS]
        inside = [(cx, cy) for cx, cy in candidates if _LEFT + 8 < cx < _RIGHT - 8 and _TOP < cy < _BOTTOM - 8]
        placed.append(min(inside or candidates, key=lambda at: _met(at, [*places, *placed])))
    return placed


def _met(at: tuple[float, float], others: Iterable[tuple[float, float]]) -> int:
    return sum(abs(at[0] - x) < 2 * _HALF_WIDTH - 2 and abs(at[1] - y) < 2 * _HALF_HEIGHT - 2 for x, y in others)


def _reached(values: Iterable[tuple[float, Ends]]) -> list[float]:
    found = [number for value, ends in values for number in (value, *(ends or ()))]
    return [number * margin for number in found for margin in _MARGINS]


def _mark(point: ScatterPoint, x: float, y: float, x_axis: LogAxis, y_axis: LogAxis) -> str:
    if point.published:
        return f'<circle class="published ring" cx="{x:.1f}" cy="{y:.1f}" r="5"/>'
    bars = ""
    if point.native_interval:
        low, high = map(x_axis.at, point.native_interval)
        bars += f'<path class="bars" d="M{low:.1f} {y:.1f}H{high:.1f}"/>'
    if point.scaled_interval:
        low, high = map(y_axis.at, point.scaled_interval)
        bars += f'<path class="bars" d="M{x:.1f} {low:.1f}V{high:.1f}"/>'
    return f'{bars}<circle class="native fill" cx="{x:.1f}" cy="{y:.1f}" r="6"/>'


def _diagonal(x_axis: LogAxis, y_axis: LogAxis) -> str:
    low, high = max(x_axis.low, y_axis.low), min(x_axis.high, y_axis.high)
    if low >= high:
        return ""
    ends = ((x_axis.at(low), y_axis.at(low)), (x_axis.at(high), y_axis.at(high)))
    return '<path class="one" d="M{:.1f} {:.1f}L{:.1f} {:.1f}"/>'.format(*ends[0], *ends[1])


def _grid(x_axis: LogAxis, y_axis: LogAxis) -> str:
    lines = "".join(f"M{x_axis.at(t):.1f} {_TOP:g}V{_BOTTOM:g}" for t in x_axis.ticks())
    lines += "".join(f"M{_LEFT:g} {y_axis.at(t):.1f}H{_RIGHT:g}" for t in y_axis.ticks())
    labels = [svg_text(round(x_axis.at(t), 1), _BOTTOM + 17, label(t), "middle") for t in x_axis.ticks()]
    labels += [svg_text(_LEFT - 7, round(y_axis.at(t) + 4.5, 1), label(t), "end") for t in y_axis.ticks()]
    titles = svg_text((_LEFT + _RIGHT) / 2, _BOTTOM + 36, "native AbsRel", "middle")
    titles += (
        f'<g transform="rotate(-90 12 {_BOTTOM / 2:g})">{svg_text(12, _BOTTOM / 2, "scaled AbsRel", "middle")}</g>'
    )
    return f'<path class="axis" d="{lines}"/>{"".join(labels)}{titles}'
