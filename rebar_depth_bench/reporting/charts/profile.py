"""Profile charts as inline SVG: error and scale by distance or by bar width in the image."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from markupsafe import Markup

from rebar_depth_bench.extended.result import MeasureEstimate
from rebar_depth_bench.reporting.charts.axes import (
    WIDTH,
    LogAxis,
    decade_axis,
    log_axis_with_one,
    select_spaced,
    svg_figure,
    svg_text,
    tick_label,
)
from rebar_depth_bench.scoring.columns import SCALE, number

_LEFT, _RIGHT = 52.0, WIDTH - 14.0
_ERROR_TOP, _ERROR_BOTTOM = 24.0, 164.0
_SCALE_TOP, _SCALE_BOTTOM = 200.0, 270.0
_HEIGHT = _SCALE_BOTTOM + 42
_MARKER_OFFSET_PX = 6.0
_LABEL_LINE_PX, _LABEL_GAP_PX = 15.0, 7.0
_DIGIT_WIDTH_PX = 7.4


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
    known_bins = [entry for entry in bins if entry.native.value is not None]
    if not known_bins:
        return Markup()
    x = LogAxis(known_bins[0].low, known_bins[-1].high, _LEFT, _RIGHT)
    error = decade_axis(
        _axis_values(estimate for entry in known_bins for estimate in (entry.native, entry.scaled)),
        _ERROR_BOTTOM,
        _ERROR_TOP,
    )
    scale = log_axis_with_one(_axis_values(entry.scale for entry in known_bins), _SCALE_BOTTOM, _SCALE_TOP)
    body = (
        _edge_grid(x, known_bins) + _value_grid(error, error.ticks()) + _value_grid(scale, [1.0, *scale.ticks()])
    )
    body += f'<path class="one" d="M{_LEFT:g} {scale.at(1.0):.1f}H{_RIGHT:g}"/>'
    centred = [((x.at(entry.low) + x.at(entry.high)) / 2, entry) for entry in known_bins]
    body += _series([(at + _MARKER_OFFSET_PX, entry.scaled) for at, entry in centred], error, "scaled", "ring")
    body += _series([(at - _MARKER_OFFSET_PX, entry.native) for at, entry in centred], error, "native", "fill")
    body += _series([(at, entry.scale) for at, entry in centred], scale, "native", "fill")
    body += svg_text(_LEFT, _ERROR_TOP - 10, "AbsRel") + svg_text(_LEFT, _SCALE_TOP - 10, "s, native")
    body += svg_text((_LEFT + _RIGHT) / 2, _HEIGHT - 4, f"{title}, {unit}", "middle")
    return svg_figure(f"Against {title}", f"By {title}: {_description(known_bins, unit)}.", _HEIGHT, body)


def _axis_values(estimates: Iterable[MeasureEstimate]) -> list[float]:
    values = [
        value
        for estimate in estimates
        for value in (estimate.value, *(estimate.interval or ()))
        if value is not None
    ]
    return [value * margin for value in values for margin in (0.95, 1.05)]


def _edge_grid(x: LogAxis, bins: Sequence[ProfileBin]) -> str:
    """Return a line at each bin edge through both plots, and the labels of the edges that do not overlap."""
    edges = sorted({edge for profile_bin in bins for edge in (profile_bin.low, profile_bin.high)})
    lines = "".join(
        f"M{x.at(edge):.1f} {top:g}V{bottom:g}"
        for edge in edges
        for top, bottom in ((_ERROR_TOP, _ERROR_BOTTOM), (_SCALE_TOP, _SCALE_BOTTOM))
    )
    label_width_px = _DIGIT_WIDTH_PX * max(len(tick_label(edge)) for edge in edges)
    labels = [
        svg_text(round(x.at(edge), 1), _SCALE_BOTTOM + 17, tick_label(edge), "middle")
        for edge in select_spaced(edges, x, label_width_px)
    ]
    return f'<path class="axis" d="{lines}"/>{"".join(labels)}'


def _value_grid(axis: LogAxis, ticks: Sequence[float]) -> str:
    labelled = select_spaced(ticks, axis, _LABEL_LINE_PX)
    lines = "".join(f"M{_LEFT:g} {axis.at(tick):.1f}H{_RIGHT:g}" for tick in labelled)
    labels = [svg_text(_LEFT - _LABEL_GAP_PX, round(axis.at(t) + 4.5, 1), tick_label(t), "end") for t in labelled]
    return f'<path class="axis" d="{lines}"/>{"".join(labels)}'


def _series(points: Sequence[tuple[float, MeasureEstimate]], y: LogAxis, kind: str, mark: str) -> str:
    """Return one alignment's markers, connected by a thin line, with their intervals behind them."""
    points_px = [(x, y.at(estimate.value)) for x, estimate in points if estimate.value is not None]
    path = "L".join(f"{x:.1f} {y_px:.1f}" for x, y_px in points_px)
    bars = "".join(
        f"M{x:.1f} {y.at(estimate.interval[0]):.1f}V{y.at(estimate.interval[1]):.1f}"
        for x, estimate in points
        if estimate.interval is not None
    )
    body = f'<path class="{kind} slim interval" d="{bars}"/>' if bars else ""
    body += f'<path class="{kind} trend" d="M{path}"/>' if len(points_px) > 1 else ""
    return body + "".join(
        f'<circle class="{kind} {mark}" cx="{x:.1f}" cy="{y_px:.1f}" r="4.5"/>' for x, y_px in points_px
    )


def _description(bins: Sequence[ProfileBin], unit: str) -> str:
    return "; ".join(
        f"{entry.low:g} to {entry.high:g} {unit}: AbsRel native {number(entry.native.value, 4)}, "
        f"scaled {number(entry.scaled.value, 4)}, s {SCALE.text(entry.scale.value)}"
        for entry in bins
    )
