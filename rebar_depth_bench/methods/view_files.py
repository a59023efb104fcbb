"""Files that show a predicted view: its depth in colour with a scale (PNG), and its points in colour (PLY)."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from PIL import Image, ImageDraw, ImageFont

from rebar_depth_bench.base.errors import InputError, printable
from rebar_depth_bench.base.writing import write_bytes
from rebar_depth_bench.geometry.cameras import pixel_rays
from rebar_depth_bench.reporting.colormap import DEPTH_COLOURS, colour_indices, robust_range
from rebar_depth_bench.scoring.metrics import is_valid_prediction
from rebar_depth_bench.scoring.relative import has_value
from rebar_depth_bench.submission.declaration import METRIC

CLOUD_COLUMNS = ("left_rgb", "left_K", "left_distortion")
"""Columns of a row that ``write_point_cloud`` reads."""
NO_DEPTH = (150, 150, 150)
"""Colour of pixels without depth."""

_PAPER, _INK = (255, 255, 255), (20, 20, 20)
_LABELS = 8
"""Number of labels of the colour bar, at nearly even places."""
_MIN_SIDE_PX = 640
"""Images whose longer side is shorter are enlarged by repetition of pixels."""
_MIN_RANGE = 1e-4
"""Smallest range of colours relative to the values; a smaller one is widened, so that labels differ."""
_HEADER = """\
ply
format binary_little_endian 1.0
comment {view_id}: frame of the left camera, x right, y down, z forward; unit metre
element vertex {count}
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
end_header
"""
_VERTEX = np.dtype([("xyz", "<f4", (3,)), ("rgb", "u1", (3,))])


def write_depth_picture(path: Path, view_id: str, depth: Float[ndarray, "h w"], kind: str) -> None:
    """Write a prediction in colour, with a colour bar, as PNG; ``kind`` is one of ``PREDICTION_KINDS``.

    Near is bright. The colours run between the 2nd and the 98th percentile of the pixels with depth, evenly in
    inverse depth as in ``colormap.depth_preview``; of affine kinds, evenly in their values. The picture states the
    unit, the range and the share of pixels without depth, which are grey.
    """
    valid = has_value(depth, kind)
    repeat = -(-_MIN_SIDE_PX // max(depth.shape))
    height, width = (side * repeat for side in depth.shape)
    size = max(12, round(min(height / 36, width / 48)))  # All lengths below are multiples of the font size.
    font, bar_x, top, bar_px = ImageFont.load_default(size), width + 2 * size, 3 * size, max(height, 8 * size)
    picture = Image.new("RGB", (max(bar_x + 7 * size, 44 * size), top + bar_px + 4 * size), _PAPER)
    draw = ImageDraw.Draw(picture)
    draw.text((size, size), printable(view_id, 40), _INK, font)
    quantity = "depth, m" if kind == METRIC else f"{kind}: not metres"
    draw.text((picture.width - size, size), quantity, _INK, font, anchor="ra")
    image = np.full((*depth.shape, 3), NO_DEPTH, np.uint8)
    notes = [f"grey: no depth, {100 * (1 - valid.mean()):.1f} % of the pixels"]
    if valid.any():
        nearness = _nearness(depth[valid].astype(np.float64), kind)
        far, near = robust_range(nearness)
        rule = "the 2nd to the 98th percentile of the pixels"
        if near - far <= _MIN_RANGE * abs(near):
            margin = 0.05 * abs(near) or 1.0
            far, near, rule = far - margin, near + margin, "around values that hardly differ"
        image[valid] = DEPTH_COLOURS[colour_indices(nearness, far, near)]
        bar = Image.fromarray(DEPTH_COLOURS[:, None]).resize((size, bar_px), Image.Resampling.NEAREST)
        picture.paste(bar, (bar_x, top))
        digits = 2 if near - far > 0.05 * abs(near) else 6
        for place in np.linspace(far, near, _LABELS).tolist():
            label = f"{_nearness(np.array(place), kind):.{digits + (place in (far, near))}g}"
            share = (float(_nearness(np.array(float(label)), kind)) - far) / (near - far)
            y = top + min(max(share, 0.0), 1.0) * (bar_px - 1)
            draw.line((bar_x + size, y, bar_x + 1.4 * size, y), _INK, max(1, size // 12))
            draw.text((bar_x + 1.7 * size, y), label, _INK, font, anchor="lm")
        low, high = sorted(_nearness(np.array([far, near]), kind).tolist())
        unit = " m" if kind == METRIC else ""
        notes.insert(0, f"colours: {low:.4g} to {high:.4g}{unit}, {rule}")
    picture.paste(Image.fromarray(image).resize((width, height), Image.Resampling.NEAREST), (size, top))
    draw.text((size, top + bar_px + size // 2), "\n".join(notes), _INK, font, spacing=size // 3)
    stream = io.BytesIO()
    picture.save(stream, "png")
    write_bytes(path, stream.getvalue())


def _nearness(values: Float[ndarray, "*n"], kind: str) -> Float[ndarray, "*n"]:
    """Return a function of the values of a kind that grows towards the camera, and is its own inverse."""
    if kind.startswith("affine"):
        return values if kind == "affine-disparity" else -values
    return 1.0 / values


def write_point_cloud(path: Path, depth_m: Float[ndarray, "h w"], row: Mapping[str, Any]) -> None:
    """Write the valid pixels of a view as a binary PLY file, in pixel order.

    The points are float32 metres in the frame of the left camera (x right, y down, z forward), on the rays of its
    K and lens distortion, with the colours of the left image. ``row`` has the view's ``CLOUD_COLUMNS``. Raises
    ``InputError`` if the lens distortion cannot be inverted.
    """
    height, width = depth_m.shape
    try:
        rays = pixel_rays(row["left_K"], width, height, row["left_distortion"])
    except ValueError as error:
        found = f"{row['view_id']}: its point cloud cannot be computed"
        raise InputError(f"{found}, leave out --ply: {error}") from None
    with np.errstate(over="ignore", invalid="ignore"):
        points_m = (rays * depth_m[..., None]).astype(np.float32)
    valid = is_valid_prediction(depth_m) & np.isfinite(points_m).all(axis=-1)
    vertices = np.empty(np.count_nonzero(valid), _VERTEX)
    vertices["xyz"], vertices["rgb"] = points_m[valid], row["left_rgb"][valid]
    header = _HEADER.format(view_id=row["view_id"], count=len(vertices))
    write_bytes(path, header.encode("ascii") + vertices.tobytes())
