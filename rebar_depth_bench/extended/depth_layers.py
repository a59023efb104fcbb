"""Depth layer confusion: steel pixels predicted closer to another layer than to their own.

Another layer of a pixel is visible steel near it in the image that is nearer or farther by more than the bar's
diameter. "Layer" refers to depth as the camera sees it, not to the reinforcement layers of a drawing: any steel
that much nearer or farther is one. These measures are defined by this project.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64, UInt16, UInt32
from numpy import ndarray

from rebar_depth_bench.extended.measures import Measure, Samples, share_sample
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.scoring.metrics import is_valid_prediction

DIRECTIONS = 16
"""Number of evenly spaced image directions in which other layers are searched."""

RADII_PX = (3, 6, 12, 24)
"""Distances in pixels at which other layers are searched, ascending, the same for every image size.

Networks and matching windows confuse surfaces that are pixels apart, whatever the distance in millimetres.
"""


def other_layers(
    depth_m: Float32[ndarray, "h w"],
    bars: UInt16[ndarray, "h w"],
    index: UInt32[ndarray, " n"],
    gap_m: Float32[ndarray, " n"],
) -> tuple[Float32[ndarray, " n"], Float32[ndarray, " n"]]:
    """Return ``front_m`` and ``behind_m``: planar depth of the closest other layers visible beside steel pixels.

    ``depth_m`` is true planar depth (metres, 0 where there is no surface), ``bars`` bar ids (0: no steel),
    ``index`` flat indices of steel pixels, ``gap_m`` the diameter of each pixel's bar. Neighbours are sampled at
    ``RADII_PX`` in ``DIRECTIONS`` directions. Steel farther than z + gap is behind and steel nearer than z - gap
    is in front; of several the one closest to z counts. NaN where there is no such steel.

    The same bar can be another layer (the far side of a hoop), but only where something farther than both pixels
    is visible between them, so that no straight bar connects them. A bar that runs away from the camera is
    therefore not its own other layer, even where another bar crosses in front of it.
    """
    margin = RADII_PX[-1]
    width = depth_m.shape[1] + 2 * margin
    padded_m, padded_bars = np.pad(depth_m, margin).ravel(), np.pad(bars, margin).ravel()
    row, column = np.divmod(index.astype(np.int64), depth_m.shape[1])
    centre = (row + margin) * width + column + margin
    z_m, own = padded_m[centre], padded_bars[centre]
    front_m, behind_m = np.full(len(index), -np.inf, np.float32), np.full(len(index), np.inf, np.float32)
    for angle in np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS):
        # The farthest surface so far in this direction that is not this bar.
        between_m = np.zeros(len(index), np.float32)
        for radius in RADII_PX:
            neighbour = centre + round(radius * np.sin(angle)) * width + round(radius * np.cos(angle))
            seen_m, seen_bars = padded_m[neighbour], padded_bars[neighbour]
            is_other = seen_bars != own
            is_layer = (seen_bars > 0) & (is_other | (between_m > np.maximum(z_m, seen_m)))
            np.fmin(behind_m, np.where(is_layer & (seen_m > z_m + gap_m), seen_m, np.inf), out=behind_m)
            np.fmax(front_m, np.where(is_layer & (seen_m < z_m - gap_m), seen_m, -np.inf), out=front_m)
            far_m = np.where(seen_m > 0, seen_m, np.inf)
            np.maximum(between_m, np.where(is_other, far_m, 0), out=between_m)
    front_m[np.isinf(front_m)], behind_m[np.isinf(behind_m)] = np.nan, np.nan
    return front_m, behind_m


def layer_samples(p_m: Float64[ndarray, " n"], truth: SteelTruth) -> Samples:
    """Return a view's layer samples; ``p_m`` is planar depth on ``truth.index``, metres, NaN where missing.

    Each sample has one value from 0 to 1 over interior pixels, or none where no pixel qualifies:

    - ``layer_swallowed``: share of the pixels with a layer behind in sight that have |p - behind| < |p - z|.
    - ``layer_pulled_forward``: share of the pixels with a layer in front in sight that have |p - front| < |p - z|.
    - ``layer_confusion``: share of the pixels with either layer in sight to which one of the two applies.
    - ``layers_in_sight``: share of all interior pixels with either layer; it depends on the ground truth alone.

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
