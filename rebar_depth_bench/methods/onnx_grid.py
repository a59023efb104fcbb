"""From a picture to a model's input and from its answer back to the picture's grid: where each pixel comes from.

Positions are continuous here: a side of n pixels runs from 0 to n, pixel i covers i to i + 1, its centre i + 0.5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int64, UInt8
from numpy import ndarray
from PIL import Image

from rebar_depth_bench.methods.onnx_toml import InputSpec


@dataclass(frozen=True)
class Span:
    """One side, pixels: ``picture`` of them become ``resized``, ``before`` of padding, ``canvas`` in all."""

    picture: int
    resized: int
    before: int
    canvas: int

    @property
    def scale(self) -> float:
        """Input pixels per picture pixel: what the focal length on this side is multiplied by."""
        return self.resized / self.picture


@dataclass(frozen=True)
class Placement:
    """Where a picture lies in the model's input."""

    across: Span
    down: Span


def placement(spec: InputSpec, width: int, height: int) -> Placement:
    """Return where a ``width`` x ``height`` picture lies in the input: stretched, or centred."""
    canvas = spec.size_px or _canvas_px(spec, width, height)
    ratio = min(canvas[0] / width, canvas[1] / height)
    across, down = (
        _span(side, min(max(round(side * ratio), 1), room) if spec.pad else room, room)
        for side, room in zip((width, height), canvas, strict=True)
    )
    return Placement(across, down)


def _canvas_px(spec: InputSpec, width: int, height: int) -> tuple[int, int]:
    ratio = spec.longest_px / max(width, height)
    across, down = (max(round(side * ratio / spec.multiple_px), 1) * spec.multiple_px for side in (width, height))
    return across, down


def _span(picture: int, resized: int, canvas: int) -> Span:
    return Span(picture, resized, (canvas - resized) // 2, canvas)


def input_tensor(
    spec: InputSpec, place: Placement, rgb: UInt8[ndarray, "h w 3"]
) -> Float64[ndarray, "1 3 canvas_h canvas_w"]:
    """Return the picture resized, normalised and padded with the mean (0 after normalisation), NCHW, RGB.

    Pillow resizes the 8-bit picture; where it gets smaller all pixels that fall on a new one are weighed in
    (antialiased), which OpenCV's and torch's default resize are not.
    """
    size = (place.across.resized, place.down.resized)
    kernel = Image.Resampling.BICUBIC if spec.bicubic else Image.Resampling.BILINEAR
    resized = np.asarray(Image.fromarray(rgb).resize(size, kernel), np.float64)
    normalised = (resized * (spec.white / 255) - np.array(spec.mean)) / np.array(spec.std)
    tensor = np.zeros((1, 3, place.down.canvas, place.across.canvas))
    tensor[0, :, _inside(place.down), _inside(place.across)] = normalised.transpose(2, 0, 1)
    return tensor


def _inside(span: Span) -> slice:
    return slice(span.before, span.before + span.resized)


def on_picture(
    place: Placement, values: Float[ndarray, "out_h out_w"], *, bilinear: bool
) -> Float[ndarray, "h w"]:
    """Return values of a grid over the whole input at the picture's pixels; never one from the padding.

    Nearest takes the value of the cell in which the pixel's centre lies. Bilinear mixes neighbours, NaN if one
    of them is: smooth, but at a bar's edge it makes depth that lies neither on the bar nor behind it.
    """
    out_height, out_width = values.shape
    if not bilinear:
        rows, columns = _nearest(place.down, out_height), _nearest(place.across, out_width)
        return np.asarray(values[np.ix_(rows, columns)])
    top, bottom, from_top = _neighbours(place.down, out_height)
    left, right, from_left = _neighbours(place.across, out_width)
    upper, lower = (_mixed(values[rows][:, left], values[rows][:, right], from_left) for rows in (top, bottom))
    return _mixed(upper, lower, from_top[:, None])


def _mixed(
    first: Float[ndarray, "a b"], second: Float[ndarray, "a b"], share: Float64[ndarray, ...]
) -> Float[ndarray, "a b"]:
    return np.asarray(first * (1 - share) + second * share)


def _nearest(span: Span, cells: int) -> Int64[ndarray, " n"]:
    first, last = _cells_inside(span, cells)
    return np.asarray(np.clip(np.floor(_position(span, cells)).astype(np.int64), first, last))


def _neighbours(
    span: Span, cells: int
) -> tuple[Int64[ndarray, " n"], Int64[ndarray, " n"], Float64[ndarray, " n"]]:
    """Return the cells whose centres lie before and after each pixel's, and the share of the one after."""
    first, last = _cells_inside(span, cells)
    place = np.clip(_position(span, cells) - 0.5, first, last)
    before = np.floor(place).astype(np.int64)
    share = place - before
    # Where a centre is hit no second cell counts, NaN or not.
    return before, np.where(share > 0, np.minimum(before + 1, last), before), share


def _position(span: Span, cells: int) -> Float64[ndarray, " n"]:
    """Return where each picture pixel's centre lies on a grid of ``cells`` over the whole input.

    Whole numbers up to one division: a centre on a cell's edge lies there exactly, on every machine.
    """
    twice_centres = 2 * np.arange(span.picture, dtype=np.int64) + 1
    numerators = (twice_centres * span.resized + 2 * span.picture * span.before) * cells
    return np.asarray(numerators / (2 * span.picture * span.canvas))


def _cells_inside(span: Span, cells: int) -> tuple[int, int]:
    """Return the first and last cell without padding; where a coarse grid has none, the one in the middle."""
    first = -(-span.before * cells // span.canvas)
    last = (span.before + span.resized) * cells // span.canvas - 1
    if first <= last:
        return first, last
    middle = min((2 * span.before + span.resized) * cells // (2 * span.canvas), cells - 1)
    return middle, middle
