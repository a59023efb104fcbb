"""Scoring of detected crossings against the judged crossings of a dataset's views."""

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
from rebar_depth_bench.detections.reading import DetectionFile, Detections, read_detections
from rebar_depth_bench.detections.tables import (
    AVERAGE_PRECISION_MM,
    DetectionResult,
    ViewDetections,
    tabulate_detections,
)
from rebar_depth_bench.extended.ground_truth import has_bar_ids, load_steel_truth
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
    chosen = _configs(folder, file, configs, path)
    rows_by_view = _rows_by_view(file.detections)
    views: dict[str, list[ViewDetections]] = {}
    tables = {}
    source = None
    for config in chosen:
        steel = load_steel_truth(folder, config, progress)
        source = steel.source

        def compare(position: int) -> ViewDetections:
            truth = steel.view(position)  # noqa: B023 - used within this iteration only
            rows = rows_by_view.get(truth.view_id, np.empty(0, np.int64))
            seen = detections_of_view(file.detections, rows, truth)
            return compare_view(seen, truth, confidence)

        task = f"crossings of {config.name}"
        found = list(map_in_threads(compare, range(len(steel)), task, workers=workers, progress=progress))
        views[config.name] = found
        resampling = resample_views(
            steel.view_ids, by_scene=config.has_splits, views_per_distance=config.views_per_distance
        )
        tables[config.name] = tabulate_detections(found, resampling if found else None)
    assert source is not None
    of_all = [view for of_config in views.values() for view in of_config]
    known = {view.view_id for view in of_all}
    only = tables[chosen[0].name] if len(tables) == 1 else tabulate_detections(of_all, None)
    return DetectionResult(
        meta=file.meta,
        sha256=file.sha256,
        dataset_digest=folder.digest,
        dataset_version=folder.version,
        source=source,
        least_confidence=confidence,
        has_confidence=file.detections.has_confidence,
        pooled=only,
        tables=tables,
        views=of_all,
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


def _rows_by_view(detections: Detections) -> dict[str, Int64[ndarray, " n"]]:
    rows: dict[str, list[int]] = {}
    for row, view_id in enumerate(detections.view_ids):
        rows.setdefault(view_id, []).append(row)
    return {view_id: np.array(of_view) for view_id, of_view in rows.items()}


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


_FAR_M = 1e6
"""Largest coordinate, metres: larger ones are as far from every crossing, and their squares overflow."""


def compare_view(detected: SeenDetections, truth: SteelTruth, least: float | None) -> ViewDetections:
    """Return the detections of one view compared with its crossings; ``least`` is the confidence to match."""
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


# Matching of the detections of one view with its judged crossings. Frame: the left camera's, metres.
#
# "matched_pairs" finds the most pairs within a limit and, among those, the least total distance. "greedy_matches"
# takes detections by descending confidence, each with the nearest free crossing within the limit, for average
# precision. What is left over is a false detection unless "excused" says otherwise.

MATCH_M = 0.010
"""Largest distance of a detection from the tie point that it is matched with, metres."""


def pairs_within(
    detected_m: Float64[ndarray, "n 3"], true_m: Float64[ndarray, "m 3"], limit_m: float
) -> tuple[Int64[ndarray, "p 2"], Float64[ndarray, " p"]]:
    """Return the pairs of a detection and a tie point at most ``limit_m`` apart, and their distances."""
    from scipy.spatial import cKDTree

    if not len(detected_m) or not len(true_m):
        return np.empty((0, 2), np.int64), np.empty(0)
    near = cKDTree(true_m).query_ball_point(detected_m, limit_m * (1 + 1e-9), return_sorted=True)
    counts = [len(found) for found in near]
    crossing = np.array([found for of_one in near for found in of_one], dtype=np.int64)
    pairs = np.column_stack([np.repeat(np.arange(len(detected_m)), counts), crossing])
    distance_m = np.linalg.norm(detected_m[pairs[:, 0]] - true_m[pairs[:, 1]], axis=1)
    return pairs, distance_m


def matched_pairs(
    detected_m: Float64[ndarray, "n 3"], true_m: Float64[ndarray, "m 3"], limit_m: float = MATCH_M
) -> Int64[ndarray, "k 2"]:
    """Return the pairs (detection, tie point) of the largest matching within ``limit_m``, by detection.

    Of several with as many pairs, it has the least total distance. Detections that share no tie point are matched
    apart from each other, which keeps the assignment problems small.
    """
    pairs, distance_m = pairs_within(detected_m, true_m, limit_m)
    groups = _components(pairs, len(detected_m), len(true_m))
    chosen = [_assignment(pairs[members], distance_m[members], limit_m) for members in groups]
    found = np.concatenate([np.empty((0, 2), np.int64), *chosen])
    return np.asarray(found[np.argsort(found[:, 0], kind="stable")])


def _components(pairs: Int64[ndarray, "p 2"], detections: int, crossings: int) -> Sequence[Int64[ndarray, " q"]]:
    """Return the positions of the pairs of each connected group of detections and tie points."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if not len(pairs):
        return []
    size = detections + crossings
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], detections + pairs[:, 1])), shape=(size, size))
    _, label = connected_components(graph, directed=False)
    group = label[pairs[:, 0]]
    order = np.argsort(group, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(group[order])) + 1)


def _assignment(
    pairs: Int64[ndarray, "q 2"], distance_m: Float64[ndarray, " q"], limit_m: float
) -> Int64[ndarray, "k 2"]:
    """Return the best matching of one group."""
    from scipy.optimize import linear_sum_assignment

    if len(pairs) == 1:
        return pairs
    rows, row = np.unique(pairs[:, 0], return_inverse=True)
    columns, column = np.unique(pairs[:, 1], return_inverse=True)
    # Every pair is worth more than all distances together, so that the number of pairs comes first.
    worth_m = limit_m * (min(len(rows), len(columns)) + 1)
    cost_m = np.zeros((len(rows), len(columns)))
    cost_m[row, column] = distance_m - worth_m
    first, second = linear_sum_assignment(cost_m)
    taken = cost_m[first, second] < 0
    return np.column_stack([rows[first[taken]], columns[second[taken]]])


def greedy_matches(
    detected_m: Float64[ndarray, "n 3"],
    confidence: Float64[ndarray, " n"],
    true_m: Float64[ndarray, "m 3"],
    limit_m: float,
) -> Bool[ndarray, " n"]:
    """Return which detections are matched if each takes the nearest free tie point, most confident first.

    Of equally confident ones, the nearest to a tie point comes first, so that the order of rows has no effect.
    """
    pairs, distance_m = pairs_within(detected_m, true_m, limit_m)
    nearest_m = np.full(len(detected_m), np.inf)
    np.minimum.at(nearest_m, pairs[:, 0], distance_m)
    order = np.lexsort((nearest_m, -confidence))
    by_distance = np.lexsort((distance_m, pairs[:, 0]))
    first = np.searchsorted(pairs[by_distance, 0], np.arange(len(detected_m) + 1))
    free = np.ones(len(true_m), dtype=bool)
    matched = np.zeros(len(detected_m), dtype=bool)
    for detection in order.tolist():
        candidates = pairs[by_distance[first[detection] : first[detection + 1]], 1]
        available = candidates[free[candidates]]
        if len(available):
            free[available[0]] = False
            matched[detection] = True
    return matched


def excused(
    detected_m: Float64[ndarray, "n 3"],
    left_over: Bool[ndarray, " n"],
    all_m: Float64[ndarray, "c 3"],
    is_judged: Bool[ndarray, " c"],
    priority: Float64[ndarray, " n"],
) -> Bool[ndarray, " n"]:
    """Return which detections that are left over are ignored.

    The nearest of all crossings of the scene is not judged and within ``MATCH_M``; each such crossing excuses one
    detection, that with the highest ``priority`` and, of equal ones, the nearest.
    """
    from scipy.spatial import cKDTree

    ignored = np.zeros(len(detected_m), dtype=bool)
    if not len(all_m) or not left_over.any():
        return ignored
    distance_m, nearest = cKDTree(all_m).query(detected_m)
    candidates = np.flatnonzero(left_over & (distance_m <= MATCH_M * (1 + 1e-9)) & ~is_judged[nearest])
    order = candidates[np.lexsort((distance_m[candidates], -priority[candidates]))]
    _, first = np.unique(nearest[order], return_index=True)
    ignored[order[first]] = True
    return ignored
