"""Numbers that papers on monocular depth print and the protocol lacks. None of them ranks.

p is the prediction and z the ground truth, metres. The measures' definitions state the equations. Boundary F1 is
``SI_boundary_F1`` of ml-depth-pro (Bochkovskii et al., "Depth Pro: Sharp Monocular Metric Depth in Less Than a
Second", arXiv:2410.02073) and ``boundary_f1`` of MoGe's evaluation (Wang et al., "MoGe-2: Accurate Monocular
Geometry with Metric Scale and Sharp Details", arXiv:2507.02546), given NaN for missing predictions, and for both
depths where there is no true one. Without true edges they return 0; here, there is no number.

A missing prediction misses true edges and avoids false ones, so that predictions with holes do not compare:
``boundary`` has a variant that does.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from numpy import ndarray

from rebar_depth_bench.extended.measures import Measure, Samples, finite_sample, share_sample
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.scoring.metrics import is_valid_prediction

RATIOS = {"inlier_1.03": 1.03, "delta2": 1.25**2, "delta3": 1.25**3}
"""Limits of max(p/z, z/p), by measure."""

STEPS = np.linspace(1.05, 1.25, 10)
"""Thresholds t of an edge."""

RADII = (1, 2, 3)
_REACH = max(RADII)
_AROUND = product(range(-_REACH, _REACH + 1), repeat=2)
_OFFSETS = sorted((y * y + x * x, y, x) for y, x in _AROUND if 0 < y * y + x * x <= _REACH**2)
"""Squared length and steps from a to b, down and to the right; the first four lead to the neighbours."""


def error_samples(p_m: Float64[ndarray, " n"], truth: SteelTruth) -> Samples:
    """Return a view's samples of ``log10`` and ``RATIOS``, one value each, or none without a prediction.

    ``p_m`` is planar depth on ``truth.index``, metres, NaN where missing.
    """
    pixels = truth.interior & is_valid_prediction(p_m)
    p, z = p_m[pixels], truth.depth_m[pixels].astype(np.float64)
    with np.errstate(over="ignore"):
        ratio = np.maximum(p / z, z / p)
    shares = {name: share_sample(np.count_nonzero(ratio < limit), len(z)) for name, limit in RATIOS.items()}
    log10 = float(np.mean(np.abs(np.log10(p) - np.log10(z)))) if len(z) else None
    return {"log10": finite_sample(log10), **shares}


def depth_steps(depth_m: Float32[ndarray, "h w"]) -> Mapping[str, ndarray]:
    """Return what edges of a true depth, metres (0: none), need, by the names of ``SteelTruth``."""
    near_step = _near_step(depth_m)
    masks = {"has_depth": np.packbits(depth_m > 0), "near_step": np.packbits(near_step)}
    return {**masks, "step_depth_m": depth_m[near_step]}


def _near_step(depth_m: Float[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Return the pixels with depth > 0 that may have an edge to another one: all that do, and some beside them."""
    from scipy.ndimage import maximum_filter, minimum_filter  # Half a second to import.

    has_depth = depth_m > 0
    with np.errstate(over="ignore", under="ignore"):
        nearest_m = minimum_filter(np.where(has_depth, depth_m, np.inf).astype(np.float32), 2 * _REACH + 1)
        farthest_m = maximum_filter(np.where(has_depth, depth_m, 0).astype(np.float32), 2 * _REACH + 1)
        # The factor allows for rounding to float32, which may also give 0 or infinity.
        return np.asarray(has_depth & ~(farthest_m < 0.9999 * STEPS[0] * nearest_m))


def image_boundary_samples(p_m: Float[ndarray, "h w"], truth: SteelTruth) -> Samples:
    """Return a view's boundary samples; ``p_m`` is the prediction as submitted, planar depth in metres."""
    counts = edge_counts(p_m, truth)
    samples = {"depth_pro_f1": _mean_f1(counts[:, :4].sum(axis=2), STEPS)}
    for r in RADII:
        within = sum(squared <= r * r for squared, _, _ in _OFFSETS)
        samples[f"moge_f1_{r}px"] = _mean_f1(counts[:, :within, r:].sum(axis=(1, 2))[:, None], STEPS - 1)
    return samples


def edge_counts(p_m: Float[ndarray, "h w"], truth: SteelTruth) -> Int64[ndarray, "3 offsets margins t"]:
    """Count true, predicted and correct edges of ``image_boundary_samples``.

    Axes: kind of edge, ``_OFFSETS``, distance of a from the border in pixels (at most ``_REACH``), and threshold.
    """
    (height, width), pitch = p_m.shape, p_m.shape[1] + 2 * _REACH
    has_depth, near_step = (
        np.unpackbits(bits, count=p_m.size).astype(bool).reshape(height, width)
        for bits in (truth.has_depth, truth.near_step)
    )
    known_m = np.where(has_depth & is_valid_prediction(p_m), p_m.astype(np.float64), np.nan)
    z_m = np.full(p_m.shape, np.nan)
    z_m[near_step] = truth.step_depth_m
    row, column = np.nonzero(near_step | _near_step(known_m))
    margin = np.minimum(np.minimum(row, height - 1 - row), np.minimum(column, width - 1 - column)).clip(max=_REACH)
    # A border of NaN, which has no edge, so that b is always inside.
    padded = [np.pad(depth_m, _REACH, constant_values=np.nan).ravel() for depth_m in (z_m, known_m)]
    a = (row + _REACH) * pitch + column + _REACH
    at_a = [depth_m[a] for depth_m in padded]
    counts = np.zeros((3, len(_OFFSETS), _REACH + 1, len(STEPS) + 1), np.int64)
    for index, (_, down, right) in enumerate(_OFFSETS):
        with np.errstate(over="ignore"):
            true, predicted = (
                depth_m.take(a + down * pitch + right) / a_m for depth_m, a_m in zip(padded, at_a, strict=True)
            )
        edges = np.flatnonzero((true > STEPS[0]) | (predicted > STEPS[0]))
        # Number of thresholds below each ratio; NaN is above none.
        levels = [np.searchsorted(STEPS, np.fmax(ratio[edges], 0)) for ratio in (true, predicted)]
        for kind, level in enumerate((*levels, np.minimum(*levels))):
            cells = np.bincount(margin[edges] * (len(STEPS) + 1) + level, minlength=counts[kind, index].size)
            counts[kind, index] = cells.reshape(counts[kind, index].shape)
    return np.asarray(np.cumsum(counts[..., ::-1], axis=-1)[..., -2::-1])


def _mean_f1(
    counts: Int64[ndarray, "3 directions t"], weights: Float64[ndarray, " t"]
) -> Float64[ndarray, " one"]:
    """Return F1 of true, predicted and correct edges, averaged over t; no value without true edges."""
    true, predicted, correct = counts
    precision, recall = ((correct / np.maximum(edges, 1)).mean(axis=0) for edges in (predicted, true))
    total = precision + recall
    f1 = np.divide(2 * precision * recall, total, out=np.zeros_like(total), where=total > 0)
    return finite_sample(float(np.average(f1, weights=weights)) if true.any() else None)


_PREDICTED = "scored pixels with a prediction"
_RATIO = f"share of {_PREDICTED} that have max(p/z, z/p) <"
ERROR_MEASURES = (
    Measure("log10", "log10 error", "", "", f"mean of |log10 p - log10 z| over {_PREDICTED} (Saxena et al. 2009)"),
    Measure("inlier_1.03", "Inlier ratio, 1.03", "%", "", f"{_RATIO} 1.03 (Schröppel et al. 2022, Robust MVD)"),
    Measure("delta2", "δ2", "%", "", f"{_RATIO} 1.25^2 (Eigen et al. 2014)"),
    Measure("delta3", "δ3", "%", "", f"{_RATIO} 1.25^3 (Eigen et al. 2014)"),
)
_EDGES = (
    "F1 of the depth edges of the whole image at ten evenly spaced t, 1.05 to 1.25; edge from a to b: depth of b "
    "> t times that of a, both with true depth; a missing prediction has no edge, a view without true edges no F1;"
)
BOUNDARY_MEASURES = (
    Measure(
        "depth_pro_f1", "Boundary F1 of Depth Pro", "%", "",
        f"{_EDGES} a, b: neighbours; F1 = 2 P R / (P + R), P = correct / predicted and R = correct / true, each "
        "averaged over the four directions; mean over t weighted by t (Bochkovskii et al. 2024, section 3.3)",
    ),
    *(
        Measure(
            f"moge_f1_{r}px", f"Boundary F1 of MoGe, radius {r} px", "%", "",
            f"{_EDGES} b within {r} px of a, which is as far or farther from the border; F1 = 2 correct / "
            "(predicted + true); mean over t weighted by t - 1 (Wang et al. 2025, MoGe-2)",
        )
        for r in RADII
    ),
)  # fmt: skip
