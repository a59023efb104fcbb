"""Page of the figure: panels in rows, the legend below them, and the notes below that."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rebar_depth_bench.reporting.figure.content import FigureContent
from rebar_depth_bench.reporting.figure.drawing import (
    GREY,
    INK,
    Drawing,
    Element,
    Marker,
    Path,
    Text,
    shortened,
    text_width,
    wrapped,
)
from rebar_depth_bench.reporting.figure.markers import archive_marker, published_marker
from rebar_depth_bench.reporting.figure.panel import (
    BOTTOM,
    CONSTANT_DASH,
    DIAGONAL_DASH,
    LEFT,
    LIMITS,
    ONE_PIXEL_DASH,
    RIGHT,
    TOP,
    Frame,
    frame_of,
    is_beyond,
    panel_elements,
)
from rebar_depth_bench.reporting.formatting import CONSTANT_TITLE, ONE_PIXEL_TITLE

ONE_COLUMN, TWO_COLUMNS = 252.0, 516.0
"""Widths of a figure in one and in two columns of a paper, points."""

_MARGIN, _GAP = 3.0, 10.0
_LEGEND_SIZE, _LEGEND_ROW, _SAMPLE = 6.8, 10.0, 18.0
_NOTE_SIZE, _NOTE_ROW = 6.0, 8.0
_MAX_HEIGHT = 170.0
_BEYOND_NOTE = f"On the frame: an error below {LIMITS[0]:g} or above {LIMITS[1]:g}."

_Entry = tuple[str, tuple[Path, ...]]


def figure_drawing(content: FigureContent) -> Drawing:
    """Return the drawing of the figure, at the width of one column for one panel and of two for more."""
    panels = content.panels
    width = ONE_COLUMN if len(panels) == 1 else TWO_COLUMNS
    columns = len(panels) if len(panels) < 4 else 2 if len(panels) == 4 else 3
    frames, bottom = _frames(content, width, columns)
    elements: list[Element] = []
    for panel, frame in zip(panels, frames, strict=True):
        elements += panel_elements(panel, frame, content.archives, content.published)
    legend, bottom = _legend(_entries(content), bottom + 4, width)
    beyond = [_BEYOND_NOTE] if any(map(is_beyond, panels)) else []
    notes, bottom = _notes([*content.notes, *beyond], bottom + 3, width)
    described = "; ".join(element.description for element in elements if isinstance(element, Marker))
    return Drawing(
        width=width,
        height=math.ceil(bottom + _MARGIN),
        title="Native and scaled AbsRel",
        description=f"{described}.",
        elements=(*elements, *legend, *notes),
    )


def _frames(content: FigureContent, width: float, columns: int) -> tuple[list[Frame], float]:
    """Return the frame of each panel, and the lower end of the panels."""
    panel_width = (width - 2 * _MARGIN - (columns - 1) * _GAP) / columns
    height = min(0.82 * (panel_width - LEFT - RIGHT), _MAX_HEIGHT)
    frames = []
    for index, panel in enumerate(content.panels):
        row, column = divmod(index, columns)
        left = _MARGIN + column * (panel_width + _GAP) + LEFT
        top = _MARGIN + row * (TOP + height + BOTTOM) + TOP
        frames.append(frame_of(panel, left, top, left + panel_width - LEFT - RIGHT, top + height))
    return frames, max((frame.bottom for frame in frames), default=_MARGIN) + BOTTOM


def _entries(content: FigureContent) -> list[_Entry]:
    """Return the names of the legend with a sample of each, in the middle of a box of ``_SAMPLE`` width."""
    count = len(content.archives)
    entries: list[_Entry] = [
        (name, archive_marker(index, count, hollow=False)) for index, name in enumerate(content.archives)
    ]
    entries += [(f"paper: {name}", published_marker(index)) for index, name in enumerate(content.published)]
    half = _SAMPLE / 2 - 2
    flat, upright = ((-half, 0.0), (half, 0.0)), ((0.0, -4.5), (0.0, 4.5))
    if any(panel.constants for panel in content.panels):
        sample = Path(flat, INK, 0.9, dash=CONSTANT_DASH)
        entries.append((f"reference: {CONSTANT_TITLE} (for scaled)", (sample,)))
    if any(panel.reference.one_pixel.abs_rel is not None for panel in content.panels):
        sample = Path(upright, INK, 0.9, dash=ONE_PIXEL_DASH)
        entries.append((f"reference: {ONE_PIXEL_TITLE} (for native)", (sample,)))
    entries.append(("native = scaled", (Path(flat, GREY, 0.7, dash=DIAGONAL_DASH),)))
    return entries


def _legend(entries: Sequence[_Entry], top: float, width: float) -> tuple[list[Element], float]:
    """Return the legend, read downwards in columns, and its lower end."""
    usable = width - 2 * _MARGIN
    columns = next(
        (found for rows in range(1, len(entries)) if (found := _columns(entries, rows, usable))), [entries]
    )
    elements: list[Element] = []
    left = _MARGIN
    for column in columns:
        for row, (name, sample) in enumerate(column):
            middle = top + (row + 0.5) * _LEGEND_ROW
            short = shortened(name, _LEGEND_SIZE, usable - _SAMPLE)
            elements.append(Marker((left + _SAMPLE / 2, middle), "legend", name, sample))
            elements.append(Text((left + _SAMPLE + 1, middle + 0.36 * _LEGEND_SIZE), short, _LEGEND_SIZE))
        left += _column_width(column)
    return elements, top + len(columns[0]) * _LEGEND_ROW


def _columns(entries: Sequence[_Entry], rows: int, width: float) -> list[Sequence[_Entry]]:
    """Return the entries in columns of ``rows``; empty if they are wider than ``width``."""
    columns = [entries[start : start + rows] for start in range(0, len(entries), rows)]
    return columns if sum(map(_column_width, columns)) <= width + _GAP else []


def _column_width(column: Sequence[_Entry]) -> float:
    return max(text_width(name, _LEGEND_SIZE) for name, _ in column) + _SAMPLE + _GAP


def _notes(notes: Sequence[str], top: float, width: float) -> tuple[list[Element], float]:
    lines = wrapped(" ".join(notes), _NOTE_SIZE, width - 2 * _MARGIN)
    elements: list[Element] = [
        Text((_MARGIN, top + (index + 0.8) * _NOTE_ROW), line, _NOTE_SIZE, colour=GREY)
        for index, line in enumerate(lines)
    ]
    return elements, top + len(lines) * _NOTE_ROW
