"""Reference errors of a config, from ground truth alone: a scaled constant, and depth shifted by one pixel.

They show what the numbers of a config mean. A scaled error above the constant's says that the prediction
describes the shape worse than a plane at one depth does. A native error below that of exact depth shifted by one
pixel is smaller than the differences between neighbouring pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, UInt32
from numpy import ndarray

from rebar_depth_bench.scoring.metrics import depth_metrics, mean

UNDEFINED = -1.0
"""Number that stands for an undefined one in the cache, which stores finite numbers."""

REFERENCE_PLACES = (
    "reference.constant.abs_rel",
    "reference.constant.rmse_cm",
    "reference.one_pixel.abs_rel",
    "reference.one_pixel.rmse_cm",
)
"""Places of the numbers of ``view_reference`` in the JSON of a table."""


def view_reference(
    depth_m: Float32[ndarray, "h w"], pixels: UInt32[ndarray, " n"], median_m: float
) -> tuple[float, float, float, float]:
    """Return the numbers at ``REFERENCE_PLACES`` of a view on its scored pixels, one or more, or ``UNDEFINED``.

    ``depth_m`` is the true planar depth of the view in metres, 0 where there is no surface; ``pixels`` are flat
    indices; ``median_m`` is the median depth of these pixels. Neighbours without depth or outside the image are
    skipped.
    """
    row, column = np.divmod(pixels.astype(np.intp), depth_m.shape[1])
    framed_m = np.pad(depth_m, 1)
    z_m = depth_m[row, column]
    shifted = []
    for v, u in ((1, 0), (1, 2), (0, 1), (2, 1)):
        neighbour_m = framed_m[row + v, column + u]
        if (has_depth := neighbour_m > 0).any():
            shifted.append(depth_metrics(neighbour_m[has_depth], z_m[has_depth]))
    abs_rel, rmse_cm = constant_errors(z_m, median_m)
    if not shifted:
        return abs_rel, rmse_cm, UNDEFINED, UNDEFINED
    return abs_rel, rmse_cm, mean([one.abs_rel for one in shifted]), mean([one.rmse_cm for one in shifted])


def constant_errors(z_m: Float32[ndarray, " n"], median_m: float) -> tuple[float, float]:
    """Return AbsRel and RMSE (cm) of the depth ``median_m`` at pixels of the true depth ``z_m``."""
    metrics = depth_metrics(np.full(len(z_m), median_m), z_m)
    return metrics.abs_rel, metrics.rmse_cm


def references(numbers: Sequence[float]) -> dict[str, float]:
    """Return the numbers of ``view_reference`` by place; NaN where undefined."""
    return {
        place: math.nan if value == UNDEFINED else value
        for place, value in zip(REFERENCE_PLACES, numbers, strict=True)
    }
