"""Families of extended measures in report order, the samples of a view, and the measures of all configs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from rebar_depth_bench.bar_crossings.crossings_file import CrossingsSource
from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.extended import (
    alignment,
    boundary,
    crossings,
    disparity,
    inspection,
    point_cloud,
    published,
    single_bar,
)
from rebar_depth_bench.extended.estimates import (
    ExtendedResult,
    ExtendedTable,
    ViewMeasures,
    ViewSamples,
    tabulate_extended,
    view_measures,
)
from rebar_depth_bench.extended.frames import SteelFrames, joined
from rebar_depth_bench.extended.measures import NATIVE, ONCE, SCALED, Measure, MeasureFamily
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.scoring.bootstrap import resample_views
from rebar_depth_bench.scoring.metrics import is_valid_prediction

FAMILIES = (
    MeasureFamily("alignment", "Scale against shape", alignment.MEASURES, (ONCE,), "own alignment, see the row"),
    MeasureFamily("published", "Errors as papers print them", published.ERROR_MEASURES),
    MeasureFamily("disparity", "Disparity of rectified pairs", disparity.MEASURES),
    MeasureFamily("single_bar", "Single-bar interior", single_bar.MEASURES),
    MeasureFamily("boundary", "Boundary", boundary.MEASURES, (ONCE,), "independent of scale"),
    MeasureFamily(
        "published_boundary",
        "Boundary as papers print it",
        published.BOUNDARY_MEASURES,
        (ONCE,),
        "whole image, independent of scale",
    ),
    MeasureFamily("clouds", "Point clouds", point_cloud.MEASURES),
    MeasureFamily("inspection", "Inspection, bar by bar", inspection.MEASURES, (NATIVE,)),
    MeasureFamily("as_built", "As built against as designed", inspection.AS_BUILT_MEASURES, (NATIVE,)),
    MeasureFamily("crossings", "Crossings", crossings.MEASURES, (NATIVE,)),
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


def view_samples(
    prediction_m: Float[ndarray, "h w"], truth: SteelTruth, scale: float, frames: SteelFrames
) -> ViewSamples:
    """Return the samples of all measures for one view, by alignment.

    ``prediction_m`` is planar depth in metres as submitted, ``scale`` the view's median scale s, NaN if it has
    none, and ``frames`` are the samples of the bars and crossings of the view.
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
    cloud = point_cloud.true_cloud(truth)
    for of_alignment, p_m in ((NATIVE, native_m), (SCALED, scaled_m)):
        samples[of_alignment] = {
            **published.error_samples(p_m, truth),
            **disparity.disparity_samples(p_m, truth),
            **single_bar.single_bar_samples(p_m, truth),
            **point_cloud.cloud_samples(p_m, cloud),
        }
    steel = frames.native.predicted
    samples[NATIVE] |= {
        **inspection.inspection_samples(steel.bars, steel.spacings),
        **inspection.as_built_samples(steel.bars),
        **crossings.crossing_samples(steel.crossings),
    }
    return samples


@dataclass(frozen=True)
class ExtendedViews:
    """Samples of the views of a config by view id, and its source of crossings.

    There are none for a config without masks or bar ids. ``frames`` are the samples of bars and crossings of each
    view, in the same order.
    """

    config: DatasetConfig
    crossings: CrossingsSource | None
    samples: Mapping[str, ViewSamples]
    frames: Sequence[SteelFrames]


def extended_result(configs: Sequence[ExtendedViews]) -> ExtendedResult:
    """Return the extended measures of a submission; all measures are null for a config without samples."""
    measures = measures_by_alignment()
    tables: dict[str, ExtendedTable] = {}
    views: dict[str, ViewMeasures] = {}
    for one in configs:
        resampling = resample_views(
            tuple(one.samples), by_scene=one.config.has_splits, views_per_distance=one.config.views_per_distance
        )
        tables[one.config.name] = tabulate_extended(list(one.samples.values()), resampling, measures)
        views |= {view_id: view_measures(of_view, measures) for view_id, of_view in one.samples.items()}
    return ExtendedResult(
        measures,
        tables,
        views,
        frames={one.config.name: joined(one.frames) for one in configs if one.frames},
        scenes={
            one.config.name: {view_id: one.config.scene_by_view[view_id] for view_id in one.samples}
            for one in configs
        },
        crossings=next((one.crossings for one in configs if one.crossings is not None), None),
    )
