"""Per-view ground truth of the extended measures: steel pixels, a one-pixel band around them, and the camera."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt16, UInt32
from numpy import ndarray


@dataclass(frozen=True, eq=False)
class JudgedCrossings:
    """Judged crossings of a view: see ``crossings.judged``.

    ``crossing`` holds indices into the scene's crossings, ascending. ``pixels`` are positions in the arrays of
    ``SteelTruth``: k sampled pixels of bar a, and of bar b.
    """

    crossing: Int64[ndarray, " m"]
    pixels: Int64[ndarray, "m 2 k"]

    @classmethod
    def none(cls) -> JudgedCrossings:
        """Return no crossings."""
        return cls(np.empty(0, np.int64), np.empty((0, 2, 1), np.int64))


@dataclass(frozen=True, eq=False)
class SteelTruth:
    """Ground truth of one view at the pixels on steel or within one pixel (3 x 3) of it that have true depth > 0.

    ``index`` holds flat indices into the height x width grid, ascending; the other arrays are parallel to it.
    ``depth_m`` is planar depth, metres. ``bar_id`` is 0 beside the steel; ``interior`` marks the scored pixels of
    the protocol, and ``single_bar`` those of them whose 3 x 3 neighbourhood belongs to one bar. ``rays`` are x/z
    and y/z of each pixel's ray in the camera frame (lens distortion undone), so that ``x_cam = depth_m * (rays[:,
    0], rays[:, 1], 1)``. ``run`` is the straight bar segment whose axis is nearest to the true point (an index
    into ``CageTruth.segments``), -1 where the point is on no segment. ``front_m`` and ``behind_m`` are the depths
    of the closest other layer in front of and behind the pixel, NaN where none is visible: see
    ``depth_layers.other_layers``. ``distortion`` is that of the grid (``cameras.distort``), zeros on an ideal one.
    """

    view_id: str
    height: int
    width: int
    K: Float64[ndarray, "3 3"]
    cam_from_world: Float64[ndarray, "4 4"]
    index: UInt32[ndarray, " n"]
    depth_m: Float32[ndarray, " n"]
    bar_id: UInt16[ndarray, " n"]
    interior: Bool[ndarray, " n"]
    single_bar: Bool[ndarray, " n"]
    rays: Float64[ndarray, "n 2"]
    run: ndarray  # Int16 n
    front_m: Float32[ndarray, " n"]
    behind_m: Float32[ndarray, " n"]
    distortion: Float64[ndarray, " 5"] = field(default_factory=lambda: np.zeros(5))
    judged: JudgedCrossings = field(default_factory=JudgedCrossings.none)
