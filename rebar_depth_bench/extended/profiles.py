"""Error profiles: scale and AbsRel binned by true distance and by the apparent width of the bar.

The bins of true distance also have the share of the single-bar interior and AbsRel on it (``single_bar``).
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from rebar_depth_bench.extended.measures import Measure, Samples, finite_sample, subsample
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.scoring.metrics import is_valid_prediction, median

DISTANCE_EDGES_M = (0.2, 0.25, 0.3, 0.4, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0, 14.0, 20.0)
"""Bin edges of true distance (planar depth), metres."""

WIDTH_EDGES_PX = (2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0, 48.0)
"""Bin edges of apparent bar width, pixels."""


MAX_PIXELS = 16_000
"""Interior pixels per view after subsampling; the bins do not need more."""

MIN_PIXELS = 50
"""Minimum number of predicted pixels for a view to have a value in a bin."""


def profile_samples(
    p_m: Float64[ndarray, " n"], truth: SteelTruth, diameter_m: Float64[ndarray, " ids"]
) -> Samples:
    """Return a view's median scale and AbsRel in each bin of true distance and of bar width with enough pixels.

    ``p_m`` is planar depth on ``truth.index``, metres, NaN where missing; ``diameter_m`` is indexed by bar id.
    Only interior pixels with a prediction count. A bin includes its lower edge. The scale s of a bin is median(z
    / p) over its pixels. The width of a bar is fx d / z, pixels.
    """
    sampled = subsample(np.flatnonzero(truth.interior), MAX_PIXELS)
    pixels = sampled[is_valid_prediction(p_m[sampled])]
    z, p = truth.depth_m[pixels].astype(np.float64), p_m[pixels]
    with np.errstate(over="ignore"):
        ratio, error = z / p, np.abs(p - z) / z
    width_px = truth.K[0, 0] * diameter_m[truth.bar_id[pixels]] / z
    samples: dict[str, Float64[ndarray, " one"]] = {}
    for (axis, edges), values in zip(AXES.items(), (z, width_px), strict=True):
        nearest, farthest = values.min(initial=np.inf), values.max(initial=-np.inf)
        for (low, high), name in zip(pairwise(edges), bin_names(axis, edges), strict=True):
            samples |= dict.fromkeys((f"scale_at_{name}", f"abs_rel_at_{name}"), np.empty(0))
            if nearest >= high or farthest < low:
                continue
            inside = (values >= low) & (values < high)
            enough = np.count_nonzero(inside) >= MIN_PIXELS
            samples[f"scale_at_{name}"] = finite_sample(median(ratio[inside]) if enough else None)
            samples[f"abs_rel_at_{name}"] = finite_sample(float(np.mean(error[inside])) if enough else None)
    return {**samples, **_single_bar_samples(z, error, truth.single_bar[pixels], truth, sampled)}


def _single_bar_samples(
    z_m: Float64[ndarray, " k"],
    error: Float64[ndarray, " k"],
    single_bar: Bool[ndarray, " k"],
    truth: SteelTruth,
    sampled: Int64[ndarray, " m"],
) -> Samples:
    """Return the single-bar share of the ``sampled`` pixels in each bin of distance, and AbsRel on these pixels.

    ``z_m``, ``error`` (|p - z| / z) and ``single_bar`` are those of the sampled pixels with a prediction.
    """
    samples = {}
    all_z_m, all_single_bar = truth.depth_m[sampled].astype(np.float64), truth.single_bar[sampled]
    for (low, high), name in zip(pairwise(DISTANCE_EDGES_M), bin_names("m", DISTANCE_EDGES_M), strict=True):
        in_bin = all_single_bar[(all_z_m >= low) & (all_z_m < high)]
        share = float(np.mean(in_bin)) if len(in_bin) >= MIN_PIXELS else None
        chosen = error[(z_m >= low) & (z_m < high) & single_bar]
        mean_error = float(np.mean(chosen)) if len(chosen) >= MIN_PIXELS else None
        samples[f"single_bar_share_at_{name}"] = finite_sample(share)
        samples[f"single_bar_abs_rel_at_{name}"] = finite_sample(mean_error)
    return samples


def bin_names(axis: str, edges: tuple[float, ...]) -> list[str]:
    """Return the name of each bin between ``edges``, the suffix of ``scale_at_`` and the other measures."""
    return [f"{low:g}-{high:g}{axis}" for low, high in pairwise(edges)]


AXES = {"m": DISTANCE_EDGES_M, "px": WIDTH_EDGES_PX}
"""Bin edges of true distance and of bar width, by unit."""

_WHERE = {"m": "at", "px": "on bars of"}
"""Preposition of each axis in titles and definitions."""


def _measures() -> Iterator[Measure]:
    """Yield the scale and AbsRel measures of every bin."""
    for axis, edges in AXES.items():
        for name in bin_names(axis, edges):
            where = f"{_WHERE[axis]} {name.removesuffix(axis)} {axis}"
            scale, error = f"scale_at_{name}", f"abs_rel_at_{name}"
            yield Measure(
                scale, scale, "median", f"Scale s {where}", "", "", f"median over views of median(z/p) {where}"
            )
            yield Measure(error, error, "mean", f"AbsRel {where}", "", "", f"mean over views of AbsRel {where}")
    for name in bin_names("m", DISTANCE_EDGES_M):
        where = f"at {name.removesuffix('m')} m"
        share, error = f"single_bar_share_at_{name}", f"single_bar_abs_rel_at_{name}"
        definition = f"mean over views of the single-bar share of the interior pixels {where}"
        yield Measure(share, share, "mean", f"Single-bar share {where}", "%", "", definition)
        definition = f"mean over views of AbsRel on the single-bar interior {where}"
        yield Measure(error, error, "mean", f"AbsRel, single-bar, {where}", "", "", definition)


MEASURES: tuple[Measure, ...] = tuple(_measures())
"""Profile measures in table order."""
