"""Scoring of a file of detected crossings: ``score_crossings`` compares each view with its judged crossings."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from rebar_depth_bench.base.errors import InputError, escape_text
from rebar_depth_bench.base.names import TEST_SPLIT, config_of, split_of
from rebar_depth_bench.base.parallel import Progress, map_in_threads, silent
from rebar_depth_bench.data.manifest import DatasetConfig, DatasetFolder, open_folder
from rebar_depth_bench.detections.matching import excused, greedy_matches, matched_pairs
from rebar_depth_bench.detections.reading import DetectionFile, Detections, read_detections
from rebar_depth_bench.detections.tables import (
    AVERAGE_PRECISION_MM,
    DetectionResult,
    DetectionTable,
    ViewDetections,
    tabulate_detections,
)
from rebar_depth_bench.extended.ground_truth import ConfigSteelTruth, has_bar_ids, load_steel_truth
from rebar_depth_bench.extended.judged import shown_bars
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
    with at least ``confidence`` are matched (default: all); average precision uses all of them. ``declared``
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

        def compare_at(position: int, steel: ConfigSteelTruth = steel) -> ViewDetections:
            truth = steel.view(position)
            rows = np.array(rows_by_view.get(truth.view_id, ()), dtype=np.int64)
            return compare_view(detections_of_view(file.detections, rows, truth), truth, confidence)

        count, task = len(steel), f"crossings of {config.name}"
        found = list(map_in_threads(compare_at, range(count), count, task, workers=workers, progress=progress))
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


@dataclass(frozen=True, eq=False)
class SeenDetections:
    """Detections of one view in its left camera frame, metres; ``normal`` is NaN where none is given."""

    point_m: Float64[ndarray, "n 3"]
    normal: Float64[ndarray, "n 3"]
    confidence: Float64[ndarray, " n"]

    def of(self, rows: Bool[ndarray, " n"]) -> SeenDetections:
        """Return some of the detections."""
        return SeenDetections(self.point_m[rows], self.normal[rows], self.confidence[rows])


def detections_of_view(detections: Detections, rows: Int64[ndarray, " n"], truth: SteelTruth) -> SeenDetections:
    """Return the detections of a view, in its camera frame."""
    point_m, normal = detections.point_m[rows], detections.normal[rows]
    if detections.is_world:
        with np.errstate(over="ignore", invalid="ignore"):
            point_m = transform(truth.cam_from_world, point_m)
            point_m = np.where(np.isfinite(point_m), point_m, _FAR_M)
        normal = normal @ truth.cam_from_world[:3, :3].T
    return SeenDetections(np.clip(point_m, -_FAR_M, _FAR_M), normal, detections.confidence[rows])


def compare_view(detected: SeenDetections, truth: SteelTruth, least: float | None) -> ViewDetections:
    """Compare the detections of one view with its crossings.

    Detections with a confidence of ``least`` or more are matched, all of them if it is None.
    """
    scene = truth.bars.crossings.crossings
    all_m = transform(truth.cam_from_world, scene.tie_point_m)
    judged = truth.judged.crossing
    is_judged = np.zeros(len(scene), dtype=bool)
    is_judged[judged] = True
    true_m = all_m[judged]
    chosen = detected if least is None else detected.of(detected.confidence >= least)
    pairs = matched_pairs(chosen.point_m, true_m)
    left_over = np.ones(len(chosen.point_m), dtype=bool)
    left_over[pairs[:, 0]] = False
    hidden = left_over & _show_bars_without_axis(chosen.point_m, truth)
    no_priority = np.zeros(len(left_over))
    ignored = hidden | excused(chosen.point_m, left_over & ~hidden, all_m, is_judged, no_priority)
    normal = scene.normal[judged] @ truth.cam_from_world[:3, :3].T
    cosine = np.abs(np.einsum("ki,ki->k", chosen.normal[pairs[:, 0]], normal[pairs[:, 1]]))
    offset_m = chosen.point_m[pairs[:, 0]] - true_m[pairs[:, 1]]
    counts, correct = {}, {}
    for limit in AVERAGE_PRECISION_MM:
        matched = greedy_matches(detected.point_m, detected.confidence, true_m, limit / 1000)
        hidden = ~matched & _show_bars_without_axis(detected.point_m, truth)
        others = excused(detected.point_m, ~matched & ~hidden, all_m, is_judged, detected.confidence)
        counts[limit], correct[limit] = ~(hidden | others), matched
    return ViewDetections(
        view_id=truth.view_id,
        judged=len(judged),
        nodes=len(np.unique(scene.node_id[judged])),
        nodes_found=len(np.unique(scene.node_id[judged[pairs[:, 1]]])),
        detections=len(chosen.point_m),
        matched=len(pairs),
        ignored=int(np.count_nonzero(ignored)),
        position_mm=1000 * np.linalg.norm(offset_m, axis=1),
        normal_deg=np.rad2deg(np.arccos(np.minimum(cosine[~np.isnan(cosine)], 1.0))),
        confidence=detected.confidence,
        counts=counts,
        correct=correct,
    )


def _show_bars_without_axis(point_m: Float64[ndarray, "n 3"], truth: SteelTruth) -> Bool[ndarray, " n"]:
    """Return which points project onto a pixel of a bar whose axis is not known."""
    shown = shown_bars(truth, point_m)
    return np.asarray((shown > 0) & np.isnan(truth.bars.diameter_m[shown]))
