"""Depth layer confusion: steel pixels predicted closer to another layer than to their own.

Another layer of a pixel is visible steel near it in the image that is nearer or farther by more than the bar's
diameter. "Layer" refers to depth as the camera sees it, not to the reinforcement layers of a drawing: any steel
that much nearer or farther is one. These measures are defined by this project.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.extended.measures import Measure, MeasureFamily, Samples, share_sample
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.scoring.metrics import is_valid_prediction


def layer_samples(p_m: Float64[ndarray, " n"], truth: SteelTruth) -> Samples:
    """Return a view's layer samples; ``p_m`` is planar depth on ``truth.index``, metres, NaN where missing.

    Each sample has one value from 0 to 1 over interior pixels, or none where no pixel qualifies:

    - ``layer_swallowed``: of the pixels with a layer behind in sight, those with |p - behind| < |p - z|.
    - ``layer_pulled_forward``: of those with a layer in front in sight, those with |p - front| < |p - z|.
    - ``layer_confusion``: of those with either, those to which one of the two applies.
    - ``layers_in_sight``: the share of interior pixels with either; it depends on the ground truth alone.

    A missing prediction counts as confused in each.
    """
    inside = truth.interior
    z_m, predicted_m = truth.depth_m[inside].astype(np.float64), p_m[inside]
    front_m, behind_m = truth.front_m[inside].astype(np.float64), truth.behind_m[inside].astype(np.float64)
    missing = ~is_valid_prediction(predicted_m)
    has_front, has_behind = ~np.isnan(front_m), ~np.isnan(behind_m)
    # Comparing with the midpoint is exact: for a prediction far beyond both layers, the two distances would round
    # to the same float.
    swallowed = has_behind & (missing | (predicted_m > (z_m + behind_m) / 2))
    pulled = has_front & (missing | (predicted_m < (z_m + front_m) / 2))
    in_sight = has_front | has_behind
    count = np.count_nonzero
    return {
        "layer_confusion": share_sample(count(swallowed | pulled), count(in_sight)),
        "layer_swallowed": share_sample(count(swallowed), count(has_behind)),
        "layer_pulled_forward": share_sample(count(pulled), count(has_front)),
        "layers_in_sight": share_sample(count(in_sight), len(in_sight)),
    }


MEASURES = (
    Measure(
        "layer_confusion", "Layer confusion", "%", "lower",
        "share of interior pixels with another layer in sight that are predicted nearer to it than to their own, "
        "|p - other| < |p - z|; missing predictions count as confused",
    ),
    Measure(
        "layer_swallowed", "Swallowed by the layer behind", "%", "lower",
        "share of interior pixels with a layer behind in sight that are predicted nearer to it or missing",
    ),
    Measure(
        "layer_pulled_forward", "Pulled to the layer in front", "%", "lower",
        "share of interior pixels with a layer in front in sight that are predicted nearer to it or missing",
    ),
    Measure(
        "layers_in_sight", "Pixels with another layer in sight", "%", "",
        "share of interior pixels within 24 px of steel more than a diameter nearer or farther, by the truth",
    ),
)  # fmt: skip
"""Layer measures in table order."""

FAMILIES = (MeasureFamily("layers", "Layers", 5, MEASURES, layer_samples),)
