"""The numbers of ``rebar-1`` on the whole steel mask, rim included, beside those on the interior that it scores.

``rebar-1`` leaves out a rim of one pixel (3 x 3 erosion), where a mixed pixel has no one depth. On a near lattice
that keeps most of the mask, on a far pier a sixth of it: ``kept_share`` tells, and the pair of scores tells what
the rim hides. Formulas: ``metrics.depth_metrics`` (Eigen et al. 2014).

As in ``rebar-1`` the four errors are means over the pixels that have a prediction, so a hole can lower them. They
are there to be compared with each other, region with region, and their measures have no better side. What may be
compared between methods are the coverage and the shares within a tolerance, of ALL pixels of the region: a hole
is a failure there.
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from rebar_depth_bench.extended.measures import Measure, Samples
from rebar_depth_bench.extended.steel_truth import SteelTruth
from rebar_depth_bench.scoring.metrics import DepthMetrics, aligned_metrics, is_prediction
from rebar_depth_bench.scoring.protocol import WITHIN_MM

_ERRORS = tuple(field.name for field in fields(DepthMetrics))


def full_mask_samples(p_m: Float64[ndarray, " n"], truth: SteelTruth) -> Samples:
    """Return a view's scores on its whole mask; ``p_m`` is planar depth on ``truth.index``, metres, NaN for none.

    One value each of ``full_mask_<number>`` and ``interior_<number>`` for abs_rel, rmse_cm, mae_cm, delta1 (over
    predicted pixels; none where there is no such pixel), and for coverage and within_<t>mm (shares of all
    pixels, 0 to 1; none where the view has no such pixel); and ``kept_share`` = interior / mask pixels.
    """
    mask = truth.bar_id > 0
    interior = truth.interior & mask
    total, kept = np.count_nonzero(mask), np.count_nonzero(interior)
    return {
        **_scores("full_mask", p_m, truth, mask),
        **_scores("interior", p_m, truth, interior),
        "kept_share": np.array([kept / total] if total else [], np.float64),
    }


def _scores(prefix: str, p_m: Float64[ndarray, " n"], truth: SteelTruth, pixels: Bool[ndarray, " n"]) -> Samples:
    """Return the numbers over some of the view's pixels, their names prefixed."""
    predicted = pixels & is_prediction(p_m)
    p_valid_m, z_m = p_m[predicted], truth.depth_m[predicted].astype(np.float64)
    numbers: dict[str, float] = {}
    total = int(np.count_nonzero(pixels))
    if total:
        numbers["coverage"] = len(p_valid_m) / total
        numbers.update((f"within_{t}mm", 0.0) for t in WITHIN_MM)
    if len(p_valid_m):
        [found], within = aligned_metrics(p_valid_m, z_m, (1.0,), WITHIN_MM)
        numbers.update((name, getattr(found, name)) for name in _ERRORS)
        numbers.update((f"within_{t}mm", count / total) for t, count in within.items())
    return {
        f"{prefix}_{name}": np.array([numbers[name]] if name in numbers else [], np.float64) for name in _NUMBERS
    }


_NUMBERS = (*_ERRORS, "coverage", *(f"within_{t}mm" for t in WITHIN_MM))
_TITLES = {"abs_rel": ("AbsRel", ""), "rmse_cm": ("RMSE", "cm"), "mae_cm": ("MAE", "cm"), "delta1": ("δ1", "")}
_REGIONS = {
    "full_mask": ("whole mask", "steel pixels, rim included"),
    "interior": ("interior", "interior steel pixels"),
}


def _error_measure(region: str, number: str) -> Measure:
    (short, pixels), (title, unit) = _REGIONS[region], _TITLES[number]
    definition = f"{number} as rebar-1 defines it, over the predicted {pixels}; to set beside the other region's"
    return Measure(f"{region}_{number}", f"{region}_{number}", "mean", f"{title}, {short}", unit, "", definition)


def _share_measure(region: str, number: str) -> Measure:
    short, pixels = _REGIONS[region]
    if number == "coverage":
        title, definition = f"Coverage, {short}", f"share of {pixels} with a prediction (finite and > 0)"
    else:
        tolerance = number.removeprefix("within_").removesuffix("mm")
        title = f"Within {tolerance} mm, {short}"
        definition = f"share of {pixels} with |p - z| <= {tolerance} mm; a missing prediction is not within"
    return Measure(f"{region}_{number}", f"{region}_{number}", "mean", title, "%", "higher", definition)


MEASURES: tuple[Measure, ...] = (
    *(
        _error_measure(region, number) if number in _TITLES else _share_measure(region, number)
        for number in _NUMBERS
        for region in _REGIONS
    ),
    Measure(
        "kept_share",
        "kept_share",
        "mean",
        "Mask kept as interior",
        "%",
        "",
        "interior pixels / steel pixels, by the truth",
    ),
)
