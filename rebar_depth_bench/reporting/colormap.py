"""Colours for depth and for signed error: two maps of 255 colours, as data, the same bytes on every machine.

Both were laid out in OKLab (Ottosson 2020) with equal steps between their 17 anchors. Between anchors the
colours are interpolated in whole numbers: previews are part of the dataset's digest, so no rounding may
depend on a processor.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32, UInt8
from numpy import ndarray

COLOURS = 255
"""Colours in a map: with one more for "nothing here" they fill an 8-bit palette."""

_DEPTH_ANCHORS = (
    "151c53 29206a 40227e 58218f 712795 8b2b94 a52f8e bd3585 d14079 "
    "e3516e f26364 ff775a ff9261 ffaa67 ffc271 ffd97a fcef83"
)
_ERROR_ANCHORS = (
    "1347bb 2b5fc5 4376cf 5d8cd9 78a1e1 94b6e9 b1cbef d0dff4 f3f3f3 "
    "f0d9ca e9bfa6 e0a585 d68b66 cb7047 bf5427 af3801 952701"
)


def _interpolated(anchors: str) -> UInt8[ndarray, "255 3"]:
    """Return the map through evenly spaced ``rrggbb`` anchors, linear in sRGB, in integer arithmetic."""
    points = np.array([list(bytes.fromhex(anchor)) for anchor in anchors.split()], dtype=np.int64)
    steps = COLOURS - 1
    along = np.arange(COLOURS) * (len(points) - 1)
    left = np.minimum(along // steps, len(points) - 2)
    part = (along - left * steps)[:, None]
    mixed = (points[left] * (steps - part) + points[left + 1] * part + steps // 2) // steps
    colours: ndarray = mixed.astype(np.uint8)
    colours.setflags(write=False)
    return colours


DEPTH_COLOURS = _interpolated(_DEPTH_ANCHORS)
"""Far (0, dark blue) to near (254, bright yellow): lightness rises all the way, so it reads in grey too."""

ERROR_COLOURS = _interpolated(_ERROR_ANCHORS)
"""Too near (0, blue) over none (127, near white) to too far (254, red-brown): both arms equally dark."""


def robust_range(values: Float[ndarray, " n"], share: float = 0.02) -> tuple[float, float]:
    """Return the order statistics that leave out ``share`` of ``values`` at either end (no interpolation).

    ``values`` holds at least one number and none that is not finite.
    """
    low = int(share * (values.size - 1))
    high = values.size - 1 - low
    ordered = np.partition(values, (low, high))
    return float(ordered[low]), float(ordered[high])


def positions(values: Float[ndarray, "*shape"], first: float, last: float) -> UInt8[ndarray, "*shape"]:
    """Return where ``values`` fall in a map of 255 colours that runs from ``first`` (0) to ``last`` (254).

    Values beyond either end take the end's colour, and so do infinities; NaN takes colour 0. ``first`` may
    be larger than ``last``. Where both are equal, everything takes the middle colour.
    """
    steps = COLOURS - 1
    if first == last:
        return np.full(values.shape, steps // 2, dtype=np.uint8)
    with np.errstate(invalid="ignore", over="ignore"):
        along = (values.astype(np.float64) - first) * steps / (last - first)
    found: ndarray = np.rint(np.clip(np.nan_to_num(along, nan=0.0), 0, steps)).astype(np.uint8)
    return found


def depth_preview(
    depth_m: Float32[ndarray, "h w"],
) -> tuple[UInt8[ndarray, "h w"], bytes]:
    """Return a depth image as palette indices and the palette, 768 bytes of RGB, for an 8-bit palette PNG.

    ``depth_m`` is metres, 0 (or anything that is not a positive number) where there is no surface: index 0,
    black. Colours 1 to 255 run from far (dark) to near (bright and warm), evenly in inverse depth so that
    near steel keeps its contrast before a distant ground, between the 2nd and the 98th percentile.
    """
    palette = bytes(3) + DEPTH_COLOURS.tobytes()
    indices = np.zeros(depth_m.shape, dtype=np.uint8)
    surface = np.isfinite(depth_m) & (depth_m > 0)
    if surface.any():
        inverse = 1.0 / depth_m[surface].astype(np.float64)
        far, near = robust_range(inverse)
        indices[surface] = positions(inverse, far, near) + np.uint8(1)
    return indices, palette
