"""``audit``: every check of a dataset folder, in one pass over its rows."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dataset_builder.audit.files import check_digests, check_files
from dataset_builder.audit.geometry import (
    EpipolarCounts,
    axis_distance_ratio,
    board_error_m,
    epipolar_counts,
    world_points_m,
)
from dataset_builder.audit.report import AuditReport, Check
from dataset_builder.audit.rows import row_problems
from dataset_builder.audit.second_renderer import cycles_difference_m
from dataset_builder.bars_table import read_bars
from dataset_builder.model import Bar
from dataset_builder.protocols import subset
from dataset_builder.publish import BARS
from rebar_depth_bench.dataset import iterate
from rebar_depth_bench.errors import DatasetError, InputError
from rebar_depth_bench.folder import DatasetFolder, open_folder
from rebar_depth_bench.progress import Progress, silent
from rebar_depth_bench.schema import EYES, features

MAX_BOARD_ERROR_M = 1e-6
MAX_AXIS_RATIO = 1.2
"""Ribs stand out of the nominal radius by at most this factor."""
MAX_CONTRADICTED_SHARE = 1e-4
MAX_CYCLES_MEDIAN_M = 1e-6
MAX_CYCLES_OFF_SHARE = 1e-3
CYCLES_OFF_M = 1e-3


def audit(root: str | Path, *, depth_views: int = 4, progress: Progress = silent) -> AuditReport:
    """Check every invariant of a local dataset folder and its ground truth against other sources.

    ``depth_views`` views per config, spread evenly, are rendered again by Cycles' depth pass.
    Raises ``DatasetError`` where the folder cannot be read at all, ``InputError`` for a negative ``depth_views``.
    """
    if depth_views < 0:
        raise InputError(f"--depth-views is {depth_views}, expected 0 or more")
    folder = open_folder(root)
    if folder.local is None:
        raise DatasetError(f"{root}: is not a folder on this machine, expected one to audit")
    files = check_files(folder, folder.local)
    checks = [files, check_digests(folder)]
    if files.passed:  # rows of a damaged folder cannot be judged
        for config in folder.configs:
            checks += _config_checks(folder, folder.local, config, depth_views, progress)
    return AuditReport(str(root), tuple(checks))


def _config_checks(
    folder: DatasetFolder, root: Path, config: str, depth_views: int, progress: Progress
) -> list[Check]:
    entry, records = folder.config(config), folder.views(config)
    steel = read_bars(root / BARS)[entry["scene"]["name"]]
    bar_ids = {bar.bar_id for bar in steel}
    problems: list[str] = []
    geometry = _Geometry(entry, steel)
    again = set(subset(len(records), depth_views) if depth_views else ())
    kept = []
    rows = iterate(root, config, tuple(features()))
    found = 0
    for n, row in enumerate(rows):
        found = n + 1
        if found > len(records):
            continue
        problems += row_problems(row, records[n], entry["rig"], bar_ids)
        geometry.add(row)
        if n in again:
            kept.append(row)
        progress(f"audit of {config}", n + 1, len(records))
    if found != len(records):
        problems.append(f"{config} has {found} rows, the manifest names {len(records)} views")
    checks = [
        Check(f"{config}: rows", f"{found} views", "all invariants", tuple(problems)),
        *geometry.checks(config),
    ]
    if kept:
        off_m = cycles_difference_m(
            root / entry["mesh"], kept, lambda done, total: progress(f"Cycles depth of {config}", done, total)
        )
        checks.append(_cycles_check(config, off_m, len(kept)))
    else:
        checks.append(Check(f"{config}: depth against Cycles", "skipped", "none asked for"))
    return checks


class _Geometry:
    """Gathers the geometric figures of a config's views."""

    def __init__(self, entry: Mapping[str, Any], steel: tuple[Bar, ...]) -> None:
        self._board = entry["scene"]["board"]
        self._axes_are_estimates = entry["scene"]["assembly"]["kind"] == "mesh-file"
        self._steel = steel
        self._axis_ratio = 0.0
        self._board_error_m = 0.0
        self._epipolar = np.zeros(4, dtype=np.int64)

    def add(self, row: Mapping[str, Any]) -> None:
        for eye in EYES:
            points_m = world_points_m(row[f"{eye}_depth"], row[f"{eye}_K"], row[f"{eye}_cam_from_world"])
            ratios = axis_distance_ratio(points_m, row[f"{eye}_bars"], self._steel)
            self._axis_ratio = max(self._axis_ratio, float(ratios.max(initial=0.0)))
            error_m = board_error_m(row, eye, self._board, points_m)
            self._board_error_m = max(self._board_error_m, float(error_m.max(initial=0.0)))
        counts = epipolar_counts(row, self._steel)
        self._epipolar += (counts.seen, counts.hidden, counts.outside, counts.contradicted)

    def checks(self, config: str) -> list[Check]:
        return [self._axis_check(config), self._board_check(config), self._epipolar_check(config)]

    def _axis_check(self, config: str) -> Check:
        problem = f"a steel pixel lies {self._axis_ratio:.3f} nominal radii from its bar's axis"
        if self._axes_are_estimates:  # of a mesh file's parts, which may be bent: a figure, not a verdict
            return Check(f"{config}: steel on its bar's axis", f"at most {self._axis_ratio:.3f} radii", "none")
        return Check(
            f"{config}: steel on its bar's axis",
            f"at most {self._axis_ratio:.3f} radii",
            f"{MAX_AXIS_RATIO} radii",
            (problem,) if self._axis_ratio > MAX_AXIS_RATIO else (),
        )

    def _board_check(self, config: str) -> Check:
        problem = f"a board pixel lies {self._board_error_m * 1e6:.3f} um from z = 0"
        return Check(
            f"{config}: board at z = 0",
            f"at most {self._board_error_m * 1e6:.3f} um",
            f"{MAX_BOARD_ERROR_M * 1e6:g} um",
            (problem,) if self._board_error_m > MAX_BOARD_ERROR_M else (),
        )

    def _epipolar_check(self, config: str) -> Check:
        counts = EpipolarCounts(*self._epipolar.tolist())
        inside = max(counts.seen + counts.hidden + counts.contradicted, 1)
        share = counts.contradicted / inside
        problem = f"{counts.contradicted} of {inside} steel pixels should be seen by the right eye and are not"
        return Check(
            f"{config}: left in right through depth",
            f"{counts.seen / inside:.1%} seen, {counts.hidden / inside:.1%} hidden, {share:.4%} contradicted",
            f"{MAX_CONTRADICTED_SHARE:.2%} contradicted",
            (problem,) if share > MAX_CONTRADICTED_SHARE else (),
        )


def _cycles_check(config: str, off_m: np.ndarray[Any, Any], views: int) -> Check:
    median_m = float(np.median(off_m)) if len(off_m) else 0.0
    share = float(np.mean(off_m > CYCLES_OFF_M)) if len(off_m) else 0.0
    bad = median_m > MAX_CYCLES_MEDIAN_M or share > MAX_CYCLES_OFF_SHARE
    found = (
        f"{views} views: median {median_m * 1e6:.3f} um, 99.9 % {np.quantile(off_m, 0.999) * 1e6:.2f} um, "
        f"{share:.4%} over 1 mm"
        if len(off_m)
        else f"{views} views: no steel"
    )
    return Check(
        f"{config}: depth against Cycles",
        found,
        f"median {MAX_CYCLES_MEDIAN_M * 1e6:g} um, {MAX_CYCLES_OFF_SHARE:.1%} over 1 mm",
        (found,) if bad else (),
    )
