"""Audit of a dataset folder: runs every check in one pass over the rows of each config."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dataset_builder.audit.cameras import (
    ExpectedView,
    camera_problems,
    checked_aim_point_m,
    expected_views,
    projection_verdict,
    view_list_problems,
    view_projection_error_px,
)
from dataset_builder.audit.cycles_depth import cycles_difference_m, cycles_verdict
from dataset_builder.audit.files import check_crossings, check_files, row_problems
from dataset_builder.audit.geometry import axis_verdict, board_verdict, max_axis_distance_ratio, view_board_error
from dataset_builder.audit.imported import imported_checks
from dataset_builder.audit.report import AuditReport, Check
from dataset_builder.audit.scenes import cage_checks, merged_checks
from dataset_builder.audit.stereo_consistency import epipolar_counts, epipolar_verdict
from dataset_builder.audit.views import AuditedConfig, AuditedEye, AuditedView, RayCache, view_from_row
from dataset_builder.config.trajectories import subset
from rebar_depth_bench.data.bars import BARS_FILE, Bar, read_bars
from rebar_depth_bench.data.columns import COLUMNS
from rebar_depth_bench.data.dataset import iterate_rows
from rebar_depth_bench.data.dataset_config import DatasetConfig
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.errors import DatasetError, InputError
from rebar_depth_bench.progress import Progress, silent


@dataclass(frozen=True)
class ViewCheck:
    """Check over the views of a config: ``measure`` is applied to each view, ``verdict`` to all measurements.

    ``views`` evenly spaced views of a config are measured, all of them if it is None.
    """

    measure: Callable[[AuditedConfig, AuditedView], Any]
    verdict: Callable[[AuditedConfig, Sequence[Any]], Check]
    views: int | None = None


VIEW_CHECKS: tuple[ViewCheck, ...] = (
    ViewCheck(max_axis_distance_ratio, axis_verdict),
    ViewCheck(view_board_error, board_verdict),
    ViewCheck(epipolar_counts, epipolar_verdict),
    # The camera check compares K and distortion of every view, so a few views suffice for the lens model.
    ViewCheck(view_projection_error_px, projection_verdict, views=12),
)
"""Checks of every view, in the order of the report."""


_NOT_AUDITED = {"left_preview"}
SAMPLED_SCENES = 8
"""Scenes of a config of several scenes in which depth is rendered again."""


def audit(root: str | Path, *, depth_views: int = 4, progress: Progress = silent) -> AuditReport:
    """Check every invariant of a local dataset folder, and its ground truth against independent sources.

    ``depth_views`` evenly spaced views per config are rendered again with Cycles' depth pass. The rows are not
    checked if a file is damaged or missing. Raises ``DatasetError`` if the folder or a row cannot be read or the
    rows are not the views of the manifest, and ``InputError`` for a negative ``depth_views``.
    """
    if depth_views < 0:
        raise InputError(f"--depth-views is {depth_views}, expected 0 or more")
    folder = open_folder(root)
    if folder.local is None:
        raise DatasetError(f"{root}: is not a local folder, expected a dataset folder on this machine")
    files = check_files(folder, folder.local, progress)
    checks = [files]
    if files.passed:  # Rows of damaged files cannot be checked.
        bars = read_bars(folder.local / BARS_FILE)
        checks.append(check_crossings(folder, bars))
        for config in folder.config_by_name.values():
            checks += _config_checks(config, folder.local, bars, depth_views, progress)
    return AuditReport(str(root), tuple(checks))


_SceneBars = Mapping[str, tuple[Bar, ...]]


def _config_checks(
    config: DatasetConfig, root: Path, bars: _SceneBars, depth_views: int, progress: Progress
) -> Iterator[Check]:
    """Yield the checks of a config; those of several scenes are made of all scenes together.

    Depth is rendered again in ``SAMPLED_SCENES`` of them.
    """
    if config.imported is not None:
        yield from imported_checks(config, config.imported, bars.get(config.scene.name, ()), progress)
        return
    if not config.has_splits:
        yield from _scene_checks(config, root, bars, depth_views, progress)
        return
    scenes = config.by_scene()
    sampled = set(subset(len(scenes), SAMPLED_SCENES))
    checks: list[Check] = []
    for number, scene in enumerate(scenes):
        views = depth_views if number in sampled else 0
        checks += cage_checks(scene, _steel(scene, bars))
        checks += _scene_checks(scene, root, bars, views, silent)
        progress(f"audit of {config.name}", number + 1, len(scenes))
    yield from merged_checks(config.name, checks)


def _steel(config: DatasetConfig, bars: _SceneBars) -> tuple[Bar, ...]:
    """Return the bars of a scene; raise ``DatasetError`` if there are none."""
    if config.scene.name not in bars:
        raise DatasetError(f"{config.root}: {BARS_FILE} has no bars of scene {config.scene.name}, expected some")
    return bars[config.scene.name]


def _scene_checks(
    config: DatasetConfig, root: Path, bars: _SceneBars, depth_views: int, progress: Progress
) -> Iterator[Check]:
    """Yield the checks of a config of one scene, or restricted to one scene."""
    name, mesh, steel = config.label, root / config.mesh, _steel(config, bars)
    variants, board = config.scene.appearance.variants, config.scene.board
    audited = AuditedConfig(name, variants, steel, board)
    aim_m, aim_problems = checked_aim_point_m(config, mesh)
    expected = expected_views(config, aim_m, steel)
    accumulator = _AuditAccumulator(config, audited, expected, depth_views)
    for row in iterate_rows(config, [column for column in COLUMNS if column not in _NOT_AUDITED]):
        accumulator.add(row)
        progress(f"audit of {name}", accumulator.rows, len(config.views))
    yield accumulator.rows_check()
    camera_faults = (*aim_problems, *view_list_problems(config, expected), *accumulator.cameras)
    yield Check(f"{name}: cameras", f"{len(expected)} poses of the protocol", "equal to 1e-12", camera_faults)
    for check, measurements in zip(VIEW_CHECKS, accumulator.measurements, strict=True):
        yield check.verdict(audited, measurements)
    cycles_eyes = accumulator.cycles_eyes
    difference_and_depth_m = cycles_difference_m(
        mesh, cycles_eyes, lambda done, total: progress(f"Cycles depth of {name}", done, total)
    )
    yield cycles_verdict(name, difference_and_depth_m, len(cycles_eyes) // 2)


class _AuditAccumulator:
    """Accumulator over a config's rows: problems, measurements of every check, and eyes to render in Cycles."""

    def __init__(
        self,
        config: DatasetConfig,
        audited: AuditedConfig,
        expected: Sequence[ExpectedView],
        depth_views: int,
    ) -> None:
        self._config, self._audited, self._expected = config, audited, expected
        self._bar_ids = {bar.bar_id for bar in audited.steel}
        self._rays = RayCache()
        self._measured = [set(subset(len(config.views), check.views)) for check in VIEW_CHECKS]
        self._cycles_indices = set(subset(len(config.views), depth_views) if depth_views else ())
        self._problems: list[str] = []
        self.rows = 0
        self.cameras: list[str] = []
        self.measurements: list[list[Any]] = [[] for _ in VIEW_CHECKS]
        self.cycles_eyes: list[AuditedEye] = []

    def add(self, row: Mapping[str, Any]) -> None:
        """Check and measure the next row."""
        n = self.rows
        self.rows += 1
        record = self._config.views[n]
        view_id = record.view_id
        self._problems += [f"{view_id}: {problem}" for problem in row_problems(row, record, self._bar_ids)]
        if n < len(self._expected):
            self.cameras += [f"{view_id}: {problem}" for problem in camera_problems(row, self._expected[n])]
        view = view_from_row(row, self._rays)
        for check, measurements, selected in zip(VIEW_CHECKS, self.measurements, self._measured, strict=True):
            if n in selected:
                measurements.append(check.measure(self._audited, view))
        if n in self._cycles_indices:
            self.cycles_eyes += [view.left, view.right]

    def rows_check(self) -> Check:
        """Return the check of the rows' invariants."""
        return Check(f"{self._config.label}: rows", f"{self.rows} views", "all invariants", tuple(self._problems))
