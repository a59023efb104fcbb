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

from rebar_depth_bench.scoring.columns import Size, rounded
from rebar_depth_bench.scoring.metrics import depth_metrics, mean

_UNDEFINED = -1.0
"""Number that stands for an undefined error in the cache, which stores finite numbers."""


@dataclass(frozen=True)
class Errors:
    """AbsRel and RMSE (cm) of a reference; None where undefined."""

    abs_rel: Size | None = None
    rmse_cm: Size | None = None


@dataclass(frozen=True)
class Reference:
    """Reference errors of a view, or their means over the views of a config.

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

    def to_numbers(self) -> tuple[float, ...]:
        """Return the errors that follow from the ground truth as numbers for the cache."""
        errors = (*astuple(self.constant), *astuple(self.one_pixel))
        return tuple(_UNDEFINED if value is None else value for value in errors)


NO_REFERENCE = Reference()
"""Reference errors that are not known."""

REFERENCE_NUMBERS = len(NO_REFERENCE.to_numbers())
"""Length of ``Reference.to_numbers``."""


def reference_of_numbers(numbers: Iterable[float]) -> Reference:
    """Return the reference errors with the given ``Reference.to_numbers``."""
    constant, constant_cm, shifted, shifted_cm = (None if one == _UNDEFINED else one for one in numbers)
    return Reference(Errors(constant, constant_cm), Errors(shifted, shifted_cm))


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
    return Reference(Errors(*constant_errors(z_m, median_m)), Errors(*one_pixel))


def constant_errors(z_m: Float32[ndarray, " n"], median_m: float) -> tuple[float, float]:
    """Return AbsRel and RMSE (cm) of the depth ``median_m`` at pixels of the true depth ``z_m``."""
    metrics = depth_metrics(np.full(len(z_m), median_m), z_m)
    return metrics.abs_rel, metrics.rmse_cm


def mean_reference(views: Iterable[Reference]) -> Reference:
    """Return the means over views of the reference errors."""
    numbers = zip(*map(Reference.to_numbers, views), strict=True)
    means = [mean([value for value in values if value != _UNDEFINED]) for values in numbers]
    return Reference(Errors(*means[:2]), Errors(*means[2:]))


def _errors(p_m: ndarray, z_m: Float32[ndarray, " n"]) -> tuple[float | None, float | None]:
    """Return AbsRel and RMSE (cm) where ``p_m`` is above 0; None if it is nowhere."""
    has_depth = p_m > 0
    if not has_depth.any():
        return None, None
    metrics = depth_metrics(p_m[has_depth], z_m[has_depth])
    return metrics.abs_rel, metrics.rmse_cm


def _defined_mean(values: Iterable[float | None]) -> float | None:
    return mean([value for value in values if value is not None])
