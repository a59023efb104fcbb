"""Confusion of layers: steel pixels predicted nearer to another layer than to their own.

Another layer of a pixel is steel in sight beside it, in the image, that is nearer or farther by more than the
bar's diameter. "Layer" is meant as the camera sees it, not as drawings name it: any steel so much nearer or
farther. The measures are this project's own.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt16, UInt32
from numpy import ndarray

from rebar_depth_bench.extended.measures import Measure, Samples
from rebar_depth_bench.extended.steel_truth import SteelTruth
from rebar_depth_bench.scoring.metrics import is_prediction

DIRECTIONS = 16
RADII_PX = (3, 6, 12, 24)
"""Where a pixel looks for other layers, ascending, whatever the picture's size: what a network or a matching
window mixes up lies pixels away, not millimetres."""


def other_layers(
    depth_m: Float32[ndarray, "h w"],
    bars: UInt16[ndarray, "h w"],
    index: UInt32[ndarray, " n"],
    gap_m: Float32[ndarray, " n"],
) -> tuple[Float32[ndarray, " n"], Float32[ndarray, " n"]]:
    """Return ``front_m`` and ``behind_m``: planar depth of the nearest other layers in sight beside steel pixels.

    ``depth_m`` is true planar depth (metres, 0 where there is no surface), ``bars`` bar ids (0: no steel),
    ``index`` flat indices of steel pixels, ``gap_m`` the diameter of each one's bar. Looking ``RADII_PX`` away in
    ``DIRECTIONS``, steel farther than z + gap is behind (of several the nearest to z counts), steel nearer than
    z - gap is in front; NaN where there is none.

    The same bar may be another layer (the far side of a hoop) but only where something farther than both pixels
    is in sight between them: no straight bar joins them then. So a bar that runs away from the camera is
    not its own other layer, not even where another bar crosses in front of it.
    """
    margin = RADII_PX[-1]
    width = depth_m.shape[1] + 2 * margin
    padded_m, padded_bars = np.pad(depth_m, margin).ravel(), np.pad(bars, margin).ravel()
    row, column = np.divmod(index.astype(np.int64), depth_m.shape[1])
    home = (row + margin) * width + column + margin
    z_m, own = padded_m[home], padded_bars[home]
    front_m, behind_m = np.full(len(index), -np.inf, np.float32), np.full(len(index), np.inf, np.float32)
    for angle in np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS):
        between_m = np.zeros(len(index), np.float32)  # the farthest yet seen that is not this bar
        for radius in RADII_PX:
            there = home + round(radius * np.sin(angle)) * width + round(radius * np.cos(angle))
            seen_m, seen_bars = padded_m[there], padded_bars[there]
            is_other = seen_bars != own
            is_layer = (seen_bars > 0) & (is_other | (between_m > np.maximum(z_m, seen_m)))
            np.fmin(behind_m, np.where(is_layer & (seen_m > z_m + gap_m), seen_m, np.inf), out=behind_m)
            np.fmax(front_m, np.where(is_layer & (seen_m < z_m - gap_m), seen_m, -np.inf), out=front_m)
            far_m = np.where(seen_m > 0, seen_m, np.inf)
            np.maximum(between_m, np.where(is_other, far_m, 0), out=between_m)
    return _nan_if_infinite(front_m), _nan_if_infinite(behind_m)


def layer_samples(p_m: Float64[ndarray, " n"], truth: SteelTruth) -> Samples:
    """Return a view's layer confusion; ``p_m`` is planar depth on ``truth.index``, metres, NaN for none.

    Over interior pixels, one value 0 to 1 each; none where the view has no pixel to take the share of:

    - ``layer_swallowed``: of the pixels with a layer behind in sight, those with |p - behind| < |p - z|.
    - ``layer_pulled_forward``: of those with a layer in front in sight, those with |p - front| < |p - z|.
    - ``layer_confusion``: of those with either, those that are one or the other.
    - ``layers_in_sight``: the share of interior pixels with either; it depends on the truth alone.

    A missing prediction counts as confused in each.
    """
    inside = truth.interior
    z_m, predicted_m = truth.depth_m[inside].astype(np.float64), p_m[inside]
    front_m, behind_m = truth.front_m[inside].astype(np.float64), truth.behind_m[inside].astype(np.float64)
    missing = ~is_prediction(predicted_m)
    has_front, has_behind = ~np.isnan(front_m), ~np.isnan(behind_m)
    # Against the midpoint: the two distances of a prediction far beyond both round to the same.
    swallowed = has_behind & (missing | (predicted_m > (z_m + behind_m) / 2))
    pulled = has_front & (missing | (predicted_m < (z_m + front_m) / 2))
    in_sight = has_front | has_behind
    return {
        "layer_confusion": _share(swallowed | pulled, in_sight),
        "layer_swallowed": _share(swallowed, has_behind),
        "layer_pulled_forward": _share(pulled, has_front),
        "layers_in_sight": _share(in_sight, np.ones_like(in_sight)),
    }


def _share(hit: Bool[ndarray, " n"], of: Bool[ndarray, " n"]) -> Float64[ndarray, " one"]:
    total = np.count_nonzero(of)
    return np.array([np.count_nonzero(hit) / total] if total else [], np.float64)


def _nan_if_infinite(values_m: Float32[ndarray, " n"]) -> Float32[ndarray, " n"]:
    return np.where(np.isinf(values_m), np.float32(np.nan), values_m)


MEASURES: tuple[Measure, ...] = (
    Measure(
        "layer_confusion",
        "layer_confusion",
        "mean",
        "Layer confusion",
        "%",
        "lower",
        "share of interior pixels with another layer in sight that are predicted nearer to it than to their own, "
        "|p - other| < |p - z|; missing predictions count as confused",
    ),
    Measure(
        "layer_swallowed",
        "layer_swallowed",
        "mean",
        "Swallowed by the layer behind",
        "%",
        "lower",
        "share of interior pixels with a layer behind in sight that are predicted nearer to it or missing",
    ),
    Measure(
        "layer_pulled_forward",
        "layer_pulled_forward",
        "mean",
        "Pulled to the layer in front",
        "%",
        "lower",
        "share of interior pixels with a layer in front in sight that are predicted nearer to it or missing",
    ),
    Measure(
        "layers_in_sight",
        "layers_in_sight",
        "mean",
        "Pixels with another layer in sight",
        "%",
        "",
        "share of interior pixels within 24 px of steel more than a diameter nearer or farther, by the truth",
    ),
)
