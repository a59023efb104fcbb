"""Error profiles: scale and AbsRel binned by true distance and by the apparent width of the bar.

The bins of true distance also have the share of the single-bar interior and AbsRel on it (``regions``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np
from jaxtyping import Float64
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


def profile_samples(p_m: Float64[ndarray, " n"], truth: SteelTruth) -> Samples:
    """Return a view's median scale and AbsRel in each bin of true distance and of bar width with enough pixels.

    ``p_m`` is planar depth on ``truth.index``, metres, NaN where missing. Only interior pixels with a prediction
    count. A bin includes its lower edge. The scale s of a bin is median(z / p) over its pixels. The width of a bar
    is fx d / z, pixels. The bins of true distance also have the single-bar share of all pixels, and AbsRel on the
    single-bar pixels.
    """
    sampled = subsample(np.flatnonzero(truth.interior), MAX_PIXELS)
    pixels = sampled[is_valid_prediction(p_m[sampled])]
    z, p = truth.depth_m[pixels].astype(np.float64), p_m[pixels]
    with np.errstate(over="ignore"):
        ratio, error = z / p, np.abs(p - z) / z
    single_bar = truth.single_bar[pixels]
    all_z, all_single_bar = truth.depth_m[sampled].astype(np.float64), truth.single_bar[sampled]
    width_px = truth.K[0, 0] * truth.bars.diameter_m[truth.bar_id[pixels]] / z
    samples: dict[str, Float64[ndarray, " one"]] = {}
    for axis, values in (("m", z), ("px", width_px)):
        for low, high, name in bins(axis):
            inside = (values >= low) & (values < high)
            samples[f"scale_at_{name}"] = _sample(median, ratio[inside])
            samples[f"abs_rel_at_{name}"] = _sample(np.mean, error[inside])
            if axis == "m":
                all_inside = (all_z >= low) & (all_z < high)
                samples[f"single_bar_share_at_{name}"] = _sample(np.mean, all_single_bar[all_inside])
                samples[f"single_bar_abs_rel_at_{name}"] = _sample(np.mean, error[inside & single_bar])
    return samples


def _sample(statistic: Callable[[ndarray], float], values: ndarray) -> Float64[ndarray, " one"]:
    """Return a sample of the statistic of the values of a bin, empty for too few."""
    return finite_sample(float(statistic(values)) if len(values) >= MIN_PIXELS else None)


AXES = {"m": DISTANCE_EDGES_M, "px": WIDTH_EDGES_PX}
"""Bin edges of true distance and of bar width, by unit."""


def bins(axis: str) -> Iterator[tuple[float, float, str]]:
    """Yield the edges of each bin of an axis and its name, the suffix of ``scale_at_`` and the other measures."""
    for low, high in pairwise(AXES[axis]):
        yield low, high, f"{low:g}-{high:g}{axis}"


def _measures() -> Iterator[Measure]:
    """Yield the scale and AbsRel measures of every bin, then the single-bar measures of the bins of distance."""
    for axis, preposition in (("m", "at"), ("px", "on bars of")):
        for low, high, name in bins(axis):
            where = f"{preposition} {low:g}-{high:g} {axis}"
            yield Measure(
                f"scale_at_{name}", f"Scale s {where}", "", "", f"median over views of median(z/p) {where}",
                statistic="median",
            )  # fmt: skip
            yield Measure(f"abs_rel_at_{name}", f"AbsRel {where}", "", "", f"mean over views of AbsRel {where}")
    for low, high, name in bins("m"):
        where = f"at {low:g}-{high:g} m"
        yield Measure(
            f"single_bar_share_at_{name}", f"Single-bar share {where}", "%", "",
            f"mean over views of the single-bar share of the interior pixels {where}",
        )  # fmt: skip
        yield Measure(
            f"single_bar_abs_rel_at_{name}", f"AbsRel, single-bar, {where}", "", "",
            f"mean over views of AbsRel on the single-bar interior {where}",
        )  # fmt: skip


MEASURES = tuple(_measures())
"""Profile measures in table order."""
