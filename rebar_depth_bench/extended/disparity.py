"""Disparity errors, as papers on stereo state them, of views that are the left one of a rectified pair.

With focal length f and baseline B, the depth z at column u of the left image is at column u - d - (cx_left -
cx_right) of the right one, d = f B / z. The difference of the principal points cancels in all errors. Other views
(raw grids, imported ones without right depth) have no samples.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float64, UInt32
from numpy import ndarray

from rebar_depth_bench.data.rows import EyeTruth
from rebar_depth_bench.data.schema import EYES
from rebar_depth_bench.extended.measures import Measure, Samples, finite_sample, share_sample
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.geometry.cameras import is_rectified, right_from_left
from rebar_depth_bench.scoring.metrics import is_valid_prediction

MAX_DIFFERENCE_PX = 1.0
BAD_PX = (1, 2)
D1_PX, D1_PERCENT = 3, 5


def match_right(eyes: Sequence[EyeTruth], scored: UInt32[ndarray, " n"]) -> tuple[float, Bool[ndarray, " n"]]:
    """Return f B of a view in px m, and which of its scored pixels (flat indices) are non-occluded.

    These are 0 and none unless ``eyes`` are the left and the right view of a rectified pair.
    """
    cameras = zip(EYES, [eye.camera for eye in eyes], strict=False)
    pair = {f"{eye}_{name}": value for eye, camera in cameras for name, value in vars(camera).items()}
    baseline_m = 0.0 if len(eyes) < 2 else -float(right_from_left(pair)[0, 3])
    if baseline_m <= 0 or not is_rectified({**pair, "baseline_m": baseline_m}):
        return 0.0, np.zeros(len(scored), dtype=bool)
    left, right, width = pair["left_K"], pair["right_K"], pair["left_width"]
    parallax_px_m = float(left[0, 0]) * baseline_m
    row, column = np.divmod(scored.astype(np.int64), width)
    disparity_px = parallax_px_m / eyes[0].depth_m[row, column].astype(np.float64)
    match = np.rint(column - disparity_px - (left[0, 2] - right[0, 2]))
    is_inside = (match >= 0) & (match < width)
    right_m = eyes[1].depth_m[row, np.where(is_inside, match, 0).astype(np.int64)].astype(np.float64)
    with np.errstate(divide="ignore"):
        is_same = np.abs(parallax_px_m / right_m - disparity_px) <= MAX_DIFFERENCE_PX
    return parallax_px_m, is_inside & is_same


def disparity_samples(p_m: Float64[ndarray, " n"], truth: SteelTruth) -> Samples:
    """Return a view's disparity samples; ``p_m`` is planar depth on ``truth.index``, metres, NaN where missing.

    Each measure has one value, or none where the view has no such pixel or is not of a rectified pair.
    """
    if not truth.parallax_px_m:
        return {}
    true_px = truth.parallax_px_m / truth.depth_m[truth.interior].astype(np.float64)
    seen = truth.seen_by_right[truth.interior]
    samples = {"disparity_seen_by_right": share_sample(np.count_nonzero(seen), len(seen))}
    valid_m = np.where(is_valid_prediction(p_m), p_m, np.nan)[truth.interior]
    with np.errstate(over="ignore"):
        error_px = np.abs(truth.parallax_px_m / valid_m - true_px)
        for prefix, pixels in (("disparity", np.ones_like(seen)), ("disparity_noc", seen)):
            error, true = error_px[pixels], true_px[pixels]
            predicted = error[~np.isnan(error)]
            # A missing prediction has the error NaN, which is within no limit.
            good = {f"bad{t}": error <= t for t in BAD_PX}
            good["d1"] = (error <= D1_PX) | (error <= D1_PERCENT / 100 * true)
            samples[f"{prefix}_epe_px"] = finite_sample(float(np.mean(predicted)) if len(predicted) else None)
            for name, is_good in good.items():
                samples[f"{prefix}_{name}"] = share_sample(np.count_nonzero(~is_good), len(is_good))
    return samples


def _measures(prefix: str, suffix: str, pixels: str) -> Iterator[Measure]:
    """Yield the errors over some pixels."""
    error = "|f B / p - f B / z|"
    yield Measure(
        f"{prefix}_epe_px", f"Disparity error EPE{suffix}", "px", "",
        f"end-point error: mean of {error} over {pixels} with a prediction (Geiger et al. 2012, KITTI), f: focal "
        "length in px, B: baseline; rectified pairs only",
    )  # fmt: skip
    limits = [(f"bad{t}", f"bad-{t}", f"> {t} px", "Scharstein et al. 2014, Middlebury") for t in BAD_PX]
    d1 = ("d1", "D1", f"> {D1_PX} px and > {D1_PERCENT} % of f B / z", "Menze and Geiger 2015, KITTI")
    for key, title, limit, source in (*limits, d1):
        definition = f"share of {pixels} with {error} {limit}; a missing prediction counts as bad ({source})"
        yield Measure(f"{prefix}_{key}", f"Disparity {title}{suffix}", "%", "lower", definition)


MEASURES = (
    *_measures("disparity", "", "scored pixels"),
    *_measures("disparity_noc", ", non-occluded", "non-occluded scored pixels"),
    Measure(
        "disparity_seen_by_right", "Non-occluded pixels", "%", "",
        "share of scored pixels whose match lies in the right image, on a surface whose disparity f B / z differs "
        f"by {MAX_DIFFERENCE_PX:g} px or less, by the exact depth of both views",
    ),
)  # fmt: skip
