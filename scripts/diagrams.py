"""Diagrams of the architecture as SVG (the packages with their imports, the flow of data), and badges of README.

python -m scripts.diagrams docs/pictures

The layers of the packages are read from the import contracts in pyproject.toml, so that the diagram shows what
import-linter enforces, and the badges from its metadata: no other server is asked for an image.
"""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

BENCH = "rebar_depth_bench"
PROJECT = Path(__file__).parents[1] / "pyproject.toml"
PACKAGE_EDGES: Mapping[tuple[str, str], str] = {
    ("dataset_builder", "cards"): "M280 100 V150",
    ("dataset_builder", BENCH): "M95 100 V276",
    ("cards", BENCH): "M280 212 V276",
    ("leaderboard", BENCH): "M655 100 V276",
}
"""Path of the arrow from each package of the project to each that it imports."""

_INK, _MUTED, _LINE = "#1f2933", "#52606d", "#7b8794"
_FILL = {"plain": "#ffffff", "bench": "#e4edf9", "builder": "#fbeedd", "board": "#e6f4ea", "file": "#f0f2f5"}
_STYLE = f"""\
text {{ font: 14px "DejaVu Sans", "Helvetica Neue", Arial, sans-serif; fill: {_INK}; text-anchor: middle; }}
.title {{ font-weight: bold; }} .small {{ font-size: 12px; fill: {_MUTED}; }} .start {{ text-anchor: start; }}
.edge {{ marker-end: url(#arrow); }} .edge, .line {{ stroke: {_LINE}; stroke-width: 1.6; fill: none; }}"""
_HEAD = (
    '<svg xmlns="http://www.w3.org/2000/svg" width="{0}" height="{1}" viewBox="0 0 {0} {1}" role="img" '
    'aria-labelledby="title">\n<title id="title">{2}</title>\n<style>{3}</style>\n<defs><marker id="arrow" '
    'viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto-start-reverse">'
    '<path d="M0 0L8 4L0 8z" fill="{4}"/></marker></defs>\n<rect width="{0}" height="{1}" rx="8" fill="#ffffff"/>'
)


@dataclass(frozen=True)
class Box:
    """Rectangle with a title and lines of small text; ``x`` and ``y`` are its upper left corner, pixels."""

    x: int
    y: int
    width: int
    height: int
    title: str
    lines: Sequence[str] = ()
    fill: str = "plain"

    @property
    def svg(self) -> str:
        """Elements of the box, with its text in the middle."""
        middle, step = self.x + self.width / 2, 17
        top = self.y + self.height / 2 + 5 - step * len(self.lines) / 2
        shape = (
            f'<rect x="{self.x}" y="{self.y}" width="{self.width}" height="{self.height}" rx="6" '
            f'fill="{_FILL[self.fill]}" stroke="{_LINE}"/>'
        )
        title = _text(middle, top, self.title, "title")
        return "\n".join(
            [shape, title, *(_text(middle, top + step * n, line, "small") for n, line in enumerate(self.lines, 1))]
        )


def packages_svg(layers: Sequence[str]) -> str:
    """Return the diagram of the packages; ``layers`` are those of the bench, highest first."""
    width, top, row = 860, 276, 26
    height = top + 46 + row * len(layers) + 16
    boxes = [
        Box(40, 24, 370, 76, "dataset_builder", ["specs, geometry, Blender, shards, audit"], "builder"),
        Box(150, 150, 260, 62, "cards", ["dataset card, benchmark card"], "file"),
        Box(490, 24, 330, 76, "leaderboard", ["uploads, queue, workers, API, pages"], "board"),
    ]
    elements = [
        *(box.svg for box in boxes),
        f'<rect x="40" y="{top}" width="780" height="{height - top - 20}" rx="6" fill="{_FILL["bench"]}" '
        f'stroke="{_LINE}"/>',
        _text(430, top + 26, f"{BENCH}: each layer may import those below it", "title"),
        *(_text(430, top + 52 + row * n, layer, "small") for n, layer in enumerate(layers)),
        *map(_path, PACKAGE_EDGES.values()),
        _text(668, 190, "imports", "small start"),
    ]
    return _document(width, height, "Packages and the direction of their imports", elements)


def flow_svg() -> str:
    """Return the diagram of the flow of data from scene files to tables and pages."""
    boxes = [
        Box(20, 30, 150, 66, "scene", ["config, TOML,", "IFC, mesh"], "file"),
        Box(215, 30, 150, 66, "assembly", ["bars, one mesh", "for each"], "builder"),
        Box(410, 30, 170, 66, "Blender scene", ["environment,", "cameras, variants"], "builder"),
        Box(640, 10, 180, 46, "colour", ["Cycles"], "builder"),
        Box(640, 72, 180, 62, "depth, mask, ids", ["rays against the meshes,", "Embree and float64"], "builder"),
        Box(20, 180, 150, 66, "other data", ["measured depth,", "layout file"], "file"),
        Box(410, 180, 270, 66, "dataset folder", ["shards, bars, crossings, meshes,", "manifest, card"], "file"),
        Box(725, 180, 95, 66, "export", ["EXR,", "COLMAP"], "builder"),
        Box(215, 180, 150, 66, "import", ["rebar-build import"], "builder"),
        Box(640, 300, 180, 56, "load", ["NumPy rows, torch batches"], "bench"),
        Box(410, 300, 170, 56, "predict", ["method"], "bench"),
        Box(215, 300, 150, 56, "archive", ["one map per view"], "file"),
        Box(20, 300, 150, 56, "score", ["protocol, extended"], "bench"),
        Box(20, 420, 150, 56, "result", ["tables, views, JSON"], "file"),
        Box(215, 420, 150, 56, "compare", ["two or more"], "bench"),
        Box(410, 420, 170, 56, "report, tables", ["HTML, CSV, LaTeX"], "bench"),
        Box(640, 420, 180, 56, "leaderboard", ["ranking, pages, API"], "board"),
    ]
    edges = [
        _path("M170 63 H215"),
        _path("M365 63 H410"),
        _path("M580 53 L640 36"),
        _path("M580 73 L640 98"),
        _path("M660 134 V180"),
        _path("M820 33 H838 V157 H660", "line"),
        _path("M680 213 H725"),
        _path("M170 213 H215"),
        _path("M365 213 H410"),
        _path("M660 246 V300"),
        _path("M640 328 H580"),
        _path("M410 328 H365"),
        _path("M215 328 H170"),
        _path("M495 246 V272 H95 V300"),
        _text(300, 266, "ground-truth cache: scored pixels and their depth", "small"),
        _path("M95 356 V420"),
        _path("M170 448 H215"),
        _path("M95 476 V502 H495 V476"),
        _path("M95 476 V502 H730 V476"),
    ]
    return _document(860, 520, "Flow of data", [*(box.svg for box in boxes), *edges])


def badge_svg(name: str, value: str) -> str:
    """Return a badge: a name on dark grey, and its value on blue."""
    left, width = 20 + 7 * len(name), 40 + 7 * (len(name) + len(value))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="20" viewBox="0 0 {width} 20" role="img" '
        f'aria-label="{escape(name)}: {escape(value)}">\n<style>text {{ font: 12px "DejaVu Sans", Verdana, '
        f'sans-serif; fill: #ffffff; text-anchor: middle; }}</style>\n<rect width="{width}" height="20" rx="4" '
        f'fill="#4b5563"/>\n<path d="M{left} 0H{width - 4}a4 4 0 0 1 4 4V16a4 4 0 0 1 -4 4H{left}z" '
        f'fill="#1d5fa8"/>\n<text x="{left / 2:g}" y="14">{escape(name)}</text>\n'
        f'<text x="{(left + width) / 2:g}" y="14">{escape(value)}</text>\n</svg>\n'
    )


def bench_layers() -> list[str]:
    """Return the layers of the bench as the import contracts state them, highest first."""
    contracts = tomllib.loads(PROJECT.read_text())["tool"]["importlinter"]["contracts"]
    [layers] = [contract["layers"] for contract in contracts if contract["name"] == "Layers of the bench"]
    return [" · ".join(name.removeprefix(f"{BENCH}.") for name in layer.split(" | ")) for layer in layers]


def _path(commands: str, style: str = "edge") -> str:
    return f'<path class="{style}" d="{commands}"/>'


def _text(x: float, y: float, text: str, style: str) -> str:
    return f'<text x="{x:g}" y="{y:g}" class="{style}">{escape(text)}</text>'


def _document(width: int, height: int, title: str, elements: Sequence[str]) -> str:
    head = _HEAD.format(width, height, escape(title), _STYLE, _LINE)
    return "\n".join([head, *elements, "</svg>"]) + "\n"


def diagrams() -> dict[str, str]:
    """Return the text of each file by its name."""
    project = tomllib.loads(PROJECT.read_text())["project"]
    return {
        "packages.svg": packages_svg(bench_layers()),
        "data-flow.svg": flow_svg(),
        "licence.svg": badge_svg("licence", project["license"]),
        "python.svg": badge_svg("python", project["requires-python"].replace(">=", "≥ ")),
    }


def main(folder: str) -> None:
    """Write the diagrams to a folder."""
    for name, svg in diagrams().items():
        (Path(folder) / name).write_text(svg)


if __name__ == "__main__":
    main(*sys.argv[1:])
