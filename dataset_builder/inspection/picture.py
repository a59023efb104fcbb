"""Picture of a cage from four sides, drawn without Blender: front, right, top and a corner."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from PIL import Image, ImageDraw, ImageFont

from dataset_builder.inspection.summary import Inspection, diameter_mm
from dataset_builder.scene.assemblies.cage import CageBar
from rebar_depth_bench.base.errors import printable
from rebar_depth_bench.scoring.formatting import counted

FONT_FILE = "DejaVuSans-subset.ttf"
"""Font of the pictures, which comes with the package: the same text width on every machine."""

_PANEL_PX, _MARGIN_PX, _HEAD_PX = (960, 640), 40, 90
_WIDTH_PX, _LEGEND_PX = 2 * _PANEL_PX[0], 2 * _PANEL_PX[1] + _HEAD_PX
"""Width of a picture, and the upper end of the legend below its panels."""
_OVERSAMPLING = 2
"""Pixels per pixel of the picture, along each side, that are drawn and averaged."""

_PAPER, _INK, _GREY, _MARK = (255, 255, 255), (20, 20, 20), (110, 110, 110), (214, 0, 60)
_COLOURS = ((0, 90, 160), (213, 94, 0), (0, 135, 100), (130, 70, 150), (170, 120, 0), (60, 60, 60), (0, 150, 190))
"""Colours of diameters, the largest first; repeated for further ones."""
_UNKNOWN = (150, 150, 150)
_HAZE = 0.6
"""Share of white in the colour of the farthest bars."""

_Colours = dict[float | None, tuple[int, int, int]]
"""Colour of each diameter in millimetres; None is an unknown diameter."""

_MAX_MARKS = 200
_MAX_PIECES = 50_000
"""Largest number of pieces of bars that are drawn in the order of their own depths."""
_MAX_EDGES = 20_000
"""Largest number of edges that are drawn of the mesh of a bar without axis."""


@dataclass(frozen=True)
class _Side:
    """Side of a cage: title, and the directions to the right and towards the viewer."""

    title: str
    right: tuple[float, float, float]
    towards: tuple[float, float, float]

    @property
    def axes(self) -> Float64[ndarray, "3 3"]:
        """Unit vectors to the right, up and towards the viewer, as rows."""
        rows = np.array([self.right, np.cross(self.towards, self.right), self.towards], dtype=np.float64)
        return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True))


_SIDES = (
    _Side("front: x to the right, z up", (1, 0, 0), (0, -1, 0)),
    _Side("right: y to the right, z up", (0, 1, 0), (1, 0, 0)),
    _Side("top: x to the right, y up", (1, 0, 0), (0, 0, 1)),
    _Side("corner: from the front, the right and above", (1.2, 0.9, 0.0), (0.9, -1.2, 0.8)),
)


@dataclass(frozen=True, eq=False)
class _Stroke:
    """Line to draw: points (world, metres), diameter (0 for an edge of a mesh) and colour.

    ``tips`` are its first and last point (0, -1) that are ends of a bar, where its outline is round.
    """

    points_m: Float64[ndarray, "n 3"]
    diameter_m: float
    colour: tuple[int, int, int]
    tips: tuple[int, ...] = ()


def inspection_picture(inspection: Inspection) -> bytes:
    """Return a PNG of a cage from four sides, with its diameters, sizes, and marks where bars clash."""
    colours = _colours(inspection.cage.bars)
    strokes = _strokes(inspection.cage.bars, colours)
    picture = Image.new("RGB", (_WIDTH_PX, _LEGEND_PX + _HEAD_PX), _PAPER)
    for number, side in enumerate(_SIDES):
        place = (number % 2 * _PANEL_PX[0], number // 2 * _PANEL_PX[1] + _HEAD_PX)
        picture.paste(_panel(inspection, strokes, side), place)
    _write_head(ImageDraw.Draw(picture), inspection)
    _write_legend(ImageDraw.Draw(picture), colours, inspection)
    stream = io.BytesIO()
    picture.save(stream, "png")
    return stream.getvalue()


def corner_view(inspection: Inspection) -> Image.Image:
    """Return a picture of a cage from the front, the right and above."""
    bars = inspection.cage.bars
    return _panel(inspection, _strokes(bars, _colours(bars)), _SIDES[-1])


def _colours(bars: Sequence[CageBar]) -> _Colours:
    """Return the colours of the diameters of bars, the largest first."""
    found = {diameter_mm(bar) for bar in bars}
    known = sorted((diameter for diameter in found if diameter is not None), reverse=True)
    colours: _Colours = {diameter: _COLOURS[number % len(_COLOURS)] for number, diameter in enumerate(known)}
    return colours | ({None: _UNKNOWN} if None in found else {})


def _strokes(bars: Sequence[CageBar], colours: _Colours) -> list[_Stroke]:
    """Return the straight pieces of all bars, or whole bars if there are more than ``_MAX_PIECES`` pieces."""
    whole = sum(len(bar.bar.axis_m) for bar in bars) > _MAX_PIECES
    strokes = []
    for bar in bars:
        colour = colours[diameter_mm(bar)]
        if not bar.bar.has_axis:
            strokes += [_Stroke(edge_m, 0.0, colour) for edge_m in _mesh_edges(bar)]
            continue
        axis_m = np.array(bar.bar.axis_m)
        lines = [axis_m] if whole else np.stack([axis_m[:-1], axis_m[1:]], axis=1)
        for number, line_m in enumerate(lines):
            tips = (*((0,) if number == 0 else ()), *((-1,) if number == len(lines) - 1 else ()))
            strokes.append(_Stroke(line_m, bar.bar.diameter_m, colour, tips))
    return strokes


def _mesh_edges(bar: CageBar) -> Float64[ndarray, "n 2 3"]:
    assert bar.mesh is not None  # A bar without axis has a mesh.
    sides = np.concatenate([bar.mesh.faces[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    edges = np.unique(np.sort(sides), axis=0)
    return np.asarray(bar.mesh.vertices_m[edges[:: max(1, len(edges) // _MAX_EDGES)]])


@dataclass(frozen=True, eq=False)
class _Projection:
    """Orthographic projection of the world onto a panel, in pixels of the oversampled panel."""

    axes: Float64[ndarray, "3 3"]
    px_per_m: float
    middle_m: Float64[ndarray, " 2"]

    @classmethod
    def fitting(cls, axes: Float64[ndarray, "3 3"], box_m: Float64[ndarray, "2 3"]) -> _Projection:
        corners_m = (
            np.array([[x, y, z] for x in box_m[:, 0] for y in box_m[:, 1] for z in box_m[:, 2]]) @ axes[:2].T
        )
        lower_m, upper_m = corners_m.min(axis=0), corners_m.max(axis=0)
        space_px = np.array([_PANEL_PX[0] - 2 * _MARGIN_PX, _PANEL_PX[1] - 4 * _MARGIN_PX])
        scale = float((space_px / np.maximum(upper_m - lower_m, 1e-6)).min())
        return cls(axes, scale * _OVERSAMPLING, (lower_m + upper_m) / 2)

    def pixels(self, points_m: Float64[ndarray, "n 3"]) -> Float64[ndarray, "n 2"]:
        """Return the places of points in the panel."""
        right, up = (points_m @ self.axes[:2].T - self.middle_m).T * self.px_per_m
        width, height = (side * _OVERSAMPLING for side in _PANEL_PX)
        return np.stack([width / 2 + right, height / 2 - up], axis=-1)


def _panel(inspection: Inspection, strokes: Sequence[_Stroke], side: _Side) -> Image.Image:
    large = Image.new("RGB", (_PANEL_PX[0] * _OVERSAMPLING, _PANEL_PX[1] * _OVERSAMPLING), _PAPER)
    projection = _Projection.fitting(side.axes, inspection.box_m)
    draw = ImageDraw.Draw(large)
    _draw_strokes(draw, strokes, projection)
    for clash in (inspection.clashes or ())[:_MAX_MARKS]:
        ((x, y),) = projection.pixels(np.array([clash.point_m])).tolist()
        draw.ellipse((x - 9, y - 9, x + 9, y + 9), outline=_MARK, width=3)
    panel = large.resize(_PANEL_PX, Image.Resampling.BOX)
    draw = ImageDraw.Draw(panel)
    draw.text((_MARGIN_PX, 10), side.title, _INK, font(20))
    _draw_scale_bar(draw, projection.px_per_m / _OVERSAMPLING)
    return panel


def _draw_strokes(draw: ImageDraw.ImageDraw, strokes: Sequence[_Stroke], projection: _Projection) -> None:
    """Draw strokes from back to front, each with a dark outline where it is wide enough, paler in the distance."""
    nearness_m = np.array([stroke.points_m.mean(axis=0) for stroke in strokes]) @ projection.axes[2]
    haze = _HAZE * (nearness_m.max() - nearness_m) / (float(np.ptp(nearness_m)) or 1.0)
    for index in np.argsort(nearness_m, kind="stable").tolist():
        stroke = strokes[index]
        places = projection.pixels(stroke.points_m)
        colour = np.array(stroke.colour) + haze[index] * (255 - np.array(stroke.colour))
        width = round(max(stroke.diameter_m * projection.px_per_m, _OVERSAMPLING))
        if width >= 4 * _OVERSAMPLING:
            # Round outlines at the joints of a bend would cover the pieces beside them.
            _draw_rod(draw, places, places[list(stroke.tips)], width, 0.55 * colour)
            width -= 2 * _OVERSAMPLING
        _draw_rod(draw, places, places, width, colour)


def _draw_rod(
    draw: ImageDraw.ImageDraw,
    places: Float64[ndarray, "n 2"],
    discs: Float64[ndarray, "m 2"],
    width: int,
    colour: Float64[ndarray, " 3"],
) -> None:
    """Draw a line through ``places``, with discs that round its ends and join the pieces of a bend."""
    red, green, blue = colour.round().astype(int).tolist()
    draw.line(places.ravel().tolist(), fill=(red, green, blue), width=width)
    if width > 2 * _OVERSAMPLING:
        radius = (width - 1) / 2
        for x, y in discs.tolist():
            draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=(red, green, blue))


def _draw_scale_bar(draw: ImageDraw.ImageDraw, px_per_m: float) -> None:
    """Draw a bar of 1, 2 or 5 times a power of ten metres, up to a quarter of the panel."""
    longest_m = _PANEL_PX[0] / 4 / px_per_m
    power = 10.0 ** np.floor(np.log10(longest_m))
    length_m = max((step * power for step in (1, 2, 5) if step * power <= longest_m), default=power)
    x, y = _MARGIN_PX, _PANEL_PX[1] - 30
    end = x + length_m * px_per_m
    draw.line((x, y, end, y), _INK, 3)
    for tick in (x, end):
        draw.line((tick, y - 6, tick, y + 6), _INK, 2)
    text = f"{length_m:g} m" if length_m >= 1 else f"{length_m * 1000:g} mm"
    draw.text((end + 10, y - 11), text, _INK, font(18))


def _write_head(draw: ImageDraw.ImageDraw, inspection: Inspection) -> None:
    name = shortened(printable(inspection.name), 30, _WIDTH_PX - 2 * _MARGIN_PX)
    draw.text((_MARGIN_PX, 14), name, _INK, font(30))
    bars = counted(len(inspection.cage.bars), "bar")
    words = [f"{bars}, {inspection.size_text} (x, y, z)"]
    if inspection.clashes:
        words.append(f"red circles: {counted(len(inspection.clashes), 'pair')} of bars clash")
    draw.text((_MARGIN_PX, 54), "; ".join(words), _GREY, font(20))


def _write_legend(draw: ImageDraw.ImageDraw, colours: _Colours, inspection: Inspection) -> None:
    """Write the diameters with their colours, in as many columns as fit."""
    x, y, counts = _MARGIN_PX, _LEGEND_PX + 24, Counter(map(diameter_mm, inspection.cage.bars))
    for size_mm, colour in colours.items():
        name = "no diameter" if size_mm is None else f"{size_mm:g} mm"
        text = f"{name} ({counts[size_mm]})"
        end = x + 46 + font(20).getlength(text)
        if end > _WIDTH_PX - _MARGIN_PX:
            x, y, end = _MARGIN_PX, y + 30, _MARGIN_PX + 46 + font(20).getlength(text)
        draw.line((x, y + 12, x + 34, y + 12), colour, 8)
        draw.text((x + 46, y), text, _INK, font(20))
        x = int(end) + 36


@cache
def font(size_px: float) -> ImageFont.FreeTypeFont:
    """Return the font at a size in pixels."""
    content = files("dataset_builder.inspection").joinpath(FONT_FILE).read_bytes()
    return ImageFont.truetype(io.BytesIO(content), size_px, layout_engine=ImageFont.Layout.BASIC)


def text_width(text: str, size_px: float) -> float:
    """Return the width of a text in pixels."""
    return font(1000).getlength(text) * size_px / 1000


def shortened(text: str, size_px: float, width_px: float) -> str:
    """Return a text that fits into a width, an ellipsis in its middle if need be: names differ at the end."""
    if text_width(text, size_px) <= width_px:
        return text
    for kept in range(len(text) - 1, 1, -1):
        short = f"{text[: (kept + 1) // 2]}…{text[len(text) - kept // 2 :]}"
        if text_width(short, size_px) <= width_px:
            return short
    return "…"
