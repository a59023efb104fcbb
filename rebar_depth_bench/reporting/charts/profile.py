"""Inline SVG charts of error and scale against distance or against how wide a bar is in the picture."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from markupsafe import Markup

from rebar_depth_bench.extended.result import Estimate
from rebar_depth_bench.reporting.charts.axes import (
    WIDTH,
    LogAxis,
    decade_axis,
    label,
    svg_figure,
    svg_text,
    unit_axis,
)
from rebar_depth_bench.reporting.formatting import number, scale_cell

_LEFT, _RIGHT = 52.0, WIDTH - 14.0
_ERROR_TOP, _ERROR_BOTTOM = 24.0, 164.0
_SCALE_TOP, _SCALE_BOTTOM = 200.0, 270.0
_HEIGHT = _SCALE_BOTTOM + 42
_ASIDE = 6.0
_LINE, _LABEL_GAP = 15.0, 7.0
_DIGIT = 7.4


@dataclass(frozen=True)
class ProfileBin:
    """What a config's views say between two edges: AbsRel under both alignments, and the native s."""

    low: float
    high: float
    native: Estimate
    scaled: Estimate
    scale: Estimate


def profile_chart(title: str, unit: str, bins: Sequence[ProfileBin]) -> Markup:
    """Return AbsRel by bin, native (disc) and scaled (ring), above s by bin; nothing where no bin has a value.

    ``unit`` is what the edges are in. All axes are logarithmic; bars are 95 % intervals.
    """
    known = [one for one in bins if one.native.value is not None]
    if not known:
        return Markup()
    x = LogAxis(known[0].low, known[-1].high, _LEFT, _RIGHT)
    error = decade_axis(_reached(e for one in known for e in (one.native, one.scaled)), _ERROR_BOTTOM, _ERROR_TOP)
    scale = unit_axis(_reached(one.scale for one in known), _SCALE_BOTTOM, _SCALE_TOP)
    body = _edges(x, known) + _rows(error, error.ticks()) + _rows(scale, [1.0, *scale.ticks()])
    body += f'<path class="one" d="M{_LEFT:g} {scale.at(1.0):.1f}H{_RIGHT:g}"/>'
    body += _series([(_middle(x, one) + _ASIDE, one.scaled) for one in known], error, "scaled", "ring")
    body += _series([(_middle(x, one) - _ASIDE, one.native) for one in known], error, "native", "fill")
    body += _series([(_middle(x, one), one.scale) for one in known], scale, "native", "fill")
    body += svg_text(_LEFT, _ERROR_TOP - 10, "AbsRel") + svg_text(_LEFT, _SCALE_TOP - 10, "s, native")
    body += svg_text((_LEFT + _RIGHT) / 2, _HEIGHT - 4, f"{title}, {unit}", "middle")
    return svg_figure(f"Against {title}", f"By {title}: {_spoken(known, unit)}.", _HEIGHT, body)


def spaced(values: Iterable[float], axis: LogAxis, room: float) -> list[float]:
    """Return the values that lie ``room`` pixels or more from each one kept before; the first one always stays."""
    kept: list[float] = []
    for value in values:
        if all(abs(axis.at(value) - axis.at(other)) >= room for other in kept):
            kept.append(value)
    return kept


def _reached(estimates: Iterable[Estimate]) -> list[float]:
    found = [end for one in estimates for end in (one.value, *(one.interval or ())) if end is not None]
    return [end * margin for end in found for margin in (0.95, 1.05)]


def _middle(x: LogAxis, one: ProfileBin) -> float:
    return (x.at(one.low) + x.at(one.high)) / 2


def _edges(x: LogAxis, bins: Sequence[ProfileBin]) -> str:
    """Return a line at each edge of a bin through both parts, and as many edges' labels as have room."""
    edges = sorted({edge for one in bins for edge in (one.low, one.high)})
    lines = "".join(
        f"M{x.at(edge):.1f} {top:g}V{bottom:g}"
        for edge in edges
        for top, bottom in ((_ERROR_TOP, _ERROR_BOTTOM), (_SCALE_TOP, _SCALE_BOTTOM))
    )
    room = _DIGIT * max(len(label(edge)) for edge in edges)
    labels = [
        svg_text(round(x.at(edge), 1), _SCALE_BOTTOM + 17, label(edge), "middle")
        for edge in spaced(edges, x, room)
    ]
    return f'<path class="axis" d="{lines}"/>{"".join(labels)}'


def _rows(axis: LogAxis, ticks: Sequence[float]) -> str:
    shown = spaced(ticks, axis, _LINE)
    lines = "".join(f"M{_LEFT:g} {axis.at(tick):.1f}H{_RIGHT:g}" for tick in shown)
    labels = [svg_text(_LEFT - _LABEL_GAP, round(axis.at(t) + 4.5, 1), label(t), "end") for t in shown]
    return f'<path class="axis" d="{lines}"/>{"".join(labels)}'


def _series(points: Sequence[tuple[float, Estimate]], y: LogAxis, kind: str, mark: str) -> str:
    """Return one alignment's marks, joined by a thin line, with their intervals behind them."""
    places = [(x, y.at(one.value)) for x, one in points if one.value is not None]
    joined = "L".join(f"{x:.1f} {at:.1f}" for x, at in places)
    bars = "".join(
        f"M{x:.1f} {y.at(one.interval[0]):.1f}V{y.at(one.interval[1]):.1f}"
        for x, one in points
        if one.interval is not None
    )
    body = f'<path class="{kind} slim interval" d="{bars}"/>' if bars else ""
    body += f'<path class="{kind} trend" d="M{joined}"/>' if len(places) > 1 else ""
    return body + "".join(
        f'<circle class="{kind} {mark}" cx="{x:.1f}" cy="{at:.1f}" r="4.5"/>' for x, at in places
    )


def _spoken(bins: Sequence[ProfileBin], unit: str) -> str:
    return "; ".join(
        f"{one.low:g} to {one.high:g} {unit}: AbsRel native {number(_finite(one.native), 4)}, "
        f"scaled {number(_finite(one.scaled), 4)}, s {scale_cell(_finite(one.scale))}"
        for one in bins
    )


def _finite(one: Estimate) -> float | None:
    return one.value if one.value is not None and math.isfinite(one.value) else None
