"""Error profiles: scale and AbsRel binned by true distance and by the apparent width of the bar."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.extended.measures import Measure, Samples, finite_sample, subsample
from rebar_depth_bench.extended.steel_truth import SteelTruth
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
    return samples


def bin_names(axis: str, edges: tuple[float, ...]) -> list[str]:
    """Return the name of each bin between ``edges``, the suffix of ``scale_at_`` and ``abs_rel_at_``."""
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


MEASURES: tuple[Measure, ...] = tuple(_measures())
"""Profile measures in table order."""
