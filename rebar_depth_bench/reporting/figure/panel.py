"""One panel of the figure: logarithmic axes, diagonal, reference lines and the points of a config."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from rebar_depth_bench.reporting.charts.axes import LogAxis, decade_axis, select_spaced, tick_label
from rebar_depth_bench.reporting.figure.content import ANCHORED_MARK, FigurePoint, Panel
from rebar_depth_bench.reporting.figure.drawing import (
    GREY,
    INK,
    PALE,
    Element,
    Marker,
    Path,
    Point,
    Text,
    text_width,
)
from rebar_depth_bench.reporting.figure.markers import archive_marker, published_marker

TITLE_SIZE, LABEL_SIZE, TICK_SIZE = 7.5, 7.0, 6.2
LEFT, RIGHT, TOP, BOTTOM = 39.0, 7.0, 14.0, 27.0
"""Space around the frame of a panel for title, labels and tick labels, points."""

CONSTANT_DASH, ONE_PIXEL_DASH, DIAGONAL_DASH = (5.0, 2.0), (1.2, 1.8), (6.0, 2.0, 1.2, 2.0)
LIMITS = (1e-3, 1e4)
"""Smallest and largest error of the axes; points beyond are drawn on the frame."""

_MARGIN_FACTORS = (0.85, 1.18)
_MARK_DIRECTIONS = ((1, -1), (1, 1), (-1, -1), (-1, 1), (0, -1), (0, 1), (1, 0), (-1, 0))


@dataclass(frozen=True)
class Frame:
    """Frame of a panel on the page, and its axes: native AbsRel along x, scaled AbsRel along y."""

    left: float
    top: float
    right: float
    bottom: float
    x: LogAxis
    y: LogAxis

    def at(self, native: float, scaled: float) -> Point:
        """Return the place of a point; on the frame if it is beyond the axes."""
        return self.x.at(native), self.y.at(scaled)


def frame_of(panel: Panel, left: float, top: float, right: float, bottom: float) -> Frame:
    """Return the frame of a panel whose axes hold its points and references.

    The x axis also covers the y axis, so that the diagonal crosses the panel.
    """
    scaled = [point.scaled for point in panel.points] + list(panel.constants.values())
    native = [point.native for point in panel.points] + _defined(panel.reference.one_pixel.abs_rel)
    y = decade_axis(_with_margin(scaled), bottom, top)
    x = decade_axis([*_with_margin(native), *((y.low, y.high) if scaled else ())], left, right)
    return Frame(left, top, right, bottom, x, y)


def is_beyond(panel: Panel) -> bool:
    """Return whether anything is drawn on the frame of a panel because the axes do not reach it."""
    errors = [error for point in panel.points for error in (point.native, point.scaled)]
    errors += [*panel.constants.values(), *_defined(panel.reference.one_pixel.abs_rel)]
    return not all(LIMITS[0] <= error <= LIMITS[1] for error in errors)


def panel_elements(panel: Panel, frame: Frame, archives: Sequence[str], published: Sequence[str]) -> list[Element]:
    """Return the elements of a panel; a method has the marker of its place in ``archives`` or ``published``."""
    middle = (frame.left + frame.right) / 2
    elements: list[Element] = [*_grid(frame), *_reference_lines(panel, frame)]
    elements.append(Text((middle, frame.top - 5), panel.title, TITLE_SIZE, "middle"))
    if not panel.points:
        height = (frame.top + frame.bottom) / 2
        elements.append(Text((middle, height), "no errors", LABEL_SIZE, "middle", colour=GREY))
    markers = {name: published_marker(index) for index, name in enumerate(published)}
    for point in panel.points:
        if point.published:
            paths = markers[point.method]
        else:
            paths = archive_marker(archives.index(point.method), len(archives), hollow=point.hollow)
        elements.append(_marker(panel, point, frame, paths))
    return [*elements, *_marks(panel, frame)]


def _marker(panel: Panel, point: FigurePoint, frame: Frame, paths: tuple[Path, ...]) -> Marker:
    role = "published" if point.published else "hollow archive" if point.hollow else "archive"
    source = "paper: " if point.published else ""
    name = f"{source}{point.method} {point.mark}".rstrip()
    description = f"{panel.config}, {name}: native {point.native:.4g}, scaled {point.scaled:.4g}"
    return Marker(frame.at(point.native, point.scaled), role, description, paths)


def _defined(value: float | None) -> list[float]:
    return [] if value is None or not math.isfinite(value) else [value]


def _with_margin(values: Iterable[float]) -> list[float]:
    inside = [min(max(value, LIMITS[0]), LIMITS[1]) for value in values]
    return [min(max(value * factor, LIMITS[0]), LIMITS[1]) for value in inside for factor in _MARGIN_FACTORS]


def _grid(frame: Frame) -> list[Element]:
    left, top, right, bottom = frame.left, frame.top, frame.right, frame.bottom
    columns = {tick: frame.x.at(tick) for tick in frame.x.ticks()}
    rows = {tick: frame.y.at(tick) for tick in frame.y.ticks()}
    widest = max((text_width(tick_label(tick), TICK_SIZE) for tick in columns), default=0)
    return [
        *(Path(((x, top), (x, bottom)), PALE, 0.4) for x in columns.values()),
        *(Path(((left, y), (right, y)), PALE, 0.4) for y in rows.values()),
        Path(((left, top), (right, top), (right, bottom), (left, bottom)), GREY, 0.6, closed=True),
        *(
            Text((columns[tick], bottom + 9.0), tick_label(tick), TICK_SIZE, "middle")
            for tick in _labelled(frame.x, widest + 4)
        ),
        *(
            Text((left - 4.5, rows[tick] + 0.36 * TICK_SIZE), tick_label(tick), TICK_SIZE, "end")
            for tick in _labelled(frame.y, TICK_SIZE + 2)
        ),
        Text(((left + right) / 2, bottom + 18.5), "native AbsRel", LABEL_SIZE, "middle"),
        Text((left - 28.5, (top + bottom) / 2), "scaled AbsRel", LABEL_SIZE, "middle", turned=True),
    ]


def _labelled(axis: LogAxis, distance: float) -> list[float]:
    """Return the ticks whose labels have the given distance, powers of ten before others."""
    return select_spaced(sorted(axis.ticks(), key=lambda tick: (f"{tick:e}"[0] != "1", tick)), axis, distance)


def _reference_lines(panel: Panel, frame: Frame) -> list[Element]:
    lines: list[Element] = []
    low, high = max(frame.x.low, frame.y.low), min(frame.x.high, frame.y.high)
    if low < high:
        lines.append(Path((frame.at(low, low), frame.at(high, high)), GREY, 0.7, dash=DIAGONAL_DASH))
    for title, value in panel.constants.items():
        y = frame.y.at(value)
        description = f"{panel.config}, {title}: scaled {value:.4g}"
        across = Path(((0.0, 0.0), (frame.right - frame.left, 0.0)), INK, 0.9, dash=CONSTANT_DASH)
        lines.append(Marker((frame.left, y), "reference constant", description, (across,)))
    for value in _defined(panel.reference.one_pixel.abs_rel):
        x = frame.x.at(value)
        description = f"{panel.config}, one pixel: native {value:.4g}"
        upwards = Path(((0.0, 0.0), (0.0, frame.top - frame.bottom)), INK, 0.9, dash=ONE_PIXEL_DASH)
        lines.append(Marker((x, frame.bottom), "reference one-pixel", description, (upwards,)))
    return lines


def _marks(panel: Panel, frame: Frame) -> list[Element]:
    """Return the marks of points, each beside its point where the fewest other points and marks are."""
    places = [frame.at(point.native, point.scaled) for point in panel.points]
    taken: list[Point] = list(places)
    marks: list[Element] = []
    for point, (x, y) in zip(panel.points, places, strict=True):
        if ANCHORED_MARK not in point.mark:
            continue
        candidates = [(x + 5.5 * dx, y + 5.5 * dy) for dx, dy in _MARK_DIRECTIONS]
        inside = [
            (cx, cy) for cx, cy in candidates if frame.left < cx < frame.right and frame.top < cy < frame.bottom
        ]
        best = min(inside or candidates, key=lambda place: _neighbours(place, taken))
        taken.append(best)
        marks.append(Text((best[0], best[1] + 0.36 * TICK_SIZE), ANCHORED_MARK, TICK_SIZE, "middle", colour=GREY))
    return marks


def _neighbours(place: Point, taken: Iterable[Point]) -> int:
    return sum(abs(place[0] - x) < 6 and abs(place[1] - y) < 6 for x, y in taken)
