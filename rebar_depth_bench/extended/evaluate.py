"""Extended measures of an archive: every view's samples, native and scaled, and the tables they make."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64
from numpy import ndarray

from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.extended import alignment, boundary, depth_layers, full_mask, point_cloud, profiles
from rebar_depth_bench.extended.ground_truth import SteelConfig, steel_config
from rebar_depth_bench.extended.inspection import evaluate as inspection
from rebar_depth_bench.extended.inspection import measures as capabilities
from rebar_depth_bench.extended.inspection.visible_segments import seen_runs
from rebar_depth_bench.extended.measures import Measure, Samples
from rebar_depth_bench.extended.result import (
    ExtendedResult,
    ExtendedTable,
    ExtendedView,
    ViewNumbers,
    tabulate_extended,
    view_numbers,
)
from rebar_depth_bench.extended.steel_truth import SteelTruth
from rebar_depth_bench.parallel import ordered_map
from rebar_depth_bench.progress import Progress, silent
from rebar_depth_bench.scoring.metrics import is_prediction
from rebar_depth_bench.scoring.result import Result, protocol_indices
from rebar_depth_bench.submission import SubmissionReader, open_submission

ONCE, NATIVE, SCALED = "once", "native", "scaled"
"""Alignments: what no scale changes or what brings its own; the prediction as it stands; s times it."""

Predictions = Sequence[Float64[ndarray, " n"]]
"""The same view's prediction under several alignments: metres on ``truth.index``, NaN for none."""

Evaluate = Callable[[Predictions, SteelTruth, SteelConfig], Iterable[Samples]]


@dataclass(frozen=True)
class Family:
    """Measures that belong together: what they are called, how a view is evaluated, under which alignments."""

    title: str
    measures: tuple[Measure, ...]
    evaluate: Evaluate
    alignments: tuple[str, ...]


def _clouds(predictions: Predictions, truth: SteelTruth, _: SteelConfig) -> list[Samples]:
    cloud = point_cloud.true_cloud(truth)
    return [point_cloud.cloud_samples(p_m, truth, cloud) for p_m in predictions]


def _inspection(predictions: Predictions, truth: SteelTruth, config: SteelConfig) -> list[Samples]:
    seen = seen_runs(truth, config.cage)
    return [inspection.inspection_samples(p_m, truth, config.cage, seen) for p_m in predictions]


def _profile(predictions: Predictions, truth: SteelTruth, config: SteelConfig) -> list[Samples]:
    return [profiles.profile_samples(p_m, truth, config.diameter_m) for p_m in predictions]


def _each(samples: Callable[[Float64[ndarray, " n"], SteelTruth], Samples]) -> Evaluate:
    return lambda predictions, truth, _: [samples(p_m, truth) for p_m in predictions]


_BOTH = (NATIVE, SCALED)

FAMILIES: Mapping[str, Family] = {
    "alignment": Family("Scale against shape", alignment.MEASURES, _each(alignment.alignment_samples), (ONCE,)),
    "full_mask": Family("Rim included", full_mask.MEASURES, _each(full_mask.full_mask_samples), _BOTH),
    "boundary": Family("Boundary", boundary.MEASURES, _each(boundary.boundary_samples), (ONCE,)),
    "layers": Family("Layers", depth_layers.MEASURES, _each(depth_layers.layer_samples), _BOTH),
    "clouds": Family("Point clouds", point_cloud.MEASURES, _clouds, _BOTH),
    "inspection": Family(
        "Inspection, bar by bar", (*inspection.MEASURES, *capabilities.MEASURES), _inspection, _BOTH
    ),
    "profile": Family("Against distance and bar width", profiles.MEASURES, _profile, _BOTH),
}


def measures_by_alignment() -> dict[str, tuple[Measure, ...]]:
    """Return the measures of each alignment, in the order of ``FAMILIES``."""
    return {
        alignment: tuple(
            measure
            for family in FAMILIES.values()
            if alignment in family.alignments
            for measure in family.measures
        )
        for alignment in (ONCE, NATIVE, SCALED)
    }


def score_extended(
    result: Result,
    archive: str | os.PathLike[str],
    root: str | Path,
    *,
    workers: int | None = None,
    progress: Progress = silent,
) -> ExtendedResult:
    """Return the extended measures of the archive that ``result`` came from.

    Raises ``DatasetError`` if the folder lacks its bars or contradicts its manifest.
    """
    folder = open_folder(root)
    scales = {view.view_id: view.scale for view in result.views}
    measures = measures_by_alignment()
    tables: dict[str, ExtendedTable] = {}
    views: list[ViewNumbers] = []
    with open_submission(archive, folder.expected_views()) as submission:
        for config in result.tables:
            steel = steel_config(folder, config, progress)
            work = partial(_view, submission, steel, scales)
            outcomes = ordered_map(work, range(len(steel)), workers)
            found = []
            for done, view in enumerate(outcomes, start=1):
                found.append(view)
                progress(f"extended measures of {config}", done, len(steel))
            tables[config] = tabulate_extended(found, protocol_indices([view.view_id for view in found]), measures)
            views += [view_numbers(view, measures) for view in found]
    return ExtendedResult(measures, tables, views)


def _view(
    submission: SubmissionReader, steel: SteelConfig, scales: Mapping[str, float | None], place: int
) -> ExtendedView:
    truth = steel.view(place)
    prediction_m = submission.read(truth.view_id)
    return ExtendedView(truth.view_id, view_samples(prediction_m, truth, steel, scales[truth.view_id]))


def view_samples(
    prediction_m: Float[ndarray, "h w"], truth: SteelTruth, steel: SteelConfig, scale: float | None
) -> dict[str, Samples]:
    """Return every family's samples of one view under each alignment; ``scale`` is the view's s, None for none."""
    gathered = prediction_m.ravel().take(truth.index.astype(np.intp))
    native_m = np.where(is_prediction(gathered), gathered.astype(np.float64), np.nan)
    with np.errstate(over="ignore"):
        scaled_m = native_m * (np.nan if scale is None else scale)
    scaled_m[~is_prediction(scaled_m)] = np.nan
    predictions = {ONCE: native_m, NATIVE: native_m, SCALED: scaled_m}
    samples: dict[str, dict[str, Float64[ndarray, " n"]]] = {name: {} for name in predictions}
    for family in FAMILIES.values():
        found = family.evaluate([predictions[name] for name in family.alignments], truth, steel)
        for name, of_alignment in zip(family.alignments, found, strict=True):
            samples[name].update(of_alignment)
    return dict(samples)
