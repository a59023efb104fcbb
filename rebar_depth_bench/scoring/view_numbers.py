"""Numbers of one view by protocol: a prediction is compared with the true depth of the scored pixels.

``view_numbers`` is the whole computation of a view. Its numbers are a mapping of places in the JSON to floats; a
number that is undefined is missing, or NaN.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, UInt32
from numpy import ndarray

from rebar_depth_bench.scoring.metrics import (
    is_valid_prediction,
    median,
    median_scale,
    metrics_at_scales,
    rank_error,
)
from rebar_depth_bench.scoring.protocol import WITHIN_MM
from rebar_depth_bench.scoring.reference import constant_errors
from rebar_depth_bench.scoring.relative import aligned_numbers, metric_as
from rebar_depth_bench.submission.declaration import METRIC


@dataclass(frozen=True, eq=False)
class ViewTruth:
    """Scored pixels of one view.

    ``index`` holds flat indices into the H x W image, ``depth_m`` their planar depth and ``median_m`` its median,
    in metres. ``constant`` has ``reference.constant_errors``, if they are known.
    """

    view_id: str
    index: UInt32[ndarray, " n"]
    depth_m: Float32[ndarray, " n"]
    median_m: float
    constant: tuple[float, float] | None = None


def view_numbers(
    prediction: Float[ndarray, "h w"], truth: ViewTruth, kind: str = METRIC, declared_kind: str = METRIC
) -> dict[str, float]:
    """Return the numbers of a view by their places in the JSON.

    ``prediction``, of the kind ``declared_kind``, is scored as ``kind``; metric ones are planar depth in metres.
    """
    if kind != declared_kind:
        prediction = metric_as(prediction, kind)
    p_m = prediction.ravel().take(truth.index.astype(np.intp))
    if kind != METRIC:
        return aligned_numbers(p_m, truth.depth_m, kind)
    z_m, z_median_m, constant = truth.depth_m, truth.median_m, truth.constant
    scored_px = len(z_m)
    valid = is_valid_prediction(p_m)
    numbers = {
        "scored_px": scored_px,
        "coverage": np.count_nonzero(valid) / scored_px,
        "rank_error": rank_error(p_m, z_m, valid),
        **{f"within_mm.{tolerance_mm}": 0.0 for tolerance_mm in WITHIN_MM},
    }
    if not valid.any():
        return numbers
    if not valid.all():
        p_m, z_m, constant = p_m[valid], z_m[valid], None
        z_median_m = median(z_m)
    scale = median_scale(p_m, z_median_m)
    (native, scaled), within = metrics_at_scales(p_m, z_m, (1.0, scale), WITHIN_MM)
    abs_rel, rmse_cm = constant or constant_errors(z_m, z_median_m)
    return numbers | {
        "scale": scale,
        **{f"native.{name}": value for name, value in vars(native).items()},
        **{f"scaled.{name}": value for name, value in vars(scaled).items()},
        **{f"within_mm.{tolerance_mm}": count / scored_px for tolerance_mm, count in within.items()},
        "reference.scaled_constant.abs_rel": abs_rel,
        "reference.scaled_constant.rmse_cm": rmse_cm,
    }
