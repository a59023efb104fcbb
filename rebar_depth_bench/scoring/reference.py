"""Reference errors of a config, from ground truth alone: a scaled constant, and depth shifted by one pixel.

They show what the numbers of a config mean. A scaled error above that of the constant says that the prediction
describes the shape worse than a plane at one depth does. A native error below that of exact depth shifted by one
pixel is smaller than the differences between neighbouring pixels.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import astuple, dataclass

import numpy as np
from jaxtyping import Float32, UInt32
from numpy import ndarray

from rebar_depth_bench.scoring.metrics import depth_metrics, mean
from rebar_depth_bench.scoring.rounding import rounded

_UNDEFINED = -1.0
"""Number that stands for an undefined error in the cache, which stores finite numbers."""


@dataclass(frozen=True)
class Reference:
    """Reference errors of a view, or their means over the views of a config; None where undefined.

    The errors of ``constant``, a constant prediction after scaling, are compared with scaled errors of complete
    predictions (with others, ``Table.scaled_constant``). The errors of ``one_pixel``, exact depth taken one pixel
    to the left, right, above and below (means of the four), are compared with native errors.
    """

    constant_abs_rel: float | None = None
    constant_rmse_cm: float | None = None
    one_pixel_abs_rel: float | None = None
    one_pixel_rmse_cm: float | None = None

    def to_dict(self) -> dict[str, dict[str, float | None]]:
        """Return the errors as a JSON-compatible object."""
        return {
            "constant": {"abs_rel": rounded(self.constant_abs_rel), "rmse_cm": rounded(self.constant_rmse_cm)},
            "one_pixel": {"abs_rel": rounded(self.one_pixel_abs_rel), "rmse_cm": rounded(self.one_pixel_rmse_cm)},
        }

    def to_numbers(self) -> tuple[float, ...]:
        """Return the errors as numbers for the cache."""
        return tuple(_UNDEFINED if value is None else value for value in astuple(self))


NO_REFERENCE = Reference()
"""Reference errors that are not known."""

REFERENCE_NUMBERS = len(astuple(NO_REFERENCE))
"""Length of ``Reference.to_numbers``."""


def reference_of_numbers(numbers: Iterable[float]) -> Reference:
    """Return the reference errors with the given ``Reference.to_numbers``."""
    return Reference(*[None if number == _UNDEFINED else number for number in numbers])


def view_reference(depth_m: Float32[ndarray, "h w"], pixels: UInt32[ndarray, " n"], median_m: float) -> Reference:
    """Return the reference errors of a view on its scored pixels, one or more.

    ``depth_m`` is the true planar depth of the view in metres, 0 where there is no surface; ``pixels`` are flat
    indices; ``median_m`` is the median depth of these pixels. Neighbours without depth or outside the image are
    skipped.
    """
    row, column = np.divmod(pixels.astype(np.intp), depth_m.shape[1])
    framed_m = np.pad(depth_m, 1)
    z_m = depth_m[row, column]
    shifted = [_errors(framed_m[row + v, column + u], z_m) for v, u in ((1, 0), (1, 2), (0, 1), (2, 1))]
    one_pixel = [_defined_mean(values) for values in zip(*shifted, strict=True)]
    return Reference(*constant_errors(z_m, median_m), *one_pixel)


def constant_errors(z_m: Float32[ndarray, " n"], median_m: float) -> tuple[float, float]:
    """Return AbsRel and RMSE (cm) of the depth ``median_m`` at pixels of the true depth ``z_m``."""
    metrics = depth_metrics(np.full(len(z_m), median_m), z_m)
    return metrics.abs_rel, metrics.rmse_cm


def mean_reference(views: Iterable[Reference]) -> Reference:
    """Return the means over views of the reference errors."""
    return Reference(*[_defined_mean(values) for values in zip(*map(astuple, views), strict=True)])


def _errors(p_m: ndarray, z_m: Float32[ndarray, " n"]) -> tuple[float | None, float | None]:
    """Return AbsRel and RMSE (cm) where ``p_m`` is above 0; None if it is nowhere."""
    has_depth = p_m > 0
    if not has_depth.any():
        return None, None
    metrics = depth_metrics(p_m[has_depth], z_m[has_depth])
    return metrics.abs_rel, metrics.rmse_cm


def _defined_mean(values: Iterable[float | None]) -> float | None:
    return mean([value for value in values if value is not None])
