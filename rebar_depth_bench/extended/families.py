"""Families of extended measures in report order, the samples of a view, and the measures of all configs."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from rebar_depth_bench.bar_crossings.crossings_file import CrossingsSource
from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.extended import (
    alignment,
    as_built,
    boundary,
    crossings,
    depth_layers,
    disparity,
    inspection,
    point_cloud,
    profiles,
    published,
    regions,
)
from rebar_depth_bench.extended.estimates import (
    ExtendedResult,
    ExtendedTable,
    ViewMeasures,
    ViewSamples,
    tabulate_extended,
    view_measures,
)
from rebar_depth_bench.extended.judged import visible_segments
from rebar_depth_bench.extended.measures import NATIVE, ONCE, SCALED, Measure, MeasureFamily
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.scoring.bootstrap import resample_views
from rebar_depth_bench.scoring.metrics import is_valid_prediction

FAMILIES = (
    MeasureFamily("alignment", "Scale against shape", alignment.MEASURES, (ONCE,), "own alignment, see the row"),
    MeasureFamily("published", "Errors as papers print them", published.ERROR_MEASURES),
    MeasureFamily("disparity", "Disparity of rectified pairs", disparity.MEASURES),
    MeasureFamily("full_mask", "Rim included", regions.FULL_MASK_MEASURES),
    MeasureFamily("single_bar", "Single-bar interior", regions.SINGLE_BAR_MEASURES),
    MeasureFamily("boundary", "Boundary", boundary.MEASURES, (ONCE,), "independent of scale"),
    MeasureFamily(
        "published_boundary",
        "Boundary as papers print it",
        published.BOUNDARY_MEASURES,
        (ONCE,),
        "whole image, independent of scale",
    ),
    MeasureFamily("layers", "Layers", depth_layers.MEASURES),
    MeasureFamily("clouds", "Point clouds", point_cloud.MEASURES),
    MeasureFamily("inspection", "Inspection, bar by bar", inspection.MEASURES),
    MeasureFamily("as_built", "As built against as designed", as_built.MEASURES),
    MeasureFamily("crossings", "Crossings", crossings.MEASURES),
    MeasureFamily("profile", "Against distance and bar width", profiles.MEASURES),
)
"""All measure families, in report order; ``view_samples`` computes the samples of their measures."""

MEASURE_FAMILIES: Mapping[str, MeasureFamily] = {family.key: family for family in FAMILIES}
"""The measure families by key."""


def measures_by_alignment() -> dict[str, tuple[Measure, ...]]:
    """Return the measures of each alignment, in the order of the families."""
    return {
        of_alignment: tuple(
            measure for family in FAMILIES if of_alignment in family.alignments for measure in family.measures
        )
        for of_alignment in (ONCE, NATIVE, SCALED)
    }


def view_samples(prediction_m: Float[ndarray, "h w"], truth: SteelTruth, scale: float) -> ViewSamples:
    """Return the samples of all measures for one view, by alignment.

    ``prediction_m`` is planar depth in metres as submitted, and ``scale`` the view's median scale s, NaN if it has
    none.
    """
    native_m = truth.predicted_m(prediction_m)
    with np.errstate(over="ignore"):
        scaled_m = native_m * scale
    scaled_m[~is_valid_prediction(scaled_m)] = np.nan

    samples = {
        ONCE: {
            **alignment.alignment_samples(native_m, truth),
            **boundary.boundary_samples(native_m, truth),
            **published.image_boundary_samples(prediction_m, truth),
        }
    }
    # The ground truth that the two predictions share is computed once.
    cloud = point_cloud.true_cloud(truth)
    visible = visible_segments(truth)
    pairs = inspection.visible_pairs(visible, truth.bars.cage)
    designed = as_built.designed_segments(truth, visible)
    crossed = crossings.view_crossings(truth)
    for of_alignment, p_m in ((NATIVE, native_m), (SCALED, scaled_m)):
        samples[of_alignment] = {
            **published.error_samples(p_m, truth),
            **disparity.disparity_samples(p_m, truth),
            **regions.region_samples(p_m, truth),
            **depth_layers.layer_samples(p_m, truth),
            **point_cloud.cloud_samples(p_m, cloud),
            **inspection.inspection_samples(p_m, visible, pairs),
            **as_built.as_built_samples(p_m, designed),
            **crossings.crossing_samples(p_m, crossed),
            **profiles.profile_samples(p_m, truth),
        }
    return samples


def extended_result(
    configs: Mapping[str, tuple[DatasetConfig, CrossingsSource | None, Mapping[str, ViewSamples]]],
) -> ExtendedResult:
    """Return the extended measures of a submission from the samples of the views of each config, by view id.

    All measures are null for a config without masks or bar ids, which has no samples and no source of crossings.
    """
    measures = measures_by_alignment()
    tables: dict[str, ExtendedTable] = {}
    views: dict[str, ViewMeasures] = {}
    source = None
    for name, (config, of_config, samples) in configs.items():
        resampling = resample_views(
            tuple(samples), by_scene=config.has_splits, views_per_distance=config.views_per_distance
        )
        tables[name] = tabulate_extended(list(samples.values()), resampling, measures)
        views |= {view_id: view_measures(of_view, measures) for view_id, of_view in samples.items()}
        source = of_config or source
    return ExtendedResult(measures, tables, views, source)
