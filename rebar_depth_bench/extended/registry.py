"""Extended scoring of a submission: the samples of every view, native and scaled, and the config tables."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

from jaxtyping import Float, Float64
from numpy import ndarray

from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.extended import (
    alignment,
    as_built,
    boundary,
    crossings,
    depth_layers,
    inspection,
    point_cloud,
    profiles,
    regions,
)
from rebar_depth_bench.extended.crossings import crossing_samples, view_crossings
from rebar_depth_bench.extended.ground_truth import ConfigSteelTruth, SceneBars, has_bar_ids, steel_truth
from rebar_depth_bench.extended.judged import visible_segments
from rebar_depth_bench.extended.measures import NATIVE, ONCE, SCALED, Measure, Samples, aligned_predictions
from rebar_depth_bench.extended.reach import Reach, reaches
from rebar_depth_bench.extended.result import (
    CrossingsSource,
    ExtendedResult,
    ExtendedTable,
    ExtendedView,
    ViewNumbers,
    tabulate_extended,
    view_numbers,
)
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.parallel import Progress, map_with_progress, silent
from rebar_depth_bench.scoring.bootstrap import resample_views
from rebar_depth_bench.scoring.evaluation import Evaluation
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.submission import SubmissionReader

Predictions = Sequence[Float64[ndarray, " n"]]
"""Predictions of one view under several alignments: metres on ``truth.index``, NaN where missing."""

EvaluateView = Callable[[Predictions, SteelTruth, SceneBars], Iterable[Samples]]
"""Evaluator of a measure family: returns one set of samples per prediction."""


@dataclass(frozen=True)
class MeasureFamily:
    """A group of related measures.

    ``title`` is its heading, ``evaluate`` computes a view's samples, one set per entry of ``alignments``.
    """

    title: str
    measures: tuple[Measure, ...]
    evaluate: EvaluateView
    alignments: tuple[str, ...]

    @property
    def by_name(self) -> dict[str, Measure]:
        """The measures by name."""
        return {measure.name: measure for measure in self.measures}


def _clouds(predictions: Predictions, truth: SteelTruth, _: SceneBars) -> list[Samples]:
    """Return the point cloud samples of each prediction; the true cloud is built once."""
    cloud = point_cloud.true_cloud(truth)
    return [point_cloud.cloud_samples(p_m, truth, cloud) for p_m in predictions]


def _inspection(predictions: Predictions, truth: SteelTruth, bars: SceneBars) -> list[Samples]:
    """Return the inspection samples of each prediction; the visible segments are computed once."""
    visible = visible_segments(truth, bars.cage)
    return [inspection.inspection_samples(p_m, truth, bars.cage, visible) for p_m in predictions]


def _as_built(predictions: Predictions, truth: SteelTruth, bars: SceneBars) -> list[Samples]:
    """Return the samples of deviations from the design of each prediction."""
    return [as_built.as_built_samples(p_m, truth, bars.cage, bars.axes) for p_m in predictions]


def _crossings(predictions: Predictions, truth: SteelTruth, bars: SceneBars) -> list[Samples]:
    """Return the crossing samples of each prediction; the visible parts of bars are computed once."""
    view = view_crossings(truth, bars.crossings)
    return [crossing_samples(p_m, view) for p_m in predictions]


def _profile(predictions: Predictions, truth: SteelTruth, bars: SceneBars) -> list[Samples]:
    """Return the profile samples of each prediction."""
    return [profiles.profile_samples(p_m, truth, bars.diameter_m) for p_m in predictions]


def _per_prediction(samples: Callable[[Float64[ndarray, " n"], SteelTruth], Samples]) -> EvaluateView:
    """Return an evaluator that applies ``samples`` to each prediction of a view."""
    return lambda predictions, truth, _: [samples(p_m, truth) for p_m in predictions]


_BOTH = (NATIVE, SCALED)

MEASURE_FAMILIES: Mapping[str, MeasureFamily] = {
    "alignment": MeasureFamily(
        "Scale against shape", alignment.MEASURES, _per_prediction(alignment.alignment_samples), (ONCE,)
    ),
    "full_mask": MeasureFamily(
        "Rim included", regions.FULL_MASK_MEASURES, _per_prediction(regions.full_mask_samples), _BOTH
    ),
    "single_bar": MeasureFamily(
        "Single-bar interior", regions.SINGLE_BAR_MEASURES, _per_prediction(regions.single_bar_samples), _BOTH
    ),
    "boundary": MeasureFamily("Boundary", boundary.MEASURES, _per_prediction(boundary.boundary_samples), (ONCE,)),
    "layers": MeasureFamily("Layers", depth_layers.MEASURES, _per_prediction(depth_layers.layer_samples), _BOTH),
    "clouds": MeasureFamily("Point clouds", point_cloud.MEASURES, _clouds, _BOTH),
    "inspection": MeasureFamily(
        "Inspection, bar by bar",
        (*inspection.INSPECTION_MEASURES, *inspection.CAPABILITY_MEASURES),
        _inspection,
        _BOTH,
    ),
    "as_built": MeasureFamily("As built against as designed", as_built.MEASURES, _as_built, _BOTH),
    "crossings": MeasureFamily(
        "Crossings", (*crossings.MAIN_MEASURES, *crossings.BINNED_MEASURES), _crossings, _BOTH
    ),
    "profile": MeasureFamily("Against distance and bar width", profiles.MEASURES, _profile, _BOTH),
}
"""Measure families by key, in report order."""


def measures_by_alignment() -> dict[str, tuple[Measure, ...]]:
    """Return the measures of each alignment, in the order of ``MEASURE_FAMILIES``."""
    return {
        alignment: tuple(
            measure
            for family in MEASURE_FAMILIES.values()
            if alignment in family.alignments
            for measure in family.measures
        )
        for alignment in (ONCE, NATIVE, SCALED)
    }


def score_extended(
    result: Result,
    evaluation: Evaluation,
    *,
    workers: int | None = None,
    progress: Progress = silent,
) -> ExtendedResult:
    """Return the extended measures of the submission that ``result`` was computed from.

    All of them are null for a config without masks or bar ids.
    Raises ``DatasetError`` if the dataset folder lacks its bars or contradicts its manifest.
    """
    scales = {view.view_id: view.scale for view in result.views}
    measures = measures_by_alignment()
    tables: dict[str, ExtendedTable] = {}
    views: list[ViewNumbers] = []
    source: CrossingsSource | None = None
    for config in evaluation.configs:
        if not has_bar_ids(config):
            tables[config.name] = tabulate_extended([], resample_views([], by_scene=False), measures)
            continue
        steel = steel_truth(evaluation, config, progress)
        source = CrossingsSource(steel.crossings_source, steel.crossings_sha256)
        work = partial(_view, evaluation.submission, steel, scales)
        task = f"extended measures of {config.name}"
        config_views = map_with_progress(work, range(len(steel)), workers, progress, task, len(steel))
        resampling = resample_views([view.view_id for view in config_views], by_scene=config.has_splits)
        tables[config.name] = tabulate_extended(config_views, resampling, measures)
        views += [view_numbers(view, measures) for view in config_views]
    return ExtendedResult(measures, tables, views, source)


def _view(
    submission: SubmissionReader, steel: ConfigSteelTruth, scales: Mapping[str, float | None], position: int
) -> ExtendedView:
    """Read a view's prediction and return its samples under each alignment."""
    truth = steel.view(position)
    prediction_m = submission.read(truth.view_id)
    bars = steel.bars_by_view[truth.view_id]
    return ExtendedView(truth.view_id, view_samples(prediction_m, truth, bars, scales[truth.view_id]))


def view_samples(
    prediction_m: Float[ndarray, "h w"], truth: SteelTruth, bars: SceneBars, scale: float | None
) -> dict[str, Samples]:
    """Return the samples of all measure families for one view, by alignment.

    ``scale`` is the view's median scale s, None if it has none.
    """
    predictions = aligned_predictions(prediction_m, truth, scale)
    samples: dict[str, dict[str, Float64[ndarray, " n"]]] = {name: {} for name in predictions}
    for family in MEASURE_FAMILIES.values():
        samples_by_alignment = family.evaluate([predictions[name] for name in family.alignments], truth, bars)
        for name, of_alignment in zip(family.alignments, samples_by_alignment, strict=True):
            samples[name].update(of_alignment)
    return dict(samples)


@dataclass(frozen=True)
class ConfigReaches:
    """Reaches of a submission on one config, by alignment, and the file that the crossings come from."""

    source: CrossingsSource
    by_alignment: Mapping[str, tuple[Reach, ...]]

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object: the file of the crossings, and the reaches by alignment."""
        reaches = {name: [reach.to_dict() for reach in of_one] for name, of_one in self.by_alignment.items()}
        return {"crossings": asdict(self.source), **reaches}


def config_reaches(
    evaluation: Evaluation,
    config: DatasetConfig,
    scales: Mapping[str, float | None],
    *,
    workers: int | None = None,
    progress: Progress = silent,
) -> ConfigReaches:
    """Return the reaches on a config that ``has_bar_ids``, native and scaled; ``scales`` holds s by view id.

    Raises ``DatasetError`` as ``load_steel_truth``.
    """
    steel = steel_truth(evaluation, config, progress)

    def view_samples(position: int) -> dict[str, Samples]:
        truth = steel.view(position)
        crossings = view_crossings(truth, steel.bars_by_view[truth.view_id].crossings)
        prediction_m = evaluation.submission.read(truth.view_id)
        predictions = aligned_predictions(prediction_m, truth, scales[truth.view_id])
        return {name: crossing_samples(predictions[name], crossings) for name in (NATIVE, SCALED)}

    task = f"crossings of {config.name}"
    views = map_with_progress(view_samples, range(len(steel)), workers, progress, task, len(steel))
    resampling = resample_views(steel.view_ids, by_scene=config.has_splits)
    found = {name: reaches([samples[name] for samples in views], resampling) for name in (NATIVE, SCALED)}
    return ConfigReaches(CrossingsSource(steel.crossings_source, steel.crossings_sha256), found)
