"""Registry of the extended measures, and extended scoring: the samples of every view and the config tables.

Every module of this package that has ``FAMILIES`` adds its measures: no other file lists them.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Iterable, Mapping
from importlib import import_module

from jaxtyping import Float, Float64
from numpy import ndarray

from rebar_depth_bench import extended
from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.extended.estimates import (
    ExtendedResult,
    ExtendedTable,
    ViewNumbers,
    ViewSamples,
    tabulate_extended,
    view_numbers,
)
from rebar_depth_bench.extended.ground_truth import ConfigSteelTruth
from rebar_depth_bench.extended.measures import (
    NATIVE,
    ONCE,
    SCALED,
    Measure,
    MeasureFamily,
    Samples,
    aligned_predictions,
)
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.scoring.bootstrap import resample_views


def _families() -> list[MeasureFamily]:
    """Return the families that the modules of the package declare, in report order."""
    names = [module.name for module in pkgutil.iter_modules(extended.__path__)]
    modules = [import_module(f"{extended.__name__}.{name}") for name in names if name != "families"]
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


def extended_result(
    configs: Mapping[str, tuple[DatasetConfig, ConfigSteelTruth | None, Mapping[str, ViewSamples]]],
    families: Iterable[MeasureFamily] = MEASURE_FAMILIES.values(),
) -> ExtendedResult:
    """Return the extended measures of a submission from the samples of the views of each config, by id.

    All measures are null for a config without masks or bar ids, which has no steel and no samples.
    """
    measures = measures_by_alignment(families)
    tables: dict[str, ExtendedTable] = {}
    views: dict[str, ViewNumbers] = {}
    source = None
    for name, (config, steel, samples) in configs.items():
        resampling = resample_views(
            tuple(samples), by_scene=config.has_splits, views_per_distance=config.views_per_distance
        )
        tables[name] = tabulate_extended(list(samples.values()), resampling, measures)
        views |= {view_id: view_numbers(of_view, measures) for view_id, of_view in samples.items()}
        source = source if steel is None else steel.source
    return ExtendedResult(measures, tables, views, source)
