"""Reference errors of a config, from ground truth alone: a scaled constant, and depth shifted by one pixel.

They show what the numbers of a config mean. A scaled error above that of the constant says that the prediction
describes the shape worse than a plane at one depth does. A native error below that of exact depth shifted by one
pixel is smaller than the differences between neighbouring pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt32
from numpy import ndarray

from rebar_depth_bench.scoring.columns import Size, rounded
from rebar_depth_bench.scoring.metrics import depth_metrics, mean

UNDEFINED = -1.0
"""Number that stands for an undefined one in the cache, which stores finite numbers."""

ReferenceNumbers = tuple[float, ...]
"""AbsRel and RMSE (cm) of the constant, and those of depth shifted by one pixel, of a view; or ``UNDEFINED``."""


@dataclass(frozen=True)
class Errors:
    """AbsRel and RMSE (cm) of a reference; None where undefined."""

    abs_rel: Size | None = None
    rmse_cm: Size | None = None


@dataclass(frozen=True)
class Reference:
    """Reference errors of a config: means over its views.

    The errors of ``constant``, a constant prediction after scaling, are compared with scaled errors of complete
    predictions. The errors of ``one_pixel``, exact depth taken one pixel to the left, right, above and below
    (means of the four), are compared with native errors. ``scaled_constant`` has those of a constant after scaling
    on the predicted pixels, to compare with scaled errors; it depends on the predictions.
    """

    constant: Errors = Errors()
    one_pixel: Errors = Errors()
    scaled_constant: Errors = Errors()

    def to_dict(self) -> dict[str, dict[str, float | None]]:
        """Return the errors that follow from the ground truth as a JSON-compatible object."""
        return {
            name: {key: rounded(value) for key, value in vars(errors).items()}
            for name, errors in (("constant", self.constant), ("one_pixel", self.one_pixel))
        }


NO_REFERENCE = Reference()
"""Reference errors that are not known."""


def view_reference(
    depth_m: Float32[ndarray, "h w"], pixels: UInt32[ndarray, " n"], median_m: float
) -> ReferenceNumbers:
    """Return the reference errors of a view on its scored pixels, one or more.

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
    abs_rel, rmse_cm = mean([one.abs_rel for one in shifted]), mean([one.rmse_cm for one in shifted])
    one_pixel = (UNDEFINED, UNDEFINED) if abs_rel is None or rmse_cm is None else (abs_rel, rmse_cm)
    return *constant_errors(z_m, median_m), *one_pixel


def constant_errors(z_m: Float32[ndarray, " n"], median_m: float) -> tuple[float, float]:
    """Return AbsRel and RMSE (cm) of the depth ``median_m`` at pixels of the true depth ``z_m``."""
    metrics = depth_metrics(np.full(len(z_m), median_m), z_m)
    return metrics.abs_rel, metrics.rmse_cm


def mean_reference(views: Sequence[ReferenceNumbers]) -> Reference:
    """Return the means over views of their defined reference errors."""
    means = [mean([view[k] for view in views if view[k] != UNDEFINED]) for k in range(4)]
    return Reference(Errors(*means[:2]), Errors(*means[2:]))
