"""Full-mask measures: the protocol's metrics on the whole steel mask beside those on its interior.

The protocol scores the interior only: it leaves out a rim of one pixel (3 x 3 erosion), where a mixed pixel has no
single depth. The interior is most of the mask of a near lattice and a sixth of the mask of a distant pier;
``kept_share`` is that fraction, and comparing the two sets of scores shows the effect of the rim. Formulas:
``metrics.depth_metrics`` (Eigen et al. 2014).

As in the protocol, the four errors are means over the pixels that have a prediction, so missing predictions can
lower them. They serve to compare the two regions with each other, and their measures have no better direction.
Coverage and the shares within a tolerance are taken over ALL pixels of the region, where a missing prediction is a
failure; only these may be compared between methods.

The single-bar interior (``scoring.single_bar``) has the same metrics: where a method's error on it is as large as
on the whole interior, neighbouring bars do not explain the error. The scale of the scaled evaluation is that of
all scored pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from rebar_depth_bench.extended.measures import Measure, Samples
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.scoring.columns import METRICS
from rebar_depth_bench.scoring.metrics import is_valid_prediction, metrics_at_scales
from rebar_depth_bench.scoring.protocol import PROTOCOL, WITHIN_MM


def full_mask_samples(p_m: Float64[ndarray, " n"], truth: SteelTruth) -> Samples:
    """Return a view's samples by region; ``p_m`` is planar depth on ``truth.index``, metres, NaN where missing.

    ``full_mask_<metric>`` and ``interior_<metric>`` have one value each for abs_rel, rmse_cm, mae_cm, delta1
    (over predicted pixels; empty where there is no such pixel) and for coverage and within_<t>mm (shares of all
    pixels, 0 to 1; empty where the view has no such pixel). ``kept_share`` is the number of interior pixels over
    that of mask pixels.
    """
    mask = truth.bar_id > 0
    interior = truth.interior & mask
    mask_count, interior_count = np.count_nonzero(mask), np.count_nonzero(interior)
    return {
        **region_scores("full_mask", p_m, truth, mask),
        **region_scores("interior", p_m, truth, interior),
        "kept_share": np.array([interior_count / mask_count] if mask_count else [], np.float64),
    }


def region_scores(
    region: str, p_m: Float64[ndarray, " n"], truth: SteelTruth, pixels: Bool[ndarray, " n"]
) -> Samples:
    """Return the metrics over the pixels of a region as samples, their names prefixed with that of the region."""
    predicted = pixels & is_valid_prediction(p_m)
    p_valid_m, z_m = p_m[predicted], truth.depth_m[predicted].astype(np.float64)
    numbers: dict[str, float] = {}
    total = int(np.count_nonzero(pixels))
    if total:
        numbers["coverage"] = len(p_valid_m) / total
        numbers.update((f"within_{t}mm", 0.0) for t in WITHIN_MM)
    if len(p_valid_m):
        [metrics], within = metrics_at_scales(p_valid_m, z_m, (1.0,), WITHIN_MM)
        numbers.update((name, getattr(metrics, name)) for name in METRICS)
        numbers.update((f"within_{t}mm", count / total) for t, count in within.items())
    return {
        f"{region}_{name}": np.array([numbers[name]] if name in numbers else [], np.float64)
        for name in REGION_NUMBERS
    }


REGION_NUMBERS = (*METRICS, "coverage", *(f"within_{t}mm" for t in WITHIN_MM))
"""Names of all numbers computed on each region."""


@dataclass(frozen=True)
class Region:
    """Region of a view: the prefix of its measures, its short name in titles, and a description of its pixels."""

    prefix: str
    short: str
    pixels: str


_REGIONS = (
    Region("full_mask", "whole mask", "steel pixels, rim included"),
    Region("interior", "interior", "interior steel pixels"),
)


def region_measure(region: Region, number: str) -> Measure:
    """Return the measure of one of ``REGION_NUMBERS`` on a region."""
    return _error_measure(region, number) if number in METRICS else _share_measure(region, number)


def _error_measure(region: Region, metric: str) -> Measure:
    name, info = f"{region.prefix}_{metric}", METRICS[metric]
    definition = (
        f"{metric} as {PROTOCOL} defines it, over the predicted {region.pixels}; to set beside the other region's"
    )
    return Measure(name, name, "mean", f"{info.title}, {region.short}", info.unit, "", definition)


def _share_measure(region: Region, metric: str) -> Measure:
    name, short, pixels = f"{region.prefix}_{metric}", region.short, region.pixels
    if metric == "coverage":
        title, definition = f"Coverage, {short}", f"share of {pixels} with a prediction (finite and > 0)"
    else:
        tolerance = metric.removeprefix("within_").removesuffix("mm")
        title = f"Within {tolerance} mm, {short}"
        definition = f"share of {pixels} with |p - z| <= {tolerance} mm; a missing prediction is not within"
    return Measure(name, name, "mean", title, "%", "higher", definition)


FULL_MASK_MEASURES: tuple[Measure, ...] = (
    *(region_measure(region, number) for number in REGION_NUMBERS for region in _REGIONS),
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
"""Full-mask measures in table order."""


_VIEWS_ABS_REL = "single_bar_views_abs_rel"
_REGION = Region("single_bar", "single-bar", "interior pixels whose 3 x 3 neighbourhood belongs to one bar")


def single_bar_samples(p_m: Float64[ndarray, " n"], truth: SteelTruth) -> Samples:
    """Return a view's share of single-bar pixels and its metrics on them, as ``full_mask_samples`` does.

    ``p_m`` is planar depth on ``truth.index``, metres, NaN where missing. Metrics are empty where the view has no
    such pixel. ``single_bar_views_abs_rel`` is AbsRel on the whole interior of a view that has AbsRel on them.
    """
    count, interior_count = np.count_nonzero(truth.single_bar), np.count_nonzero(truth.interior)
    share = [count / interior_count] if interior_count else []
    scores = region_scores(_REGION.prefix, p_m, truth, truth.single_bar)
    interior = region_scores("interior", p_m, truth, truth.interior)["interior_abs_rel"]
    return {
        "single_bar_share": np.array(share, np.float64),
        **scores,
        _VIEWS_ABS_REL: interior if len(scores["single_bar_abs_rel"]) else np.empty(0),
    }


SINGLE_BAR_MEASURES: tuple[Measure, ...] = (
    Measure(
        "single_bar_share",
        "single_bar_share",
        "mean",
        "Single-bar share of the interior",
        "%",
        "",
        "interior pixels whose 3 x 3 neighbourhood belongs to one bar / interior pixels, by the truth; the other "
        "pixels have a second bar within one pixel, so that errors on them contain the step between the bars",
    ),
    *(region_measure(_REGION, number) for number in REGION_NUMBERS),
    Measure(
        _VIEWS_ABS_REL,
        _VIEWS_ABS_REL,
        "mean",
        "AbsRel, whole interior of the same views",
        "",
        "",
        "mean of interior_abs_rel over the views that have single_bar_abs_rel, to set beside it",
    ),
)
"""Single-bar measures in table order."""
