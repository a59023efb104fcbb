"""Predictions of a view on the pixels of ``SteelTruth``, under each alignment."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64
from numpy import ndarray

from rebar_depth_bench.extended.steel_truth import SteelTruth
from rebar_depth_bench.scoring.metrics import is_valid_prediction

ONCE, NATIVE, SCALED = "once", "native", "scaled"
"""Alignments of a prediction (keys of the result's JSON).

``ONCE``: measures that are invariant to scale or apply their own alignment, computed from the native prediction.
``NATIVE``: the prediction as submitted. ``SCALED``: the prediction times the median scale s.
"""


def aligned_predictions(
    prediction_m: Float[ndarray, "h w"], truth: SteelTruth, scale: float | None
) -> dict[str, Float64[ndarray, " n"]]:
    """Return the prediction under each alignment, metres on ``truth.index``, NaN where missing.

    ``scale`` is the view's median scale s, None if it has none.
    """
    predicted_m = prediction_m.ravel().take(truth.index.astype(np.intp))
    native_m = np.where(is_valid_prediction(predicted_m), predicted_m.astype(np.float64), np.nan)
    with np.errstate(over="ignore"):
        scaled_m = native_m * (np.nan if scale is None else scale)
    scaled_m[~is_valid_prediction(scaled_m)] = np.nan
    return {ONCE: native_m, NATIVE: native_m, SCALED: scaled_m}
