"""Registry of the extended measures, and extended scoring: the samples of every view and the config tables.

Every module of this package that has ``FAMILIES`` adds its measures: no other file lists them.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Iterable, Mapping
from dataclasses import replace
from importlib import import_module

from jaxtyping import Float, Float64
from numpy import ndarray

from rebar_depth_bench import extended
from rebar_depth_bench.base.parallel import Progress, silent
from rebar_depth_bench.extended.ground_truth import has_bar_ids, steel_truth
from rebar_depth_bench.extended.measures import (
    NATIVE,
    ONCE,
    SCALED,
    Measure,
    MeasureFamily,
    Samples,
    aligned_predictions,
)
from rebar_depth_bench.extended.result import ExtendedResult, ViewSamples, tabulate_extended, view_numbers
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.scoring.bootstrap import resample_views
from rebar_depth_bench.scoring.evaluation import Evaluation, score_evaluation
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.table import ViewScore


def _families() -> list[MeasureFamily]:
    """Return the families that the modules of the package declare, in report order."""
    names = [module.name for module in pkgutil.iter_modules(extended.__path__)]
    modules = [import_module(f"{extended.__name__}.{name}") for name in names if name != "registry"]
    families = [family for module in modules for family in getattr(module, "FAMILIES", ())]
    return sorted(families, key=lambda family: (family.place, family.key))


MEASURE_FAMILIES: Mapping[str, MeasureFamily] = {family.key: family for family in _families()}
"""Measure families by key, in report order."""


def measures_by_alignment(
    families: Iterable[MeasureFamily] = MEASURE_FAMILIES.values(),
) -> dict[str, tuple[Measure, ...]]:
    """Return the measures of each alignment, in the order of the families."""
    return {
        alignment: tuple(
            measure for family in families if alignment in family.alignments for measure in family.measures
        )
        for alignment in (ONCE, NATIVE, SCALED)
    }


def score_extended(
    evaluation: Evaluation,
    families: Iterable[MeasureFamily] = MEASURE_FAMILIES.values(),
    *,
    workers: int | None = None,
    progress: Progress = silent,
) -> Result:
    """Return the result of an open submission as ``score_evaluation``, with its extended measures.

    Each prediction is read once. All extended measures are null for a config without masks or bar ids.
    Raises ``DatasetError`` if the dataset folder lacks its bars or contradicts its manifest, and
    ``SubmissionError`` for predictions that are not metric.
    """
    evaluation.require_metric("extended measures are in metres")
    families = tuple(families)
    steel = {
        config.name: steel_truth(evaluation, config, progress)
        for config in evaluation.configs
        if has_bar_ids(config)
    }
    places = {view_id: (one, place) for one in steel.values() for place, view_id in enumerate(one.view_ids)}
    samples: dict[str, ViewSamples] = {}

    def add(prediction_m: Float[ndarray, "h w"], score: ViewScore) -> None:
        if score.view_id in places:
            of_config, place = places[score.view_id]
            samples[score.view_id] = view_samples(prediction_m, of_config.view(place), score.scale, families)

    result = score_evaluation(evaluation, workers=workers, progress=progress, use_view=add)
    measures = measures_by_alignment(families)
    tables, source = {}, None
    for config in evaluation.configs:
        view_ids: tuple[str, ...] = ()
        if config.name in steel:
            view_ids, source = steel[config.name].view_ids, steel[config.name].source
        resampling = resample_views(
            view_ids, by_scene=config.has_splits, views_per_distance=config.views_per_distance
        )
        tables[config.name] = tabulate_extended([samples[view_id] for view_id in view_ids], resampling, measures)
    views = {view_id: view_numbers(samples[view_id], measures) for view_id in places}
    return replace(result, extended=ExtendedResult(measures, tables, views, source))


def view_samples(
    prediction_m: Float[ndarray, "h w"],
    truth: SteelTruth,
    scale: float | None,
    families: Iterable[MeasureFamily] = MEASURE_FAMILIES.values(),
) -> ViewSamples:
    """Return the samples of measure families for one view, by alignment.

    ``scale`` is the view's median scale s, None if it has none.
    """
    samples: dict[str, Samples] = {}
    families = tuple(families)
    for alignment, p_m in aligned_predictions(prediction_m, truth, scale).items():
        of_alignment: dict[str, Float64[ndarray, " n"]] = {}
        for family in {family.evaluate: family for family in families if alignment in family.alignments}.values():
            of_alignment |= family.evaluate(prediction_m if family.on_image else p_m, truth)
        samples[alignment] = of_alignment
    return samples
