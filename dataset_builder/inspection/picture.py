"""Picture of a cage from four sides, cast by parallel rays without Blender: front, right, top and a corner."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache
from importlib.resources import files
from itertools import product

import numpy as np
from jaxtyping import Float64, Integer
from numpy import ndarray
from PIL import Image, ImageDraw, ImageFont

from dataset_builder.inspection.summary import Box, Inspection, diameter_mm
from dataset_builder.scene.assemblies.cage import CageBar
from dataset_builder.scene.model import Mesh, WorldMesh
from dataset_builder.scene.raycast import RayCaster
from dataset_builder.scene.shapes.bar_mesh import plain_bar_mesh
from dataset_builder.scene.shapes.solids import world_mesh
from rebar_depth_bench.base.errors import printable
from rebar_depth_bench.scoring.formatting import counted

FONT_FILE = "DejaVuSans-subset.ttf"
"""Font of the pictures, which comes with the package: the same text width on every machine."""

_PANEL_PX, _MARGIN_PX, _HEAD_PX = (960, 640), 40, 90
_WIDTH_PX, _LEGEND_PX = 2 * _PANEL_PX[0], 2 * _PANEL_PX[1] + _HEAD_PX
"""Width of a picture, and the upper end of the legend below its panels."""
_OVERSAMPLING = 2
"""Rays per pixel of the picture, along each side, whose colours are averaged."""
_MIN_PX = 1.2
"""Smallest diameter of bars in the picture, pixels, so that thin ones are not missed by rays."""

_PAPER, _INK, _GREY, _MARK = (255, 255, 255), (20, 20, 20), (110, 110, 110), (214, 0, 60)
_COLOURS = ((0, 90, 160), (213, 94, 0), (0, 135, 100), (130, 70, 150), (170, 120, 0), (60, 60, 60), (0, 150, 190))
"""Colours of diameters, the largest first; repeated for further ones."""
_UNKNOWN = (150, 150, 150)
_HAZE = 0.6
"""Share of white in the colour of the farthest steel."""
_RIM = 0.5
"""Share of the colour that is left where steel is seen at a grazing angle."""

_MAX_MARKS = 200
_SEGMENTS = 16
"""Sides of the cross-section of bars."""

_SIDES = {
    "front: x to the right, z up": ((1, 0, 0), (0, -1, 0)),
    "right: y to the right, z up": ((0, 1, 0), (1, 0, 0)),
    "top: x to the right, y up": ((1, 0, 0), (0, 0, 1)),
    "corner: from the front, the right and above": ((1.2, 0.9, 0.0), (0.9, -1.2, 0.8)),
}
"""Directions to the right and towards the viewer, by title."""


def inspection_picture(inspection: Inspection) -> bytes:
    """Return a PNG of a cage from four sides, with its diameters, sizes, and marks where bars clash."""
    counts = Counter(map(diameter_mm, inspection.cage.bars))
    diameters = sorted(counts, key=lambda size_mm: -(size_mm or 0.0))
    colours = [_COLOURS[number % len(_COLOURS)] for number in range(len(diameters))]
    if None in counts:
        colours[-1] = _UNKNOWN
    # The cage is cast at unit size, since Embree has 32-bit coordinates.
    centre_m, size_m = inspection.box_m.mean(axis=0), max(float(np.ptp(inspection.box_m, axis=0).max()), 1e-6)
    corners = np.array(list(product(*((inspection.box_m - centre_m) / size_m).T)))
    axes, boxes = list[Float64[ndarray, "3 3"]](), list[Box]()
    for right, towards in _SIDES.values():
        rows = np.array([right, np.cross(towards, right), towards], dtype=np.float64)
        axes.append(rows / np.linalg.norm(rows, axis=1, keepdims=True))
        in_view = corners @ axes[-1].T
        boxes.append(np.array([in_view.min(axis=0), in_view.max(axis=0)]))
    room_px = np.array([_PANEL_PX[0] - 2 * _MARGIN_PX, _PANEL_PX[1] - 4 * _MARGIN_PX])
    scales = [float((room_px / np.maximum(np.ptp(box, axis=0)[:2], 1e-6)).min()) for box in boxes]
    mesh = _mesh_of_colours(inspection.cage.bars, diameters, _MIN_PX / min(scales) * size_m)
    caster = RayCaster(replace(mesh, vertices_m=(mesh.vertices_m - centre_m) / size_m))
    picture = Image.new("RGB", (_WIDTH_PX, _LEGEND_PX + _HEAD_PX), _PAPER)
    for number, title in enumerate(_SIDES):
        panel = _cast(caster, axes[number], boxes[number], scales[number], np.array(colours))
        draw = ImageDraw.Draw(panel)
        for clash in (inspection.clashes or ())[:_MAX_MARKS]:
            off_px = axes[number] @ (clash.point_m - centre_m) / size_m * scales[number]
            x, y = _PANEL_PX[0] / 2 + float(off_px[0]), _PANEL_PX[1] / 2 - float(off_px[1])
            draw.ellipse((x - 5, y - 5, x + 5, y + 5), outline=_MARK, width=2)
        draw.text((_MARGIN_PX, 10), title, _INK, font(20))
        _draw_scale_bar(draw, scales[number] / size_m)
        picture.paste(panel, (number % 2 * _PANEL_PX[0], number // 2 * _PANEL_PX[1] + _HEAD_PX))
    draw = ImageDraw.Draw(picture)
    draw.text((_MARGIN_PX, 14), printable(inspection.name, 60), _INK, font(30))
    words = f"{counted(len(inspection.cage.bars), 'bar')}, {inspection.size_text} (x, y, z)"
    if inspection.clashes:
        words += f"; red circles: {counted(len(inspection.clashes), 'pair')} of bars clash"
    draw.text((_MARGIN_PX, 54), words, _GREY, font(20))
    x, y = _MARGIN_PX, _LEGEND_PX + 24
    for size_mm, colour in zip(diameters, colours, strict=True):
        text = f"{'no diameter' if size_mm is None else f'{size_mm:g} mm'} ({counts[size_mm]})"
        width = 46 + int(font(20).getlength(text))
        if x + width > _WIDTH_PX - _MARGIN_PX:
            x, y = _MARGIN_PX, y + 30
        draw.line((x, y + 12, x + 34, y + 12), colour, 8)
        draw.text((x + 46, y), text, _INK, font(20))
        x += width + 36
    stream = io.BytesIO()
    picture.save(stream, "png")
    return stream.getvalue()


def _mesh_of_colours(bars: Sequence[CageBar], diameters: Sequence[float | None], min_m: float) -> WorldMesh:
    """Return the surfaces of bars; the label of each is the number of its diameter from 1.

    Bars thinner than ``min_m`` are drawn as thick. Those whose axis turns back on itself, which a build refuses,
    have no surface; if there are no others, it is a triangle without area.
    """
    meshes, labels = list[Mesh](), list[int]()
    for bar in bars:
        mesh = bar.mesh
        if mesh is None or (bar.bar.has_axis and bar.bar.diameter_m < min_m):
            with suppress(ValueError):
                mesh = plain_bar_mesh(np.array(bar.bar.axis_m), max(bar.bar.diameter_m, min_m), _SEGMENTS)
        if mesh is not None:
            meshes.append(mesh)
            labels.append(1 + diameters.index(diameter_mm(bar)))
    return world_mesh(meshes or [Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]], np.int32))], labels or [1])


def _cast(
    caster: RayCaster,
    axes: Float64[ndarray, "3 3"],
    box: Box,
    px_per_unit: float,
    colours: Integer[ndarray, "n 3"],
) -> Image.Image:
    """Return the steel that parallel rays hit, paler in the distance; ``box`` is in the frame of ``axes``."""
    width, height = (side * _OVERSAMPLING for side in _PANEL_PX)
    step, middle = 1 / (px_per_unit * _OVERSAMPLING), box.mean(axis=0)
    origins = np.empty((height, width, 3))
    origins[..., 0] = middle[0] + (np.arange(width) - (width - 1) / 2) * step
    origins[..., 1] = middle[1] - (np.arange(height) - (height - 1) / 2)[:, None] * step
    origins[..., 2] = box[1, 2] + 1
    hits = caster.hits(origins.reshape(-1, 3) @ axes, np.broadcast_to(-axes[2], (width * height, 3)))
    is_hit = hits.bar_id > 0
    haze = _HAZE * np.clip((hits.range_m[is_hit] - 1) / max(box[1, 2] - box[0, 2], 1e-6), 0, 1)
    shade = _RIM + (1 - _RIM) * hits.cos_incidence[is_hit]
    steel = colours[hits.bar_id[is_hit] - 1] * shade[:, None]
    pixels = np.full((width * height, 3), 255, np.uint8)
    pixels[is_hit] = (steel + haze[:, None] * (255 - steel)).round()
    return Image.fromarray(pixels.reshape(height, width, 3)).resize(_PANEL_PX, Image.Resampling.BOX)


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


@cache
def font(size_px: float) -> ImageFont.FreeTypeFont:
    """Return the font at a size in pixels."""
    content = files("dataset_builder.inspection").joinpath(FONT_FILE).read_bytes()
    return ImageFont.truetype(io.BytesIO(content), size_px, layout_engine=ImageFont.Layout.BASIC)
