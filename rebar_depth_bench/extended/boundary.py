"""Boundary F1 at the steel: precision and recall of the occluding contours of bars.

The variant implemented here is "pooled at steel". It uses pairs of horizontal and vertical neighbour pixels of
which at least one is steel and both have true depth. A pair has a contour at threshold t where max/min of its two
depths is > 1 + t (the boundary metric of Bochkovskii et al., "Depth Pro: Sharp Monocular Metric Depth in Less Than
a Second", arXiv:2410.02073). A predicted contour is correct where the ground truth has one with the same side in
front. Counts are pooled over directions, then per t

    precision = correct / predicted,    recall = correct / true,    F1 = 2 correct / (predicted + true),

and each is averaged, unweighted, over those t at which the view has a true contour. Differences from Depth Pro and
MoGe, whose boundary F1 ``published`` has:

- Here t is 1, 2, 5, 10, 20 %, all of equal weight: a 20 mm gap is 7 % at 0.3 m, while at 12 m bars one behind the
  other are 1-3 % apart.
- In both of them a missing prediction can remove false contours. Here a pair with a missing prediction counts as
  predicted and incorrect at every t. This is the only rule under which no missing prediction can raise precision,
  recall or F1, because the depth that it replaces is unknown. ``boundary_missing`` is the share of such pairs.

An edge between steel and background without true depth (sky) forms no pair. Depth ratios are invariant to scale,
so a scaled prediction has the same numbers: evaluate the native prediction once.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt32
from numpy import ndarray

from rebar_depth_bench.extended.measures import Measure, Samples, share_sample
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.scoring.metrics import is_valid_prediction

THRESHOLDS_PERCENT = (1, 2, 5, 10, 20)
"""Relative depth steps t of a contour, ascending, in percent."""


def boundary_samples(p_m: Float64[ndarray, " n"], truth: SteelTruth) -> Samples:
    """Return a view's boundary samples; ``p_m`` is planar depth on ``truth.index``, metres, NaN where missing.

    Each of ``boundary_f1``, ``boundary_precision``, ``boundary_recall`` (means over the t that have a true
    contour) and ``boundary_missing`` (share of pairs with a missing prediction) has one value from 0 to 1. There
    is none where the view has no true contour (for ``boundary_missing``: no pair).
    """
    first, second = neighbour_pairs(truth.index, truth.bar_id > 0, truth.height, truth.width)
    missing, true, predicted, correct = contour_counts(p_m, truth.depth_m.astype(np.float64), first, second)
    has_contour = true > 0
    shares = {
        "f1": (2.0 * correct / np.maximum(predicted + true, 1))[has_contour],
        "precision": (correct / np.maximum(predicted, 1))[has_contour],  # 0 for nothing predicted
        "recall": (correct / np.maximum(true, 1))[has_contour],
    }
    return {
        **{f"boundary_{name}": values.mean(keepdims=True) for name, values in shares.items() if len(values)},
        "boundary_missing": share_sample(missing, len(first)),
    }


def neighbour_pairs(
    index: UInt32[ndarray, " n"], on_steel: Bool[ndarray, " n"], height: int, width: int
) -> tuple[Int64[ndarray, " m"], Int64[ndarray, " m"]]:
    """Return the pairs of horizontally or vertically adjacent pixels of which at least one is steel.

    ``index`` holds flat indices into the height x width grid, ascending. The pairs are positions in ``index``,
    the left or upper pixel first. The last pixel of a row and the first of the next row are not adjacent.
    """
    left = np.flatnonzero((np.diff(index) == 1) & (index[:-1] % width != width - 1))
    # 1 + position in index, 0: not in it; one empty row below the frame.
    position = np.zeros((height + 1) * width, np.int32)
    position[index] = np.arange(1, len(index) + 1, dtype=np.int32)
    position_below = position[index + np.uint32(width)]
    upper = np.flatnonzero(position_below)
    first = np.concatenate([left, upper])
    second = np.concatenate([left + 1, position_below[upper] - np.int64(1)])
    at_steel = on_steel[first] | on_steel[second]
    return first[at_steel], second[at_steel]


def contour_counts(
    p_m: Float64[ndarray, " n"],
    z_m: Float64[ndarray, " n"],
    first: Int64[ndarray, " m"],
    second: Int64[ndarray, " m"],
) -> tuple[int, Int64[ndarray, " t"], Int64[ndarray, " t"], Int64[ndarray, " t"]]:
    """Count contours among pairs of positions in ``p_m`` (prediction) and ``z_m`` (true, > 0), both metres.

    Returned are the number of pairs with a missing prediction and three counts per threshold: contours of the
    ground truth, contours of the prediction plus the missing pairs, and contours of both with the same side in
    front.
    """
    valid = is_valid_prediction(p_m)
    both_valid = valid[first] & valid[second]
    missing = len(both_valid) - int(np.count_nonzero(both_valid))
    z_step, z_second_nearer = _depth_step(z_m[first], z_m[second])
    p_valid_m = np.where(valid, p_m, np.nan)
    p_step, p_second_nearer = _depth_step(p_valid_m[first], p_valid_m[second])
    # Most pairs lie on one surface: skip them early.
    lowest = 1.0 + THRESHOLDS_PERCENT[0] / 100
    candidates = np.flatnonzero((z_step > lowest) | (p_step > lowest))
    z_step, p_step = z_step[candidates], p_step[candidates]
    same_side = z_second_nearer[candidates] == p_second_nearer[candidates]
    steps = 1.0 + np.array(THRESHOLDS_PERCENT)[:, None] / 100
    z_contour, p_contour = z_step > steps, p_step > steps
    true, predicted, correct = (
        np.count_nonzero(contour, axis=1) for contour in (z_contour, p_contour, z_contour & p_contour & same_side)
    )
    return missing, true, predicted + missing, correct


def _depth_step(
    first_m: Float64[ndarray, " m"], second_m: Float64[ndarray, " m"]
) -> tuple[Float64[ndarray, " m"], Bool[ndarray, " m"]]:
    """Return max/min of each pair (NaN, so no contour, where one is missing) and whether the second is nearer."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.maximum(first_m, second_m) / np.minimum(first_m, second_m), second_m < first_m


_PAIRS = "neighbour pixel pairs at the steel, pooled over directions; contour: max/min > 1 + t, same side in front"
_MISSING = "a pair with a missing prediction counts as a wrong contour"
_MEAN = f"mean over t = {', '.join(map(str, THRESHOLDS_PERCENT))} % ({_PAIRS}; {_MISSING})"

MEASURES = (
    Measure("boundary_f1", "Boundary F1", "%", "higher", f"2 right / (predicted + true), {_MEAN}"),
    Measure("boundary_precision", "Boundary precision", "%", "higher", f"right / predicted contours, {_MEAN}"),
    Measure("boundary_recall", "Boundary recall", "%", "higher", f"right / true contours, {_MEAN}"),
    Measure(
        "boundary_missing", "Pairs without prediction", "%", "lower",
        "share of neighbour pixel pairs at the steel of which a prediction is missing",
    ),
)  # fmt: skip
"""Boundary measures in table order."""
