"""The ground truth that extended measures need of one view: the steel, a band round it, and its camera."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float32, Float64, UInt16, UInt32
from numpy import ndarray


@dataclass(frozen=True, eq=False)
class SteelTruth:
    """One view's pixels on steel and within one pixel (3 x 3) of it, wherever true depth is > 0.

    ``index`` holds flat indices into the height x width grid, ascending; the other arrays go with it.
    ``bar_id`` is 0 beside the steel; ``interior`` marks the pixels that ``rebar-1`` scores.
    ``rays`` are x/z and y/z of each pixel's ray in the camera's frame (lens distortion undone), so that
    ``x_cam = depth_m * (rays[:, 0], rays[:, 1], 1)``.
    ``run`` is the bar's straight run that the true point lies nearest to (an index into ``CageTruth.runs``),
    -1 where it is on none; ``front_m`` and ``behind_m`` are the depths of the nearest other layer in front of
    and behind the pixel, NaN where none is in sight: see ``layers``.
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
    rays: Float64[ndarray, "n 2"]
    run: ndarray  # Int16 n
    front_m: Float32[ndarray, " n"]
    behind_m: Float32[ndarray, " n"]
