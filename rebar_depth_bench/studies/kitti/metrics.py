"""KITTI depth metrics and crops of Eigen et al.

Source: "Depth Map Prediction from a Single Image", NeurIPS 2014, as used by public evaluators since.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64
from numpy import ndarray

from rebar_depth_bench.scoring.metrics import is_valid_prediction, median_scale
from rebar_depth_bench.scoring.protocol import DELTA1_RATIO

MIN_DEPTH_M = 1e-3
"""Lower bound of scored ground truth (exclusive) and of clamped predictions, metres."""


@dataclass(frozen=True)
class Crop:
    """Crop of an image: (start, stop) of its rows and columns, as fractions of height and width."""

    rows: tuple[float, float]
    columns: tuple[float, float]


CROPS: Mapping[str, Crop] = {
    "garg": Crop((0.40810811, 0.99189189), (0.03594771, 0.96405229)),
    "eigen": Crop((0.3324324, 0.91351351), (0.03594771, 0.96405229)),
    "none": Crop((0.0, 1.0), (0.0, 1.0)),
}
"""Crops of Garg et al., ECCV 2016, and Eigen et al., NeurIPS 2014; pixel bounds are truncated to integers."""


@dataclass(frozen=True)
class KittiMetrics:
    """Errors of one image, or their means over images.

    With predicted depth p and true depth z in metres on the scored pixels: ``abs_rel`` = mean(|p - z| / z);
    ``rmse_m`` = sqrt(mean((p - z)^2)); ``log_rmse`` = sqrt(mean((ln p - ln z)^2)); ``delta1`` to ``delta3`` =
    fraction of pixels with max(p/z, z/p) below 1.25, 1.25^2 and 1.25^3.
    """

    abs_rel: float
    rmse_m: float
    log_rmse: float
    delta1: float
    delta2: float
    delta3: float


METRIC_NAMES = tuple(field.name for field in fields(KittiMetrics))


@dataclass(frozen=True)
class ImageScore:
    """Score of one image.

    ``coverage`` is the fraction of the ``scored_px`` pixels with a valid prediction; ``scale`` is
    s = median(z) / median(p). ``scale``, ``native`` and ``scaled`` are None if no scored pixel has a prediction.
    """

    name: str
    scored_px: int
    coverage: float
    scale: float | None
    native: KittiMetrics | None
    scaled: KittiMetrics | None


def crop_mask(shape: tuple[int, int], crop: Crop) -> Bool[ndarray, "h w"]:
    """Return the mask of the pixels of an (H, W) image that lie inside a crop."""
    height, width = shape
    top, bottom = (int(fraction * height) for fraction in crop.rows)
    left, right = (int(fraction * width) for fraction in crop.columns)
    mask = np.zeros(shape, dtype=bool)
    mask[top:bottom, left:right] = True
    return mask


def scored_mask(depth_m: Float32[ndarray, "h w"], crop: Crop, cap_m: float) -> Bool[ndarray, "h w"]:
    """Return the mask of scored pixels: inside the crop, with ground truth above 1 mm and below the cap."""
    return np.asarray(
        crop_mask((depth_m.shape[0], depth_m.shape[1]), crop) & (depth_m > MIN_DEPTH_M) & (depth_m < cap_m)
    )


def score_image(
    name: str, depth_m: Float32[ndarray, "h w"], prediction_m: Float[ndarray, "h w"], crop: Crop, cap_m: float
) -> ImageScore | None:
    """Score a prediction on the scored pixels of an image; return None if there are none.

    The scale s = median(z) / median(p) is computed from the unclamped prediction. Predictions are clamped to
    [1 mm, cap] after the alignment, as in public evaluators. Values that are not finite or <= 0 are missing
    predictions: they are not clamped, and they lower the coverage.
    """
    mask = scored_mask(depth_m, crop, cap_m)
    scored_px = int(np.count_nonzero(mask))
    if not scored_px:
        return None
    predicted_m = prediction_m[mask]
    valid = is_valid_prediction(predicted_m)
    p_m, z_m = predicted_m[valid].astype(np.float64), depth_m[mask][valid].astype(np.float64)
    coverage = len(p_m) / scored_px
    if not len(p_m):
        return ImageScore(name, scored_px, coverage, None, None, None)
    scale = median_scale(p_m, float(np.median(z_m)))
    with np.errstate(over="ignore", under="ignore"):
        scaled_m = scale * p_m
    return ImageScore(
        name, scored_px, coverage, scale, kitti_metrics(p_m, z_m, cap_m), kitti_metrics(scaled_m, z_m, cap_m)
    )


def kitti_metrics(p_m: Float64[ndarray, " n"], z_m: Float64[ndarray, " n"], cap_m: float) -> KittiMetrics:
    """Return the errors of one or more pixels, with the prediction clamped to [1 mm, cap]."""
    clamped_m = np.clip(p_m, MIN_DEPTH_M, cap_m)
    ratio = np.maximum(clamped_m / z_m, z_m / clamped_m)
    error_m = clamped_m - z_m
    deltas = [float(np.mean(ratio < DELTA1_RATIO**power)) for power in (1, 2, 3)]
    return KittiMetrics(
        float(np.mean(np.abs(error_m) / z_m)),
        float(np.sqrt(np.mean(error_m**2))),
        float(np.sqrt(np.mean(np.log(clamped_m / z_m) ** 2))),
        *deltas,
    )
