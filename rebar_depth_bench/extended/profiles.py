"""Scale and error against distance and against how wide a bar is in the picture."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.extended.measures import Measure, Samples, thinned
from rebar_depth_bench.extended.steel_truth import SteelTruth
from rebar_depth_bench.scoring.metrics import is_prediction, median

DISTANCE_EDGES_M = (0.2, 0.25, 0.3, 0.4, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0, 14.0, 20.0)
WIDTH_EDGES_PX = (2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0, 48.0)

MAX_PIXELS = 16_000
"""A view's interior is thinned to this many: bins need no more."""

MIN_PIXELS = 50
"""A view has a value in a bin from this many predicted pixels on."""


def profile_samples(
    p_m: Float64[ndarray, " n"], truth: SteelTruth, diameter_m: Float64[ndarray, " ids"]
) -> Samples:
    """Return a view's s and AbsRel in each bin of true distance and of bar width in which it has enough pixels.

    ``p_m`` is planar depth on ``truth.index``, metres, NaN for none; ``diameter_m`` is looked up by bar id.
    Interior pixels with a prediction count; a bin holds its lower edge. s of a bin is median(z / p) over its
    pixels. A bar's width is fx d / z, pixels.
    """
    kept = thinned(np.flatnonzero(truth.interior), MAX_PIXELS)
    pixels = kept[is_prediction(p_m[kept])]
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
            samples[f"scale_at_{name}"] = _known([median(ratio[inside])] if enough else [])
            samples[f"abs_rel_at_{name}"] = _known([float(np.mean(error[inside]))] if enough else [])
    return samples


def _known(values: list[float]) -> Float64[ndarray, " one"]:
    return np.array([value for value in values if np.isfinite(value)], dtype=np.float64)


def bin_names(axis: str, edges: tuple[float, ...]) -> list[str]:
    """Return what each bin between ``edges`` is called: ``scale_at_`` and ``abs_rel_at_`` go before it."""
    return [f"{low:g}-{high:g}{axis}" for low, high in pairwise(edges)]


AXES = {"m": DISTANCE_EDGES_M, "px": WIDTH_EDGES_PX}
"""The edges of the bins of true distance and of bar width, by unit."""

_WHERE = {"m": "at", "px": "on bars of"}


def _measures() -> Iterator[Measure]:
    for axis, edges in AXES.items():
        for name in bin_names(axis, edges):
            where = f"{_WHERE[axis]} {name.removesuffix(axis)} {axis}"
            scale, error = f"scale_at_{name}", f"abs_rel_at_{name}"
            yield Measure(
                scale, scale, "median", f"Scale s {where}", "", "", f"median over views of median(z/p) {where}"
            )
            yield Measure(error, error, "mean", f"AbsRel {where}", "", "", f"mean over views of AbsRel {where}")


MEASURES: tuple[Measure, ...] = tuple(_measures())
