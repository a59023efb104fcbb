"""Drawings as PNG, drawn with Pillow in twice the resolution and reduced, which smooths the edges."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from io import BytesIO
from typing import TYPE_CHECKING

from rebar_depth_bench.reporting.figure.drawing import PAPER, Drawing, Element, Path, Point, Text, font

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw

DPI = 300
_OVERSAMPLING = 2
_PX_PER_POINT = DPI / 72 * _OVERSAMPLING
_ANCHORS = {"start": "ls", "middle": "ms", "end": "rs"}


def png_bytes(drawing: Drawing) -> bytes:
    """Return a drawing as PNG with 300 dots per inch of its size in print."""
    from PIL import Image, ImageDraw

    size = [_OVERSAMPLING * math.ceil(side * DPI / 72) for side in (drawing.width, drawing.height)]
    image = Image.new("RGB", (size[0], size[1]), PAPER)
    canvas = ImageDraw.Draw(image)
    for element in drawing.elements:
        _draw(image, canvas, element)
    out = BytesIO()
    image.reduce(_OVERSAMPLING).save(out, "PNG", dpi=(DPI, DPI), optimize=True)
    return out.getvalue()


def _draw(image: Image, canvas: ImageDraw, element: Element) -> None:
    if isinstance(element, Path):
        _draw_path(canvas, element, (0.0, 0.0))
    elif isinstance(element, Text):
        _draw_text(image, canvas, element)
    else:
        for path in element.paths:
            _draw_path(canvas, path, element.at)


def _draw_path(canvas: ImageDraw, path: Path, origin: Point) -> None:
    points = [_px((x + origin[0], y + origin[1])) for x, y in path.points]
    if path.fill:
        canvas.polygon(points, fill=path.fill)
    if path.stroke:
        outline = [*points, points[0], points[1]] if path.closed else points
        width = max(round(path.width * _PX_PER_POINT), 1)
        for piece in _dashes(outline, [length * _PX_PER_POINT for length in path.dash]):
            canvas.line(piece, fill=path.stroke, width=width, joint="curve")


def _dashes(points: Sequence[Point], lengths: Sequence[float]) -> Iterator[list[Point]]:
    """Yield the dashes of a line; the whole line if it has none. Dashed lines have two points."""
    if not lengths:
        yield list(points)
        return
    (x0, y0), (x1, y1) = points
    total = math.hypot(x1 - x0, y1 - y0)
    start, index = 0.0, 0
    while start < total:
        end = min(start + lengths[index % len(lengths)], total)
        if index % 2 == 0:
            yield [(x0 + (x1 - x0) * at / total, y0 + (y1 - y0) * at / total) for at in (start, end)]
        start, index = end, index + 1


def _draw_text(image: Image, canvas: ImageDraw, text: Text) -> None:
    letters, at = font(text.size * _PX_PER_POINT), _px(text.at)
    if not text.turned:
        canvas.text(at, text.content, fill=text.colour, font=letters, anchor=_ANCHORS[text.anchor])
        return
    from PIL import Image as Images
    from PIL import ImageDraw as Drawings

    width, height = round(letters.getlength(text.content)), round(1.5 * letters.size)
    mask = Images.new("L", (width, height))
    Drawings.Draw(mask).text((0, letters.size), text.content, fill=255, font=letters, anchor="ls")
    turned = mask.rotate(90, expand=True)
    before = {"start": width, "middle": width / 2, "end": 0}[text.anchor]
    image.paste(text.colour, (round(at[0] - letters.size), round(at[1] - before)), turned)


def _px(point: Point) -> Point:
    return point[0] * _PX_PER_POINT, point[1] * _PX_PER_POINT
