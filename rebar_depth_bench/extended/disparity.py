"""Disparity errors, as papers on stereo state them: for views that are the left one of a rectified pair.

A depth z has the disparity d = f B / z in pixels, with focal length f and baseline B of the pair; a surface at the
left column u is at the right column u - d - (cx_left - cx_right). The principal points of most pairs are equal;
their difference cancels in all errors. Other views (raw grids, and imported ones without a right camera or its
depth) have no samples.

A scored pixel is non-occluded if the right view sees the same surface: by the exact depth of the right view, its
disparity at the nearest right pixel differs by ``MAX_DIFFERENCE_PX`` or less. Pixels whose match lies outside the
right image, or has no depth, are occluded.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float64, UInt32
from numpy import ndarray

from rebar_depth_bench.data.rows import EyeTruth
from rebar_depth_bench.extended.measures import (
    Measure,
    MeasureFamily,
    Samples,
    finite_sample,
    share_sample,
    valid_or_nan,
)
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.geometry.cameras import rectified_baseline_m, right_from_left

MAX_DIFFERENCE_PX = 1.0
"""Largest difference of the true disparities of a pixel and its match, if both show the same surface."""

BAD_PX = (1, 2)
D1_PX, D1_PERCENT = 3, 5


def seen_by_right(eyes: Sequence[EyeTruth], scored: UInt32[ndarray, " n"]) -> tuple[float, Bool[ndarray, " n"]]:
    """Return f B of a view in px m and which of its scored pixels, flat indices, are non-occluded.

    f B is 0, and no pixel is non-occluded, unless ``eyes`` are left and right view of a rectified pair.
    """
    nowhere = np.zeros(len(scored), dtype=bool)
    if len(eyes) == 1:
        return 0.0, nowhere
    left, right = (eye.camera for eye in eyes)
    motion = right_from_left(left.cam_from_world, right.cam_from_world)
    baseline_m = rectified_baseline_m((left.K, right.K), (left.distortion, right.distortion), motion)
    if baseline_m is None:
        return 0.0, nowhere
    parallax_px_m = float(left.K[0, 0]) * baseline_m
    row, column = np.divmod(scored.astype(np.int64), left.width)
    disparity_px = parallax_px_m / eyes[0].depth_m.ravel()[scored].astype(np.float64)
    match = np.rint(column - disparity_px - (left.K[0, 2] - right.K[0, 2]))
    is_inside = (match >= 0) & (match < right.width)
    right_m = eyes[1].depth_m[row, np.where(is_inside, match, 0).astype(np.int64)].astype(np.float64)
    with np.errstate(divide="ignore"):
        difference_px = np.abs(parallax_px_m / right_m - disparity_px)
    return parallax_px_m, is_inside & (right_m > 0) & (difference_px <= MAX_DIFFERENCE_PX)


def disparity_samples(p_m: Float64[ndarray, " n"], truth: SteelTruth) -> Samples:
    """Return a view's disparity samples; ``p_m`` is planar depth on ``truth.index``, metres, NaN where missing.

    ``<pixels>_epe_px`` (over predicted pixels), ``<pixels>_bad<t>`` and ``<pixels>_d1`` (shares of all pixels)
    have one value each, for the scored pixels (``disparity``) and the non-occluded of them (``disparity_noc``);
    ``disparity_seen_by_right`` is the share of the latter. There is none where the view has no such pixel.
    """
    if truth.right is None:
        return {}
    scored, parallax_px_m = truth.interior, truth.right.parallax_px_m
    true_px = parallax_px_m / truth.depth_m[scored].astype(np.float64)
    with np.errstate(over="ignore"):
        error_px = np.abs(parallax_px_m / valid_or_nan(p_m[scored]) - true_px)
    seen = truth.right.sees[scored]
    samples = {"disparity_seen_by_right": share_sample(np.count_nonzero(seen), len(seen))}
    for prefix, pixels in (("disparity", np.ones_like(seen)), ("disparity_noc", seen)):
        error, true = error_px[pixels], true_px[pixels]
        predicted = error[~np.isnan(error)]
        with np.errstate(over="ignore"):
            samples[f"{prefix}_epe_px"] = finite_sample(float(np.mean(predicted)) if len(predicted) else None)
        # A missing prediction has the error NaN, which is within no limit.
        good = {f"bad{t}": error <= t for t in BAD_PX}
        good["d1"] = (error <= D1_PX) | (error <= D1_PERCENT / 100 * true)
        for name, is_good in good.items():
            samples[f"{prefix}_{name}"] = share_sample(np.count_nonzero(~is_good), len(error))
    return samples


def _measures(prefix: str, title: str, pixels: str) -> Iterator[Measure]:
    """Yield the errors over some pixels, whose description completes "mean over"."""
    yield Measure(
        f"{prefix}_epe_px", f"Disparity error EPE{title}", "px", "",
        "end-point error of the disparity f B / z (f: focal length, px; B: baseline; rectified pairs only): mean "
        f"over {pixels} with a prediction of |f B / p - f B / z| (Geiger et al. 2012, KITTI)",
    )  # fmt: skip
    for t in BAD_PX:
        definition = f"share of {pixels} with |f B / p - f B / z| > {t} px; a missing prediction counts as bad"
        source = "Scharstein et al. 2014, Middlebury"
        yield Measure(f"{prefix}_bad{t}", f"Disparity bad-{t}{title}", "%", "lower", f"{definition} ({source})")
    yield Measure(
        f"{prefix}_d1", f"Disparity D1{title}", "%", "lower",
        f"share of {pixels} with |f B / p - f B / z| > {D1_PX} px and > {D1_PERCENT} % of f B / z; a missing "
        "prediction counts as bad (Menze and Geiger 2015, KITTI)",
    )  # fmt: skip


MEASURES = (
    *_measures("disparity", "", "scored pixels"),
    *_measures("disparity_noc", ", non-occluded", "non-occluded scored pixels"),
    Measure(
        "disparity_seen_by_right", "Non-occluded pixels", "%", "",
        "share of scored pixels whose match lies in the right image, on a surface whose disparity f B / z differs "
        f"by {MAX_DIFFERENCE_PX:g} px or less, by the exact depth of both views",
    ),
)  # fmt: skip
"""Disparity measures in table order."""

FAMILIES = (MeasureFamily("disparity", "Disparity of rectified pairs", 2, MEASURES, disparity_samples),)
