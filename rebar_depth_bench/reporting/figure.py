"""Figures for print: native against scaled AbsRel of several submissions, as SVG, PNG or PDF.

Matplotlib draws them with its own defaults, whatever the user's settings, so that one version of it gives the same
bytes for the same results.
"""

from __future__ import annotations

import math
import textwrap
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rebar_depth_bench.base.errors import InputError, printable, require_extra
from rebar_depth_bench.base.writing import write_output
from rebar_depth_bench.reporting.axes import Axis, decade_axis, select_spaced, tick_label
from rebar_depth_bench.reporting.published import (
    OTHER_OPTICS_MARK,
    OTHER_OPTICS_NOTE,
    load_published,
    published_rows,
)
from rebar_depth_bench.scoring.columns import NATIVE, ONE_PIXEL, SCALED
from rebar_depth_bench.scoring.formatting import (
    CONSTANT_TITLE,
    ONE_PIXEL_TITLE,
    config_title,
    counted,
    note_text,
    rank_mark,
    row_notes,
    scaled_constants,
)
from rebar_depth_bench.scoring.protocol import MIN_COMPARABLE_COVERAGE
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.table import Table

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.legend import Legend
    from matplotlib.lines import Line2D

_METADATA: Mapping[str, Mapping[str, None]] = {
    ".svg": {"Date": None},
    ".png": {},
    ".pdf": {"CreationDate": None},
}
"""Formats of figures by suffix, and the metadata that would differ between two runs."""
_DPI = 300
_SHARED_STYLE: Mapping[str, Any] = {
    "pdf.fonttype": 42,  # Publishers refuse Matplotlib's default, Type 3.
    "svg.fonttype": "none",
    "svg.hashsalt": "rebar-depth-bench",
    "text.parse_math": False,  # A dollar sign is part of a name.
}
_GREY = "#595959"
_STYLE: Mapping[str, Any] = {
    "axes.edgecolor": _GREY,
    "axes.grid": True,
    "axes.grid.which": "both",
    "axes.labelsize": 7.0,
    "axes.linewidth": 0.6,
    "axes.titlesize": 7.5,
    "figure.dpi": _DPI,  # Texts are measured as they are drawn.
    "grid.color": "#d9d9d9",
    "grid.linewidth": 0.4,
    "legend.borderaxespad": 0.0,
    "legend.borderpad": 0.0,
    "legend.fontsize": 6.8,
    "legend.frameon": False,
    "xtick.major.pad": 4.5,  # The lowest label of y ends above it.
    **{f"{axis}tick.labelsize": 6.2 for axis in "xy"},
    **{f"{axis}tick.{kind}.size": 0.0 for axis in "xy" for kind in ("major", "minor")},
}
_ONE_COLUMN, _TWO_COLUMNS = 252.0, 516.0
"""Widths of a figure in one and in two columns of a paper, points."""
_LEFT, _RIGHT, _TOP, _BOTTOM = 39.0, 7.0, 14.0, 27.0
"""Space around the frame of a panel for its title and labels, points."""
_MARGIN, _GAP, _MAX_HEIGHT = 3.0, 10.0, 170.0
_NOTE_SIZE = 6.0
_SAMPLE, _MAX_COLUMNS = 20.0, 6
"""Width of the line before a name of the legend, points, and the largest number of its columns."""
_LIMITS = (1e-3, 1e4)
"""Smallest and largest error of the axes; points beyond are drawn on the frame."""
_MARGIN_FACTORS = (0.85, 1.18)
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#a0488a", "#b07800", "#2f7f9f", "#000000")
"""Colours that people with colour blindness tell apart (after Okabe and Ito), dark enough for print."""
_MARKERS: tuple[Any, ...] = ("o", "s", "^", "D", "v", "*", "<", ">", "P", "X", "d", "p")
_MARKER_SIZES = {"D": 0.8, "s": 0.85, "*": 1.3, "x": 0.8}
"""Sizes of markers that look as large as a circle or a plus, relative to it."""
_PUBLISHED_MARKERS: tuple[Any, ...] = ("+", "x", (6, 2, 0), "1", "2", "3")
_CONSTANT: Mapping[str, Any] = {"color": "#000000", "linewidth": 0.9, "linestyle": (0, (5.5, 2.2))}
_ONE_PIXEL: Mapping[str, Any] = {"color": "#000000", "linewidth": 0.9, "linestyle": (0, (1.3, 2.0))}
_DIAGONAL: Mapping[str, Any] = {"color": _GREY, "linewidth": 0.7, "linestyle": (0, (8.5, 2.8, 1.7, 2.8))}


@dataclass(frozen=True)
class FigurePoint:
    """Native and scaled AbsRel of a method.

    ``hollow`` points are those of archives whose errors are not compared with others, since their archives chose
    the pixels that they are over; ``anchored`` ones those of the paper whose scale is from ground truth.
    """

    method: str
    native: float
    scaled: float
    published: bool = False
    hollow: bool = False
    anchored: bool = False


@dataclass(frozen=True)
class Panel:
    """Points of a config, those of the paper first, and AbsRel of its references: constants and one pixel."""

    title: str
    points: tuple[FigurePoint, ...]
    constants: tuple[float, ...]
    one_pixel: tuple[float, ...]


@dataclass(frozen=True)
class FigureContent:
    """Panels by config, the names in the legend, the notes below it, and what is left out for want of numbers."""

    panels: tuple[Panel, ...]
    archives: tuple[str, ...]
    published: tuple[str, ...]
    notes: tuple[str, ...]
    left_out: tuple[str, ...]


def figure_content(results: Sequence[Result], *, published: bool) -> FigureContent:
    """Return what the figure of results of one dataset shows; their method names differ.

    With ``published``, the paper's points of a config that shows one of its scenes come with it.
    """
    configs = dict.fromkeys(name for result in results for name in result.tables)
    panels = [_panel(config, results, published=published) for config in configs]
    points = [point for panel in panels for point in panel.points]
    left_out = [
        f"{printable(result.method)} has no errors of {printable(config)}: left out of --figure"
        for config in configs
        for result in results
        if config in result.tables and _errors(result.tables[config]) is None
    ]
    return FigureContent(
        panels=tuple(panels),
        archives=tuple(dict.fromkeys(_name(result) for result in results)),
        published=tuple(dict.fromkeys(point.method for point in points if point.published)),
        notes=tuple(_notes(results, panels)),
        left_out=tuple(left_out),
    )


def _panel(config: str, results: Sequence[Result], *, published: bool) -> Panel:
    rows = [(_name(result), result.tables[config]) for result in results if config in result.tables]
    first = rows[0][1]
    match = first.published if published else None
    points = [
        FigurePoint(row.method, float(row.abs_rel), float(row.abs_rel_scaled), True, anchored=row.median_anchored)
        for row in (published_rows(match.scene) if match else ())
    ]
    for name, table in rows:
        if errors := _errors(table):
            points.append(FigurePoint(name, *errors, hollow=not table.is_comparable))
    optics = f", paper {OTHER_OPTICS_MARK}" if match and not match.same_optics else ""
    one_pixel = first[ONE_PIXEL[0].place]
    return Panel(
        f"{config_title(printable(config, 40), first.split)}, {counted(first.views, 'view')}{optics}",
        tuple(points),
        tuple(abs_rel for abs_rel, _ in scaled_constants(rows).values()),
        () if math.isnan(one_pixel) else (one_pixel,),
    )


def _errors(table: Table) -> tuple[float, float] | None:
    """Return the native and scaled AbsRel, or None if either is undefined (null in the JSON)."""
    native, scaled = (column.cell(table).value for column in (NATIVE[0], SCALED[0]))
    return None if native is None or scaled is None else (native, scaled)


def _name(result: Result) -> str:
    """Return a method's name with the mark of its declaration, as the tables show it."""
    return f"{printable(result.method)} {rank_mark(result.declared)}".rstrip()


def _notes(results: Sequence[Result], panels: Sequence[Panel]) -> list[str]:
    points = [point for panel in panels for point in panel.points]
    notes = ["AbsRel on scored steel pixels, mean over views. Scaled: oracle median scale per view."]
    if any(point.hollow for point in points):
        percent = f"{MIN_COMPARABLE_COVERAGE * 100:.0f} %"
        notes.append(f"Hollow: coverage below {percent} or a view without prediction; errors over chosen pixels.")
    notes += [note_text(*note) for note in row_notes(results, ()) if note[0] != "*"]
    if any(point.published for point in points):
        part = load_published().parts["synthetic"]
        notes.append(f"Paper: {part.place}, {part.mark}.")
    if any(point.anchored for point in points):
        notes.append("†: median-anchored.")
    if any(OTHER_OPTICS_MARK in panel.title for panel in panels):
        notes.append(OTHER_OPTICS_NOTE)
    if any(map(_is_beyond, panels)):
        notes.append(f"On the frame: an error below {_LIMITS[0]:g} or above {_LIMITS[1]:g}.")
    return notes


def check_figure(path: Path) -> None:
    """Raise ``InputError`` unless a path ends in the suffix of a format of figures and Matplotlib is installed."""
    if path.suffix.lower() not in _METADATA:
        raise InputError(f"--figure names {path}, expected a name that ends in {', '.join(_METADATA)}")
    require_extra("plot", ["matplotlib"])


def write_figure(results: Sequence[Result], path: Path, *, published: bool) -> Sequence[str]:
    """Write the figure of results of one dataset, whose method names differ, and return what is left out of it."""
    content = figure_content(results, published=published)
    with figure_style(_STYLE):
        write_output(path, figure_bytes(figure_of(content), path))
    return content.left_out


@contextmanager
def figure_style(style: Mapping[str, Any] | None = None) -> Iterator[None]:
    """Use Matplotlib's defaults and ``style`` for a while, and warn of no letters that the font lacks."""
    from matplotlib.style import context

    with context({**_SHARED_STYLE, **(style or {})}, after_reset=True), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph", UserWarning)
        yield


def figure_bytes(figure: Figure, path: Path) -> bytes:
    """Return a figure in the format that the suffix of ``path`` states; call it inside ``figure_style``."""
    suffix, out = path.suffix.lower(), BytesIO()
    figure.savefig(out, format=suffix[1:], dpi=_DPI, metadata=_METADATA[suffix])
    return out.getvalue()


def figure_of(content: FigureContent) -> Figure:
    """Return the figure, drawn in ``figure_style``: as wide as one column for one panel, as two for more."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = content.panels
    width = _ONE_COLUMN if len(panels) == 1 else _TWO_COLUMNS
    columns = len(panels) if len(panels) < 4 else 2 if len(panels) == 4 else 3
    panel_width = (width - 2 * _MARGIN - (columns - 1) * _GAP) / columns
    frame = (panel_width - _LEFT - _RIGHT, min(0.82 * (panel_width - _LEFT - _RIGHT), _MAX_HEIGHT))
    figure = Figure(figsize=(width / 72, width / 72))
    FigureCanvasAgg(figure)  # The canvas that measures texts.
    text = textwrap.fill(" ".join(content.notes), round((width - 2 * _MARGIN) / (0.54 * _NOTE_SIZE)))
    note = figure.text(0, 0, text, color=_GREY, fontsize=_NOTE_SIZE, linespacing=1.3, va="bottom")
    legend = _legend(figure, _entries(content), width - 2 * _MARGIN)
    note_height, legend_height = (_extent(artist)[1] for artist in (note, legend))
    row_height = _TOP + frame[1] + _BOTTOM
    height = math.ceil(math.ceil(len(panels) / columns) * row_height + legend_height + note_height + 4 * _MARGIN)
    figure.set_size_inches(width / 72, height / 72)
    note.set_position((_MARGIN / width, _MARGIN / height))
    legend.set_bbox_to_anchor((_MARGIN / width, (2 * _MARGIN + note_height) / height))
    for index, panel in enumerate(panels):
        row, column = divmod(index, columns)
        left = _MARGIN + column * (panel_width + _GAP) + _LEFT
        bottom = height - _MARGIN - row * row_height - _TOP - frame[1]
        axes = figure.add_axes((left / width, bottom / height, frame[0] / width, frame[1] / height))
        _draw_panel(axes, panel, frame, content)
    return figure


def _extent(artist: Artist) -> tuple[float, float]:
    """Return the width and height of a text or legend in points."""
    extent = artist.get_window_extent()
    return extent.width * 72 / _DPI, extent.height * 72 / _DPI


def _entries(content: FigureContent) -> list[tuple[str, tuple[Line2D, ...]]]:
    """Return the names of the legend with their markers or lines."""
    from matplotlib.lines import Line2D

    entries = [(name, _marker(content, name)) for name in content.archives]
    entries += [(f"paper: {name}", _marker(content, name, published=True)) for name in content.published]
    if any(panel.constants for panel in content.panels):
        entries.append((f"reference: {CONSTANT_TITLE} (for scaled)", (Line2D([], [], **_CONSTANT),)))
    if any(panel.one_pixel for panel in content.panels):
        entries.append((f"reference: {ONE_PIXEL_TITLE} (for native)", (Line2D([], [], **_ONE_PIXEL),)))
    return [*entries, ("native = scaled", (Line2D([], [], **_DIAGONAL),))]


def _legend(figure: Figure, entries: Sequence[tuple[str, tuple[Line2D, ...]]], width: float) -> Legend:
    """Add the legend in as many columns as fit into ``width`` points, and return it."""
    names = [_shortened(figure, name, width - _SAMPLE) for name, _ in entries]
    lines: list[Any] = [lines for _, lines in entries]
    for columns in range(min(len(entries), _MAX_COLUMNS), 1, -1):
        legend = figure.legend(lines, names, loc="lower left", ncols=columns)
        if _extent(legend)[0] <= width:
            return legend
        legend.remove()
    return figure.legend(lines, names, loc="lower left")


def _shortened(figure: Figure, name: str, width: float) -> str:
    """Return a name that fits into ``width`` points, with an ellipsis in its middle: names differ at the end."""
    text = figure.text(0, 0, name, fontsize=_STYLE["legend.fontsize"])
    for kept in range(len(name) - 1, 0, -1):
        if _extent(text)[0] <= width:
            break
        text.set_text(f"{name[: (kept + 1) // 2]}…{name[len(name) - kept // 2 :]}")
    text.remove()
    return text.get_text()


def _marker(
    content: FigureContent, method: str, *, published: bool = False, hollow: bool = False
) -> tuple[Line2D, ...]:
    """Return the marker of a method, which differs from others without its colour: strokes, or a filled shape.

    Shapes repeat with a dot inside. Later markers, which are drawn over earlier ones, are smaller, so that equal
    points show all of theirs.
    """
    from matplotlib.lines import Line2D

    style: dict[str, Any] = {"label": method, "linestyle": "", "clip_on": False, "zorder": 3}
    if published:
        shape = _PUBLISHED_MARKERS[content.published.index(method) % len(_PUBLISHED_MARKERS)]
        size = 6.4 * _MARKER_SIZES.get(shape, 1.0)
        return (Line2D([], [], marker=shape, markersize=size, color=_GREY, markeredgewidth=0.9, **style),)
    index = content.archives.index(method)
    shape, colour = _MARKERS[index % len(_MARKERS)], _COLOURS[index % len(_COLOURS)]
    size = 7.2 * (1.15 - 0.3 * index / max(len(content.archives) - 1, 3)) * _MARKER_SIZES.get(shape, 1.0)
    face, edge, width = ("#ffffff", colour, 1.1) if hollow else (colour, "#ffffff", 0.5)
    style |= {"markeredgecolor": edge}
    outline = Line2D([], [], marker=shape, markersize=size, color=face, markeredgewidth=width, **style)
    dot = Line2D([], [], marker="o", markersize=0.35 * size, color=edge, markeredgewidth=0.0, **style)
    return (outline, dot) if index // len(_MARKERS) % 2 else (outline,)


def _draw_panel(axes: Axes, panel: Panel, frame: tuple[float, float], content: FigureContent) -> None:
    """Draw grid, diagonal, references and points of a panel into a frame of (width, height) in points."""
    x, y = _scales(panel, *frame)
    axes.set(xscale="log", yscale="log", xlim=(x.low, x.high), ylim=(y.low, y.high))
    axes.set(title=panel.title, xlabel="native AbsRel", ylabel="scaled AbsRel")
    for axis, scale, distance in ((axes.xaxis, x, 23.0), (axes.yaxis, y, 8.5)):
        ticks = scale.ticks()
        powers_first = sorted(ticks, key=lambda tick: (f"{tick:e}"[0] != "1", tick))
        labelled = select_spaced(powers_first, scale, distance)
        axis.set_ticks(labelled, [*map(tick_label, labelled)])
        axis.set_ticks(ticks, [""] * len(ticks), minor=True)
    ends = max(x.low, y.low), min(x.high, y.high)
    axes.plot(ends, ends, **_DIAGONAL)
    for value in panel.constants:
        axes.axhline(_within(value, y), **_CONSTANT)
    for value in panel.one_pixel:
        axes.axvline(_within(value, x), **_ONE_PIXEL)
    if not panel.points:
        axes.text(0.5, 0.5, "no errors", color=_GREY, ha="center", va="center", transform=axes.transAxes)
    for point in panel.points:
        place = _within(point.native, x), _within(point.scaled, y)
        for line in _marker(content, point.method, published=point.published, hollow=point.hollow):
            line.set_data([place[0]], [place[1]])
            axes.add_line(line)
        if point.anchored:  # Its neighbours are on the other side.
            axes.annotate("†", place, (-5.5, 3), textcoords="offset points", color=_GREY, fontsize=6.2)


def _scales(panel: Panel, width: float, height: float) -> tuple[Axis, Axis]:
    """Return the axes of native and scaled errors, which hold the points and references of a panel.

    The x axis also covers the y axis, so that the diagonal crosses the panel.
    """
    scaled = _with_margin([*(point.scaled for point in panel.points), *panel.constants])
    native = _with_margin([*(point.native for point in panel.points), *panel.one_pixel])
    y = decade_axis(scaled, 0, height)
    return decade_axis([*native, *((y.low, y.high) if scaled else ())], 0, width), y


def _with_margin(values: Sequence[float]) -> list[float]:
    low, high = _LIMITS
    inside = [min(max(value, low), high) for value in values]
    return [min(max(value * factor, low), high) for value in inside for factor in _MARGIN_FACTORS]


def _within(value: float, scale: Axis) -> float:
    return min(max(value, scale.low), scale.high)


def _is_beyond(panel: Panel) -> bool:
    """Return whether anything is drawn on the frame of a panel because the axes do not reach it."""
    errors = [error for point in panel.points for error in (point.native, point.scaled)]
    return not all(_LIMITS[0] <= error <= _LIMITS[1] for error in (*errors, *panel.constants, *panel.one_pixel))
