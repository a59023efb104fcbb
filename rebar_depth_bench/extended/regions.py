"""Regions: the protocol's metrics on the whole steel mask, on its interior, and on its single-bar interior.

The protocol scores the interior only: it leaves out a rim of one pixel (3 x 3 erosion), where a mixed pixel has no
single depth. The interior is most of the mask of a near lattice and a sixth of the mask of a distant pier;
``kept_share`` is that fraction, and comparing the two sets of scores shows the effect of the rim. Formulas:
``metrics.depth_metrics`` (Eigen et al. 2014).

As in the protocol, the four errors are means over the pixels that have a prediction, so missing predictions can
lower them. They serve to compare the two regions with each other, and their measures have no better direction.
Coverage and the shares within a tolerance are taken over ALL pixels of the region, where a missing prediction is a
failure; only these may be compared between methods.

The interior erodes the union of all bars, so that an interior pixel of a dense cage can have another bar beside
it, at another depth. On these pixels, a prediction that is exact but shifted by one pixel has a large error. The
single-bar interior has no such pixels: where a method's error on it is as large as on the whole interior,
neighbouring bars do not explain the error. The pixels are chosen by the ground truth alone
(``protocol.single_bar_pixels``); the scaled evaluation uses the scale of all scored pixels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from rebar_depth_bench.extended.measures import Measure, Samples, share_sample
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.scoring.columns import METRICS
from rebar_depth_bench.scoring.metrics import is_valid_prediction, metrics_at_scales
from rebar_depth_bench.scoring.protocol import PROTOCOL, WITHIN_MM

_REGIONS = {
    "full_mask": ("whole mask", "steel pixels, rim included"),
    "interior": ("interior", "interior steel pixels"),
    "single_bar": ("single-bar", "interior pixels whose 3 x 3 neighbourhood belongs to one bar"),
}
"""Short name in titles and description of the pixels of each region; keys are prefixes of measures."""

REGION_NUMBERS = (*METRICS, "coverage", *(f"within_{t}mm" for t in WITHIN_MM))
"""Names of all numbers computed on each region."""


def region_samples(p_m: Float64[ndarray, " n"], truth: SteelTruth) -> Samples:
    """Return a view's samples by region; ``p_m`` is planar depth on ``truth.index``, metres, NaN where missing.

    ``<region>_<metric>`` has one value each for abs_rel, rmse_cm, mae_cm, delta1 (over predicted pixels; none
    where there is no such pixel) and for coverage and within_<t>mm (shares of all pixels, 0 to 1; none where the
    view has no such pixel). ``kept_share`` is interior / mask pixels, and ``single_bar_share`` is single-bar
    pixels / scored pixels. ``single_bar_views_abs_rel`` is AbsRel on the scored pixels of a view that has AbsRel
    on single-bar pixels. Steel without a bar id is in no region.
    """
    pixels = {
        "full_mask": truth.bar_id > 0,
        "interior": truth.interior & (truth.bar_id > 0),
        "single_bar": truth.single_bar,
    }
    count = {region: np.count_nonzero(of_region) for region, of_region in pixels.items()}
    samples = {
        f"{region}_{name}": np.array([value])
        for region, of_region in pixels.items()
        for name, value in _region_numbers(p_m, truth, of_region).items()
    }
    scored = np.count_nonzero(truth.interior)
    if "single_bar_abs_rel" in samples:
        whole = samples["interior_abs_rel"]
        if count["interior"] < scored:  # Steel without a bar id is scored, too.
            whole = np.array([_region_numbers(p_m, truth, truth.interior)["abs_rel"]])
        samples["single_bar_views_abs_rel"] = whole
    return {
        **samples,
        "kept_share": share_sample(count["interior"], count["full_mask"]),
        "single_bar_share": share_sample(count["single_bar"], scored),
    }


def _region_numbers(
    p_m: Float64[ndarray, " n"], truth: SteelTruth, pixels: Bool[ndarray, " n"]
) -> dict[str, float]:
    """Return the ``REGION_NUMBERS`` of the pixels of a region, without undefined ones."""
    predicted = pixels & is_valid_prediction(p_m)
    p_valid_m, z_m = p_m[predicted], truth.depth_m[predicted].astype(np.float64)
    total = int(np.count_nonzero(pixels))
    if not total:
        return {}
    if not len(p_valid_m):
        return {"coverage": 0.0, **{f"within_{t}mm": 0.0 for t in WITHIN_MM}}
    [metrics], within = metrics_at_scales(p_valid_m, z_m, (1.0,), WITHIN_MM)
    return {
        **asdict(metrics),
        "coverage": len(p_valid_m) / total,
        **{f"within_{t}mm": count / total for t, count in within.items()},
    }


def _region_measures(*regions: str) -> Iterator[Measure]:
    """Yield the measures of ``REGION_NUMBERS``, each on all of the regions."""
    for number in REGION_NUMBERS:
        for region in regions:
            name, (short, pixels) = f"{region}_{number}", _REGIONS[region]
            if number in METRICS:
                info = METRICS[number]
                definition = (
                    f"{number} as {PROTOCOL} defines it, over the predicted {pixels}; "
                    "to set beside the other region's"
                )
                yield Measure(name, f"{info.title}, {short}", info.unit, "", definition)
            elif number == "coverage":
                definition = f"share with a prediction (finite and > 0) of {pixels}"
                yield Measure(name, f"Coverage, {short}", "%", "higher", definition)
            else:
                limit = number.removeprefix("within_").removesuffix("mm")
                definition = f"share of {pixels} with |p - z| <= {limit} mm; a missing prediction is not within"
                yield Measure(name, f"Within {limit} mm, {short}", "%", "higher", definition)


FULL_MASK_MEASURES = (
    *_region_measures("full_mask", "interior"),
    Measure("kept_share", "Mask kept as interior", "%", "", "interior pixels / steel pixels, by the truth"),
)
"""Full-mask measures in table order."""

SINGLE_BAR_MEASURES = (
    Measure(
        "single_bar_share", "Single-bar share of the interior", "%", "",
        "interior pixels whose 3 x 3 neighbourhood belongs to one bar / interior pixels, by the truth; the other "
        "pixels have a second bar within one pixel, so that errors on them contain the step between the bars",
    ),
    *_region_measures("single_bar"),
    Measure(
        "single_bar_views_abs_rel", "AbsRel, whole interior of the same views", "", "",
        "mean of interior_abs_rel over the views that have single_bar_abs_rel, to set beside it",
    ),
)  # fmt: skip
"""Single-bar measures in table order."""
