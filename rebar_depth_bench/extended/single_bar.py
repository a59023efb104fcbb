"""Single-bar measures: the protocol's metrics on interior pixels whose 3 x 3 neighbourhood belongs to one bar.

The interior of the protocol erodes the union of all bars, so that an interior pixel of a dense cage can have
another bar beside it, at another depth. On these pixels, a prediction that is exact but shifted by one pixel has
a large error. The single-bar interior has no such pixels: where a method's error on it is as large as on the
whole interior, neighbouring bars do not explain the error. The pixels are chosen by the ground truth alone
(``protocol.single_bar_pixels``); the scale of the scaled evaluation is that of all scored pixels.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.extended.full_mask import REGION_NUMBERS, Region, region_measure, region_scores
from rebar_depth_bench.extended.measures import Measure, Samples
from rebar_depth_bench.extended.steel_truth import SteelTruth

_VIEWS_ABS_REL = "single_bar_views_abs_rel"
_REGION = Region("single_bar", "single-bar", "interior pixels whose 3 x 3 neighbourhood belongs to one bar")


def single_bar_samples(p_m: Float64[ndarray, " n"], truth: SteelTruth) -> Samples:
    """Return a view's share of single-bar pixels and its metrics on them, as ``full_mask_samples`` does.

    ``p_m`` is planar depth on ``truth.index``, metres, NaN where missing. Metrics are empty where the view has no
    such pixel. ``single_bar_views_abs_rel`` is AbsRel on the whole interior of a view that has AbsRel on them.
    """
    count, interior_count = np.count_nonzero(truth.single_bar), np.count_nonzero(truth.interior)
    share = [count / interior_count] if interior_count else []
    scores = region_scores(_REGION.prefix, p_m, truth, truth.single_bar)
    interior = region_scores("interior", p_m, truth, truth.interior)["interior_abs_rel"]
    return {
        "single_bar_share": np.array(share, np.float64),
        **scores,
        _VIEWS_ABS_REL: interior if len(scores["single_bar_abs_rel"]) else np.empty(0),
    }


MEASURES: tuple[Measure, ...] = (
    Measure(
        "single_bar_share",
        "single_bar_share",
        "mean",
        "Single-bar share of the interior",
        "%",
        "",
        "interior pixels whose 3 x 3 neighbourhood belongs to one bar / interior pixels, by the truth; the other "
        "pixels have a second bar within one pixel, so that errors on them contain the step between the bars",
    ),
    *(region_measure(_REGION, number) for number in REGION_NUMBERS),
    Measure(
        _VIEWS_ABS_REL,
        _VIEWS_ABS_REL,
        "mean",
        "AbsRel, whole interior of the same views",
        "",
        "",
        "mean of interior_abs_rel over the views that have single_bar_abs_rel, to set beside it",
    ),
)
"""Single-bar measures in table order."""
