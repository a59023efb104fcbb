"""Choice of a stereo network's passes and image size from the largest expected disparity, and scaling back.

A network's cost volume ends at some disparity, and smaller images have smaller disparities. FoundationStereo's
demo (``scripts/run_demo.py``) has two options that extend the range: ``--hiera 1`` starts a pass at full size from
the result of a pass at half the size, and ``--scale`` makes the images smaller. The choice is:

- One pass at full size, where the volume holds the largest expected disparity.
- Two passes (hierarchical) where it holds half of it. The second pass has the full resolution; at disparities
  beyond the end of the volume it refines with the correlation of the two images' features alone.
- Two passes on smaller images otherwise, as large as the volume of the first pass allows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

SMALL_RATIO = 0.5
"""Size of the first of two passes, relative to the second."""


@dataclass(frozen=True)
class Passes:
    """Passes of a network: one or two (``hierarchical``), on images resized by ``scale``, which is at most 1."""

    hierarchical: bool
    scale: float = 1.0

    @property
    def mode(self) -> str:
        """Name of the mode."""
        return "hierarchical" if self.hierarchical else "single pass"


def choose_passes(largest_px: float, volume_px: int) -> Passes:
    """Return the passes on the largest images for which a volume of ``volume_px`` holds ``largest_px``."""
    if largest_px <= volume_px:
        return Passes(hierarchical=False)
    return Passes(hierarchical=True, scale=min(1.0, volume_px / (SMALL_RATIO * largest_px)))


def resized(rgb: UInt8[ndarray, "h w 3"], scale: float) -> UInt8[ndarray, "hs ws 3"]:
    """Return an image resized by ``scale`` with OpenCV, bilinear as in the demo; sides are rounded down.

    The demo rounds to the nearest whole side; rounding down never enlarges the disparity.
    """
    import cv2

    height, width = (max(1, int(side * scale)) for side in rgb.shape[:2])
    if (height, width) == rgb.shape[:2]:
        return rgb
    return np.asarray(cv2.resize(rgb, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)


def full_size_disparity_px(
    disparity_px: Float32[ndarray, "hs ws"], grid: tuple[int, int]
) -> Float32[ndarray, "h w"]:
    """Return a resized image's disparity on the original ``grid`` = (H, W), in pixels of that grid.

    Each pixel takes the disparity of the resized pixel that contains its centre, because interpolation would place
    surfaces between a bar and its background. The factor is that of the widths, which rounding moves away from
    ``scale``.
    """
    rows, columns = (
        ((np.arange(full) + 0.5) * small / full).astype(np.int64)
        for full, small in zip(grid, disparity_px.shape, strict=True)
    )
    factor = np.float32(grid[1] / disparity_px.shape[1])
    return np.asarray(disparity_px[rows[:, None], columns] * factor, np.float32)
