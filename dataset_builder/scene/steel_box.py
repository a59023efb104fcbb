"""Box of pixels around the steel of a picture, which colour rendering samples more often than the rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool
from numpy import ndarray


@dataclass(frozen=True)
class PixelBox:
    """Rectangle of pixels: rows ``top`` to ``bottom - 1``, columns ``left`` to ``right - 1``."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Index of the box in an image."""
        return slice(self.top, self.bottom), slice(self.left, self.right)


def steel_box(mask: Bool[ndarray, "h w"], margin_px: int) -> PixelBox | None:
    """Return the smallest box with all steel pixels and ``margin_px`` around them; None without steel.

    The box is cut off at the borders of the image.
    """
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    if not rows.size:
        return None
    height, width = mask.shape
    return PixelBox(
        top=max(int(rows[0]) - margin_px, 0),
        bottom=min(int(rows[-1]) + 1 + margin_px, height),
        left=max(int(columns[0]) - margin_px, 0),
        right=min(int(columns[-1]) + 1 + margin_px, width),
    )
