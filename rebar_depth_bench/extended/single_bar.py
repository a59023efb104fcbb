"""Single-bar interior: the protocol's metrics on pixels whose neighbours belong to the same bar.

The interior erodes the union of all bars, so that an interior pixel of a dense cage can have another bar beside
it, at another depth. On these pixels, a prediction that is exact but shifted by one pixel has a large error. The
single-bar interior has no such pixels: where a method's error on it is as large as on the whole interior,
neighbouring bars do not explain the error. The pixels are chosen by the ground truth alone
(``protocol.single_bar_pixels``); the scaled evaluation uses the scale of all scored pixels.

As in the protocol, the errors are means over the pixels that have a prediction, so missing predictions can lower
them, and they have no better direction. Coverage is taken over ALL pixels.
"""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.extended.measures import Measure, Samples, share_sample
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.scoring.columns import METRICS
from rebar_depth_bench.scoring.metrics import depth_metrics, is_valid_prediction
from rebar_depth_bench.scoring.protocol import PROTOCOL


def single_bar_samples(p_m: Float64[ndarray, " n"], truth: SteelTruth) -> Samples:
    """Return a view's samples; ``p_m`` is planar depth on ``truth.index``, metres, NaN where missing.

    Each measure has one value: the share of the scored pixels, coverage where the view has a single-bar pixel, and
    errors where it has one with a prediction.
    """
    valid, z_m = is_valid_prediction(p_m), truth.depth_m.astype(np.float64)
    count, predicted = np.count_nonzero(truth.single_bar), truth.single_bar & valid
    samples = {
        "single_bar_share": share_sample(count, np.count_nonzero(truth.interior)),
        "single_bar_coverage": share_sample(np.count_nonzero(predicted), count),
    }
    if predicted.any():
        scored = truth.interior & valid
        errors = asdict(depth_metrics(p_m[predicted], z_m[predicted]))
        samples |= {f"single_bar_{name}": np.array([value]) for name, value in errors.items()}
        samples["single_bar_views_abs_rel"] = np.array([depth_metrics(p_m[scored], z_m[scored]).abs_rel])
    return samples


MEASURES = (
    Measure(
        "single_bar_share", "Single-bar share of the interior", "%", "",
        "interior pixels whose 3 x 3 neighbourhood belongs to one bar / interior pixels, by the truth; the other "
        "pixels have a second bar within one pixel, so that errors on them contain the step between the bars",
    ),
    *(
        Measure(
            f"single_bar_{name}", f"{info.title}, single-bar", info.unit, "",
            f"{name} as {PROTOCOL} defines it, over the predicted interior pixels whose 3 x 3 neighbourhood "
            "belongs to one bar",
        )
        for name, info in METRICS.items()
    ),
    Measure(
        "single_bar_coverage", "Coverage, single-bar", "%", "higher",
        "share with a prediction (finite and > 0) of interior pixels whose 3 x 3 neighbourhood belongs to one bar",
    ),
    Measure(
        "single_bar_views_abs_rel", "AbsRel, whole interior of the same views", "", "",
        "mean AbsRel over all interior pixels of the views that have single_bar_abs_rel, to set beside it",
    ),
)  # fmt: skip
"""Single-bar measures in table order."""
