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
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rebar_depth_bench.base.errors import InputError, printable, require_extra
from rebar_depth_bench.base.writing import write_output
from rebar_depth_bench.reporting import published as paper
from rebar_depth_bench.reporting.axes import decade_axis
from rebar_depth_bench.scoring import formatting
from rebar_depth_bench.scoring.columns import NATIVE, ONE_PIXEL, SCALED
from rebar_depth_bench.scoring.protocol import MIN_COMPARABLE_COVERAGE
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.table import Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_METADATA: Mapping[str, Any] = {".svg": {"Date": None}, ".png": {}, ".pdf": {"CreationDate": None}}
"""Formats of figures by suffix, and the metadata that would differ between two runs."""
_DPI = 300
_SHARED_STYLE: Mapping[str, Any] = {
    "pdf.fonttype": 42,  # Publishers refuse Matplotlib's default, Type 3.
    "svg.fonttype": "none",
    "svg.hashsalt": "rebar-depth-bench",
    "text.parse_math": False,  # A dollar sign is part of a name.
}
_STYLE: Mapping[str, Any] = {
    "axes.grid": True,
    "axes.titlesize": "medium",
    "figure.dpi": _DPI,  # Texts are measured as they are drawn.
    "font.size": 7.0,
    "grid.color": "#d9d9d9",
    "legend.columnspacing": 1.0,
    "legend.fontsize": 6.2,
    "legend.frameon": False,
    "legend.handlelength": 1.8,
    **{f"{lines}.linewidth": 0.6 for lines in ("axes", "grid", "lines")},
}
_LIMITS = (1e-3, 1e4)
"""Smallest and largest error of the axes; points beyond are drawn on the frame."""
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#a0488a", "#b07800", "#2f7f9f", "#000000")
"""Colours that people with colour blindness tell apart (after Okabe and Ito), dark enough for print."""
_GREY = "#595959"
_MARKERS = ("o", "s", "^", "D", "v", "*", "<", ">", "P", "X", "d", "p", "h")
_PAPER_MARKERS: tuple[Any, ...] = ("+", "x", (6, 2, 0), "1", "2", "3")


def check_figure(path: Path) -> None:
    """Raise ``InputError`` unless a path ends in the suffix of a format of figures and Matplotlib is installed."""
    if path.suffix.lower() not in _METADATA:
        raise InputError(f"--figure names {path}, expected a name that ends in {', '.join(_METADATA)}")
    require_extra("plot", ["matplotlib"])


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


def write_figure(results: Sequence[Result], path: Path, *, published: bool) -> list[str]:
    """Write the figure of results of one dataset, whose method names differ, and return what is left out of it.

    With ``published``, the paper's points of a config that shows one of its scenes come with it.
    """
    with figure_style(_STYLE):
        write_output(path, figure_bytes(draw_figure(results, published=published), path))
    return [
        f"{printable(result.method)} has no errors of {printable(config)}: left out of --figure"
        for config in dict.fromkeys(config for result in results for config in result.tables)
        for result in results
        if config in result.tables and _errors(result.tables[config]) is None
    ]


def draw_figure(results: Sequence[Result], *, published: bool) -> Figure:
    """Return the figure of ``write_figure``, with a panel per config; call it inside ``figure_style``.

    It is as wide as one column of a paper for one panel, and as two for more.
    """
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    # Markers get smaller, so that earlier points stay visible below later ones.
    styles = [
        {
            "label": f"{printable(result.method)} {formatting.rank_mark(result.declared)}".rstrip(),
            "marker": _MARKERS[index % len(_MARKERS)],
            "color": _COLOURS[index % len(_COLOURS)],
            "markersize": 7 - 2 * index / max(len(results) - 1, 3),
        }
        for index, result in enumerate(results)
    ]
    configs = list(dict.fromkeys(config for result in results for config in result.tables))
    width = 3.5 if len(configs) == 1 else 7.15  # Inches.
    columns = 2 if len(configs) == 4 else min(len(configs), 3)
    rows = math.ceil(len(configs) / columns)
    figure = Figure(figsize=(width, width), layout="constrained")
    notes = ["AbsRel on scored steel pixels, mean over views. Scaled: oracle median scale per view."]
    notes += [formatting.note_text(*note) for note in formatting.row_notes(results, ()) if note[0] != "*"]
    for index, config in enumerate(configs):
        styled = zip(styles, results, strict=True)
        tables = [(style, result.tables[config]) for style, result in styled if config in result.tables]
        notes += _draw_panel(figure.add_subplot(rows, columns, index + 1), config, tables, published=published)

    # The legend has the first marker or line of each name, markers first.
    handles: dict[str, Line2D] = {}
    lines = [line for axes in figure.axes for line in axes.lines]
    for line in sorted(lines, key=lambda line: line.get_marker() == "None"):
        handles.setdefault(str(line.get_label()), line)
    half = round(5 * width)
    names = [name if len(name) <= 2 * half else f"{name[:half]}…{name[1 - half :]}" for name in handles]
    for ncols in (4, 3, 2, 1):
        legend = figure.legend([*handles.values()], names, loc="outside upper left", ncols=ncols)
        if ncols == 1 or legend.get_window_extent().width <= figure.bbox.width:
            break
        legend.remove()
    text = textwrap.fill(" ".join(dict.fromkeys(notes)), round(23 * width))
    note = figure.supxlabel(text, x=0.01, ha="left", color=_GREY, fontsize=6)
    texts = (legend.get_window_extent().height + note.get_window_extent().height) / figure.dpi
    figure.set_size_inches(width, texts + rows * 0.85 * width / columns)
    return figure


def _errors(table: Table) -> tuple[float, float] | None:
    """Return the native and scaled AbsRel, or None if either is undefined (null in the JSON)."""
    native, scaled = (column.cell(table).value for column in (NATIVE[0], SCALED[0]))
    return None if native is None or scaled is None else (native, scaled)


def _draw_panel(
    axes: Axes, config: str, tables: Sequence[tuple[Mapping[str, Any], Table]], *, published: bool
) -> list[str]:
    """Draw the points and reference lines of a config, and return the notes that explain them.

    ``tables`` has the tables of the config with the labels and markers of their methods.
    """
    from matplotlib.ticker import LogLocator, NullFormatter

    first = tables[0][1]
    title = formatting.config_title(printable(config, 40), first.split)
    title += f", {formatting.counted(first.views, 'view')}"
    points: list[tuple[float, float, Mapping[str, Any]]] = []
    notes = []
    for style, table in tables:
        if errors := _errors(table):
            points.append((*errors, style if table.is_comparable else {**style, "markerfacecolor": "#ffffff"}))
    if published and first.published:
        part = paper.load_published().parts["synthetic"]
        notes.append(f"Paper: {part.place}, {part.mark}.")
        if not first.published.same_optics:
            title += f", paper {paper.OTHER_OPTICS_MARK}"
            notes.append(paper.OTHER_OPTICS_NOTE)
        for marker, row in zip(_PAPER_MARKERS, paper.published_rows(first.published.scene), strict=True):
            place = float(row.abs_rel), float(row.abs_rel_scaled)
            points.append((*place, {"label": f"paper: {row.method}", "marker": marker, "color": _GREY}))
            if row.median_anchored:
                notes.append("†: median-anchored.")
                axes.annotate("†", place, (-5.5, 3), textcoords="offset points", color=_GREY)
    if any("markerfacecolor" in style for _, _, style in points):
        percent = f"{MIN_COMPARABLE_COVERAGE * 100:.0f} %"
        notes.append(f"Hollow: coverage below {percent} or a view without prediction; errors over chosen pixels.")
    if not points:
        axes.text(0.5, 0.5, "no errors", color=_GREY, ha="center", va="center", transform=axes.transAxes)
    constants = formatting.scaled_constants([(style["label"], table) for style, table in tables])
    across = [abs_rel for abs_rel, _ in constants.values()]
    up = [error for error in (first[ONE_PIXEL[0].place],) if not math.isnan(error)]
    native = [*(native for native, _, _ in points), *up]
    scaled = [*(scaled for _, scaled, _ in points), *across]
    (low, high), margins = _LIMITS, (0.85, 1.18)
    if not all(low <= error <= high for error in (*native, *scaled)):
        notes.append(f"On the frame: an error below {low:g} or above {high:g}.")

    # The x axis also covers the y axis, so that the diagonal crosses the panel. The ends are 1, 2 or 5 x 10^k.
    y = decade_axis(np.clip(np.outer(scaled, margins), low, high).flat, 0, 1)
    x = decade_axis([y.low, y.high, *np.clip(np.outer(native, margins), low, high).flat], 0, 1)
    axes.set(title=textwrap.fill(title, 36), xlabel="native AbsRel", ylabel="scaled AbsRel")
    axes.set(xscale="log", yscale="log", xlim=(x.low, x.high), ylim=(y.low, y.high))
    for axis, ends, most in ((axes.xaxis, x, 30), (axes.yaxis, y, 100)):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5) if ends.high <= most * ends.low else (1,)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    for native_error, scaled_error, style in points:
        x_y = np.clip([native_error, scaled_error], low, high)
        axes.plot(*x_y, linestyle="", clip_on=False, zorder=3, **style)
    for error in np.clip(across, low, high):
        axes.axhline(error, label=f"reference: {formatting.CONSTANT_TITLE} (for scaled)", color="k", ls="--")
    for error in np.clip(up, low, high):
        axes.axvline(error, label=f"reference: {formatting.ONE_PIXEL_TITLE} (for native)", color="k", ls=":")
    axes.plot([y.low, y.high], [y.low, y.high], label="native = scaled", color=_GREY, linestyle="-.")
    return notes
