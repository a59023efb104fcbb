"""Scoring of a file of detected crossings: ``score_crossings`` compares each view with its judged crossings."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from rebar_depth_bench.base.errors import InputError, escape_text
from rebar_depth_bench.base.names import TEST_SPLIT, config_of, split_of
from rebar_depth_bench.base.parallel import Progress, map_in_threads, silent
from rebar_depth_bench.data.manifest import DatasetConfig, DatasetFolder, open_folder
from rebar_depth_bench.detections.matching import (
    HEADLINE_MM,
    LIMITS_MM,
    Points,
    ViewCrossings,
    random_points,
)
from rebar_depth_bench.detections.reading import DetectionFile, Detections, read_detections
from rebar_depth_bench.detections.tables import (
    DetectionResult,
    DetectionTable,
    ViewDetections,
    tabulate_detections,
)
from rebar_depth_bench.extended.ground_truth import ConfigSteelTruth, has_bar_ids, load_steel_truth
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.geometry.cameras import transform
from rebar_depth_bench.scoring.bootstrap import resample_views


def score_crossings(
    path: str | os.PathLike[str],
    root: str | Path,
    *,
    configs: Sequence[str] | None = None,
    confidence: float | None = None,
    declared: Mapping[str, object] | None = None,
    workers: int | None = None,
    progress: Progress = silent,
) -> DetectionResult:
    """Score a CSV or Parquet file of detected crossings (``detections.reading``) against a dataset.

    The configs of the file's views are scored, or ``configs``; views without rows have no detections. Detections
    with at least ``confidence`` are counted (default: all); average precision uses all of them. ``declared``
    replaces the file's metadata. Raises ``SubmissionError`` with all problems of the file, ``InputError`` for a
    file without rows and without ``configs``, and ``DatasetError`` for the dataset.
    """
    folder = open_folder(root)
    file = read_detections(Path(path), folder.expected_views(), declared)
    rows_by_view: dict[str, list[int]] = {}
    for row, view_id in enumerate(file.detections.view_ids):
        rows_by_view.setdefault(view_id, []).append(row)
    views: list[ViewDetections] = []
    tables: dict[str, DetectionTable] = {}
    source = None
    for config in _configs(folder, file, configs, path):
        steel = load_steel_truth(folder, config, progress)
        source = steel.source

        by_view = [file.detections.of(rows_by_view.get(view_id, [])) for view_id in steel.view_ids]
        compare = partial(_compare_at, steel, by_view, confidence)
        count, task = len(steel), f"crossings of {config.name}"
        found = list(map_in_threads(compare, range(count), count, task, workers=workers, progress=progress))
        resampling = None
        if found:
            resampling = resample_views(
                steel.view_ids, by_scene=config.has_splits, views_per_distance=config.views_per_distance
            )
        tables[config.name] = tabulate_detections(found, resampling)
        views += found
    assert source is not None
    known = {view.view_id for view in views}
    return DetectionResult(
        meta=file.meta,
        sha256=file.sha256,
        dataset_digest=folder.digest,
        dataset_version=folder.version,
        source=source,
        least_confidence=confidence,
        has_confidence=file.detections.has_confidence,
        pooled=tabulate_detections(views, None) if len(tables) > 1 else next(iter(tables.values())),
        tables=tables,
        views=views,
        outside=sum(len(rows) for view_id, rows in rows_by_view.items() if view_id not in known),
    )


def _compare_at(
    steel: ConfigSteelTruth, by_view: Sequence[Detections], least: float | None, position: int
) -> ViewDetections:
    return compare_view(by_view[position], least, steel.view(position))


def _configs(
    folder: DatasetFolder, file: DetectionFile, wanted: Sequence[str] | None, path: object
) -> list[DatasetConfig]:
    """Return the configs to score, each restricted to the split of the file's rows."""
    splits = {config_of(view_id): split_of(view_id) for view_id in set(file.detections.view_ids)}
    names = list(dict.fromkeys(wanted)) if wanted else [name for name in folder.configs if name in splits]
    if not names:
        raise InputError(f"{path}: has no rows, expected some, or --config with the configs that it was made for")
    if left_out := sorted(splits.keys() - set(names)):
        raise InputError(f"{path}: has rows of {', '.join(left_out)}, expected only those of {', '.join(names)}")
    configs = []
    for name in names:
        config = folder.config(name)
        if not has_bar_ids(config):
            raise InputError(f"{folder.root}: config {escape_text(name)} has no bar ids, which judge crossings")
        configs.append(config.of_split(splits.get(name) or TEST_SPLIT) if config.has_splits else config)
    return configs


_FAR_M = 1e6
"""Largest coordinate, metres: larger ones are as far from every crossing, and their squares overflow."""


def compare_view(detections: Detections, least: float | None, truth: SteelTruth) -> ViewDetections:
    """Compare the detections of one view, in order of their rows, with its crossings, and random points with both.

    Detections with a confidence of ``least`` or more count for the headline, all of them if it is None.
    """
    point_m, normal, confidence = detections.point_m, detections.normal, detections.confidence
    if detections.is_world:
        with np.errstate(over="ignore", invalid="ignore"):
            point_m = transform(truth.cam_from_world, point_m)
            point_m = np.where(np.isfinite(point_m), point_m, _FAR_M)
        normal = normal @ truth.cam_from_world[:3, :3].T
    crossings = ViewCrossings.of_view(truth)
    all_points = Points.in_view(np.clip(point_m, -_FAR_M, _FAR_M)[None], truth, crossings)
    counts, is_correct = {}, {}
    for limit_mm in LIMITS_MM:
        correct, ignored = all_points.match(crossings, confidence, limit_mm / 1000)
        counts[limit_mm], is_correct[limit_mm] = ~ignored[0], correct[0]

    chosen = np.flatnonzero(confidence >= (-np.inf if least is None else least))
    points = all_points.of(chosen)
    correct, ignored = points.match(crossings, confidence[chosen], HEADLINE_MM / 1000)
    sums = {name: float(values[0]) for name, values in points.sums(crossings, correct, ignored).items()}
    found = np.flatnonzero(correct[0])
    true_normal = truth.bars.crossings.crossings.normal[points.nearest[0, found]] @ truth.cam_from_world[:3, :3].T
    cosine = np.abs(np.einsum("ki,ki->k", normal[chosen[found]], true_normal))

    # As many random points as detections that count, at the headline and for each average precision.
    headline_count = round(sums["matched"] + sums["false"])
    size = max(headline_count, *(np.count_nonzero(of_limit) for of_limit in counts.values()))
    random = Points.in_view(random_points(truth, size), truth, crossings)
    equal = np.ones(size)
    headline = random.of(np.arange(headline_count))
    correct, ignored = headline.match(crossings, equal[:headline_count], HEADLINE_MM / 1000)
    chance = headline.sums(crossings, correct, ignored)
    chance_position_mm = 1000 * headline.distance_m[correct]
    chance_at = {}
    for limit_mm, of_limit in counts.items():
        count = np.count_nonzero(of_limit)
        correct, ignored = random.of(np.arange(count)).match(crossings, equal[:count], limit_mm / 1000)
        chance_at[limit_mm] = np.column_stack([correct.sum(axis=1), (~ignored).sum(axis=1)])
    return ViewDetections(
        view_id=truth.view_id,
        sums=sums,
        position_mm=1000 * points.distance_m[0, found],
        normal_deg=np.rad2deg(np.arccos(np.minimum(cosine[~np.isnan(cosine)], 1.0))),
        confidence=confidence,
        counts=counts,
        correct=is_correct,
        chance=chance,
        chance_at=chance_at,
        chance_position_mm=chance_position_mm,
    )
