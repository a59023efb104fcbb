"""Numbers that papers on monocular depth print, beside those of the protocol.

p is the prediction and z the ground truth, metres. The errors are taken on the scored pixels that have a
prediction, as those of the protocol, and never rank.

Boundary F1 compares depth edges over the whole image, steel or not. An ordered pair of pixels (a, b) has an edge
at threshold t if the depth of b is more than t times that of a. Only pairs of which both have true depth count. A
missing prediction has no edge, so that a true edge there is missed, but a false one may be avoided: the numbers of
predictions with holes do not compare (``boundary`` has a variant that does). With counts of true, predicted and
correct edges

    P = correct / predicted,    R = correct / true,    F1 = 2 P R / (P + R), each 0 where undefined,

and F1 is averaged over ten t from 1.05 to 1.25, equally spaced. Both definitions follow the published code:

- Depth Pro (Bochkovskii et al., "Depth Pro: Sharp Monocular Metric Depth in Less Than a Second", arXiv:2410.02073,
  section 3.3; ``SI_boundary_F1`` in ml-depth-pro): a and b are neighbours; P and R are means over the four
  directions from a to b; the weight of t is t.
- MoGe (Wang et al., "MoGe-2: Accurate Monocular Geometry with Metric Scale and Sharp Details", arXiv:2507.02546;
  ``boundary_f1`` of its evaluation): b is within a disc of radius r pixels around a, which is r pixels or more
  from the image's border; counts are pooled; the weight of t is t - 1.

Depth ratios are invariant to scale, so that the native prediction is evaluated once. A view without true edges at
the lowest t has no F1.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from numpy import ndarray

from rebar_depth_bench.extended.measures import ONCE, Measure, MeasureFamily, Samples, finite_sample
from rebar_depth_bench.extended.steel import DepthSteps, SteelTruth
from rebar_depth_bench.scoring.metrics import is_valid_prediction

DELTA_RATIOS = {"inlier_1.03": 1.03, "delta2": 1.25**2, "delta3": 1.25**3}
"""Ratios that max(p/z, z/p) of a pixel has to be below, by measure."""

STEPS = np.linspace(1.05, 1.25, 10)
"""Thresholds t of an edge."""

RADII = (1, 2, 3)
_REACH = max(RADII)
_OFFSETS = sorted(
    (y * y + x * x, y, x)
    for y, x in product(range(-_REACH, _REACH + 1), repeat=2)
    if 0 < y * y + x * x <= _REACH * _REACH
)
"""Squared length and steps from a to b, down and to the right."""


def error_samples(p_m: Float64[ndarray, " n"], truth: SteelTruth) -> Samples:
    """Return a view's samples of ``log10`` and ``DELTA_RATIOS``, one value each, or none without a prediction.

    ``p_m`` is planar depth on ``truth.index``, metres, NaN where missing.
    """
    pixels = truth.interior & is_valid_prediction(p_m)
    p, z = p_m[pixels], truth.depth_m[pixels].astype(np.float64)
    if not len(p):
        return {}
    with np.errstate(over="ignore"):
        ratio = np.maximum(p / z, z / p)
    shares = {
        name: finite_sample(np.count_nonzero(ratio < limit) / len(z)) for name, limit in DELTA_RATIOS.items()
    }
    return {"log10": finite_sample(float(np.mean(np.abs(np.log10(p) - np.log10(z))))), **shares}


def depth_steps(depth_m: Float[ndarray, "h w"]) -> DepthSteps:
    """Return what the edges of a true depth, metres (0: none), need: its mask, and depth near all edges."""
    near_step = _near_step(depth_m)
    return DepthSteps(np.packbits(depth_m > 0), np.packbits(near_step), depth_m[near_step])


def _near_step(depth_m: Float[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Return the pixels with depth > 0 that may have an edge to another one: all that do, and some beside them."""
    has_depth = depth_m > 0
    with np.errstate(over="ignore", under="ignore"):
        nearest = _window(np.where(has_depth, depth_m, np.inf).astype(np.float32), np.minimum)
        farthest = _window(np.where(has_depth, depth_m, 0).astype(np.float32), np.maximum)
        # The factor allows for rounding to float32, which may also give 0 or infinity.
        return np.asarray(has_depth & ~(farthest < 0.9999 * STEPS[0] * nearest))


def _window(values: Float32[ndarray, "h w"], extreme: np.ufunc) -> Float32[ndarray, "h w"]:
    """Return the extreme of the square of 2 ``_REACH`` + 1 = 7 pixels around each pixel of an image."""
    for _ in range(2):
        padded = np.pad(values, ((_REACH, _REACH), (0, 0)), mode="edge")
        of_2 = extreme(padded[:-1], padded[1:])
        of_4 = extreme(of_2[:-2], of_2[2:])
        values = extreme(of_4[:-3], of_4[3:]).T
    return values


def image_boundary_samples(p_m: Float64[ndarray, "h w"], truth: SteelTruth) -> Samples:
    """Return a view's ``depth_pro_f1`` and ``moge_f1_<r>px``; ``p_m`` is planar depth, NaN where missing."""
    if truth.steps is None:
        return {}
    counts = edge_counts(p_m, truth.steps)
    names = {"depth_pro_f1": depth_pro_f1(counts), **{f"moge_f1_{r}px": moge_f1(counts, r) for r in RADII}}
    return {name: finite_sample(value) for name, value in names.items()}


def edge_counts(p_m: Float64[ndarray, "h w"], steps: DepthSteps) -> Int64[ndarray, "3 offsets margins t"]:
    """Count edges: true, predicted and correct ones, by ``_OFFSETS``, margin of a, and threshold.

    The margin is the distance of a from the image's border in pixels, at most ``_REACH``.
    """
    height, width = p_m.shape
    has_depth, near_step = (
        np.unpackbits(bits, count=p_m.size).astype(bool).reshape(height, width)
        for bits in (steps.has_depth, steps.near_step)
    )
    z_m = np.full(p_m.shape, np.nan)
    z_m[near_step] = steps.depth_m
    known_m = np.where(has_depth, p_m, np.nan)
    row, column = np.nonzero(near_step | _near_step(known_m))
    margin = np.minimum.reduce([row, column, height - 1 - row, width - 1 - column, np.full(len(row), _REACH)])
    # A border of NaN, which is part of no edge, so that b is always inside.
    flat = (row + _REACH) * (width + 2 * _REACH) + column + _REACH
    padded = [np.pad(depth_m, _REACH, constant_values=np.nan).ravel() for depth_m in (z_m, known_m)]
    at_a = [depth_m[flat] for depth_m in padded]
    shape = (len(RADII) + 1, len(STEPS) + 1)
    counts = np.zeros((3, len(_OFFSETS), *shape), np.int64)
    for index, (_, down, right) in enumerate(_OFFSETS):
        at_b = flat + down * (width + 2 * _REACH) + right
        with np.errstate(over="ignore"):
            true, predicted = (depth_m.take(at_b) / a_m for depth_m, a_m in zip(padded, at_a, strict=True))
        edges = np.flatnonzero((true > STEPS[0]) | (predicted > STEPS[0]))
        # Number of thresholds below the ratio; NaN is below all.
        levels = [
            np.searchsorted(STEPS, np.nan_to_num(ratio[edges], posinf=np.inf)) for ratio in (true, predicted)
        ]
        levels.append(np.minimum(*levels))
        for kind, level in enumerate(levels):
            counted = np.bincount(margin[edges] * shape[1] + level, minlength=counts[0, 0].size)
            counts[kind, index] = counted.reshape(shape)
    # Edges at a threshold have it below their ratio.
    return np.asarray(np.cumsum(counts[..., ::-1], axis=-1)[..., -2::-1])


def depth_pro_f1(counts: Int64[ndarray, "3 offsets margins t"]) -> float | None:
    """Return Depth Pro's boundary F1 from ``edge_counts``; None without true edges."""
    true, predicted, correct = counts[:, _within(1)].sum(axis=2)
    if not true.any():
        return None
    precision, recall = ((correct / np.maximum(edges, 1)).mean(axis=0) for edges in (predicted, true))
    return _mean_f1(precision, recall, STEPS)


def moge_f1(counts: Int64[ndarray, "3 offsets margins t"], radius_px: int) -> float | None:
    """Return MoGe's boundary F1 at a radius from ``edge_counts``; None without true edges."""
    true, predicted, correct = counts[:, _within(radius_px), radius_px:].sum(axis=(1, 2))
    if not true.any():
        return None
    return _mean_f1(correct / np.maximum(predicted, 1), correct / np.maximum(true, 1), STEPS - 1)


def _within(radius_px: int) -> slice:
    """Return the places of the offsets within a radius."""
    return slice(sum(squared <= radius_px**2 for squared, _, _ in _OFFSETS))


def _mean_f1(precision: ndarray, recall: ndarray, weights: ndarray) -> float:
    """Return the weighted mean over thresholds of F1."""
    total = precision + recall
    f1 = np.divide(2 * precision * recall, total, out=np.zeros_like(total), where=total > 0)
    return float(np.average(f1, weights=weights))


def _ratio_measure(name: str, title: str, limit: str, source: str) -> Measure:
    definition = f"share of scored pixels with a prediction that have max(p/z, z/p) < {limit} ({source})"
    return Measure(name, title, "%", "", definition)


ERROR_MEASURES = (
    Measure(
        "log10", "log10 error", "", "",
        "mean over scored pixels with a prediction of |log10 p - log10 z| (Saxena et al. 2009, Make3D)",
    ),
    _ratio_measure("inlier_1.03", "Inlier ratio, 1.03", "1.03", "Schröppel et al. 2022, Robust MVD"),
    _ratio_measure("delta2", "δ2", "1.25^2", "Eigen et al. 2014"),
    _ratio_measure("delta3", "δ3", "1.25^3", "Eigen et al. 2014"),
)  # fmt: skip
"""Errors in table order."""

_EDGES = (
    "F1 of the depth edges of the whole image at t = 1.05 to 1.25, 10 equally spaced; edge from a to b: depth of "
    "b > t times that of a, both with true depth; a missing prediction has no edge, a "
    "view without true edges no F1;"
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
            f"{_EDGES} b within {r} px of a, which is as far or farther from the border; F1 = "
            "2 correct / (predicted + true); mean over t weighted by t - 1 (Wang et al. 2025, MoGe-2)",
        )
        for r in RADII
    ),
)  # fmt: skip
"""Boundary measures in table order."""

FAMILIES = (
    MeasureFamily("published", "Errors as papers print them", 1, ERROR_MEASURES, error_samples),
    MeasureFamily(
        "published_boundary", "Boundary as papers print it", 4, BOUNDARY_MEASURES, image_boundary_samples, (ONCE,),
        "whole image, independent of scale", on_image=True,
    ),
)  # fmt: skip
