"""Writing of the figure as SVG or PNG, by the suffix of its file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from rebar_depth_bench.errors import InputError
from rebar_depth_bench.outputs import write_output
from rebar_depth_bench.reporting.figure.content import figure_content
from rebar_depth_bench.reporting.figure.drawing import Drawing
from rebar_depth_bench.reporting.figure.page import figure_drawing
from rebar_depth_bench.reporting.figure.png import png_bytes
from rebar_depth_bench.reporting.figure.svg import svg_bytes
from rebar_depth_bench.scoring.result import Result

_FORMATS: Mapping[str, Callable[[Drawing], bytes]] = {".svg": svg_bytes, ".png": png_bytes}


def check_figure_path(path: Path) -> None:
    """Raise ``InputError`` unless the suffix of a path is that of a format of figures."""
    if path.suffix.lower() not in _FORMATS:
        raise InputError(f"--figure names {path}, expected a name that ends in {' or '.join(_FORMATS)}")


def write_figure(results: Sequence[Result], path: Path, *, published: bool) -> Sequence[str]:
    """Write the figure of results of one dataset, whose method names differ, and return what is left out of it."""
    content = figure_content(results, published=published)
    write_output(path, _FORMATS[path.suffix.lower()](figure_drawing(content)))
    return content.left_out
