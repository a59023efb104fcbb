"""Colour maps of depth and signed error with 255 colours each, identical on every machine.

The 17 anchors of each map were chosen in OKLab (Ottosson 2020) with equal steps. Between anchors the colours are
interpolated in integer arithmetic, because previews are part of the dataset's digest and must not depend on the
rounding of a processor.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32, UInt8
from numpy import ndarray

COLOURS = 255
"""Number of colours in a map; with one more for missing values they fill an 8-bit palette."""

_DEPTH_ANCHORS = (
    "151c53 29206a 40227e 58218f 712795 8b2b94 a52f8e bd3585 d14079 "
    "e3516e f26364 ff775a ff9261 ffaa67 ffc271 ffd97a fcef83"
)
_ERROR_ANCHORS = (
    "1347bb 2b5fc5 4376cf 5d8cd9 78a1e1 94b6e9 b1cbef d0dff4 f3f3f3 "
    "f0d9ca e9bfa6 e0a585 d68b66 cb7047 bf5427 af3801 952701"
)


def _interpolate_anchors(anchors: str) -> UInt8[ndarray, "255 3"]:
    """Return the map that interpolates evenly spaced ``rrggbb`` anchors linearly in sRGB, using integers."""
    points = np.array([list(bytes.fromhex(anchor)) for anchor in anchors.split()], dtype=np.int64)
    steps = COLOURS - 1
    positions = np.arange(COLOURS) * (len(points) - 1)
    left = np.minimum(positions // steps, len(points) - 2)
    weight = (positions - left * steps)[:, None]
    interpolated = (points[left] * (steps - weight) + points[left + 1] * weight + steps // 2) // steps
    colours: ndarray = interpolated.astype(np.uint8)
    colours.setflags(write=False)
    return colours


DEPTH_COLOURS = _interpolate_anchors(_DEPTH_ANCHORS)
"""Depth map from far (0, dark blue) to near (254, bright yellow).

Lightness increases monotonically, so that the map remains readable in greyscale.
"""

ERROR_COLOURS = _interpolate_anchors(_ERROR_ANCHORS)
"""Signed-error map from too near (0, blue) through zero (127, near white) to too far (254, red-brown).

Both ends are equally dark.
"""


def robust_range(values: Float[ndarray, " n"]) -> tuple[float, float]:
    """Return the order statistics that exclude 2 % of ``values`` at either end, without interpolation.

    ``values`` must not be empty, and all values must be finite.
    """
    low = int(0.02 * (values.size - 1))
    high = values.size - 1 - low
    ordered = np.partition(values, (low, high))
    return float(ordered[low]), float(ordered[high])


def colour_indices(values: Float[ndarray, "*shape"], first: float, last: float) -> UInt8[ndarray, "*shape"]:
    """Return the indices of ``values`` in a map of 255 colours that runs from ``first`` (0) to ``last`` (254).

    Values beyond either end, including infinities, get the index of that end; NaN gets index 0. ``first`` may be
    larger than ``last``. If both are equal, all values get the middle index.
    """
    steps = COLOURS - 1
    if first == last:
        return np.full(values.shape, steps // 2, dtype=np.uint8)
    with np.errstate(invalid="ignore", over="ignore"):
        positions = (values.astype(np.float64) - first) * steps / (last - first)
    indices: ndarray = np.rint(np.clip(np.nan_to_num(positions, nan=0.0), 0, steps)).astype(np.uint8)
    return indices


def depth_preview(
    depth_m: Float32[ndarray, "h w"],
) -> tuple[UInt8[ndarray, "h w"], bytes]:
    """Return a depth image as palette indices and the palette (768 bytes of RGB) of an 8-bit palette PNG.

    ``depth_m`` is in metres. Pixels that are not finite or <= 0 have no surface and get index 0, black. Colours 1
    to 255 run from far (dark) to near (bright and warm) between the 2nd and the 98th percentile. They are evenly
    spaced in inverse depth, so that near steel keeps its contrast in front of distant ground.
    """
    palette = bytes(3) + DEPTH_COLOURS.tobytes()
    indices = np.zeros(depth_m.shape, dtype=np.uint8)
    surface = np.isfinite(depth_m) & (depth_m > 0)
    if surface.any():
        inverse = 1.0 / depth_m[surface].astype(np.float64)
        far, near = robust_range(inverse)
        indices[surface] = colour_indices(inverse, far, near) + np.uint8(1)
    return indices, palette
