"""Audit of a dataset folder: its files, and every check in one pass over the rows of each config."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from dataset_builder.audit.camera_checks import (
    camera_problems,
    checked_aim_point_m,
    expected_views,
    projection_verdict,
    view_list_problems,
    view_projection_error_px,
)
from dataset_builder.audit.checks import (
    AUDITED_COLUMNS,
    AuditedConfig,
    AuditedEye,
    AuditedView,
    AuditReport,
    Check,
    RayCache,
    record_problems,
    view_from_row,
)
from dataset_builder.audit.geometry import (
    axis_verdict,
    board_error,
    board_verdict,
    cage_checks,
    max_axis_distance_ratio,
)
from dataset_builder.audit.imported import imported_checks
from dataset_builder.audit.independent_depth import (
    cycles_difference_m,
    cycles_verdict,
    epipolar_counts,
    epipolar_verdict,
)
from dataset_builder.cameras.trajectories import subset
from dataset_builder.pipeline.plan import BUILD_FOLDER
from rebar_depth_bench.bar_crossings.definition import Crossings, scene_crossings
from rebar_depth_bench.bar_crossings.table import CROSSINGS_FILE, folder_crossings
from rebar_depth_bench.base.errors import DatasetError, InputError
from rebar_depth_bench.base.parallel import Progress, silent
from rebar_depth_bench.data.bars import BARS_FILE, Bar, read_bars
from rebar_depth_bench.data.files import file_problems, local_folder
from rebar_depth_bench.data.manifest import DatasetConfig, DatasetFolder, open_folder
from rebar_depth_bench.data.rows import iterate_rows
from rebar_depth_bench.data.schema import ViewRecord

_CROSSING_TOLERANCE_M = 1e-9
"""Largest difference of crossings from those of the bars."""
SAMPLED_SCENES = 8
"""Scenes of a config of several scenes in which depth is rendered again."""


def check_files(folder: DatasetFolder, root: Path, progress: Progress) -> Check:
    """Check that every file of the manifest exists with its SHA-256, and that the folder has no other file."""
    problems = [str(problem) for problem in file_problems(folder, progress)]
    if (root / BUILD_FOLDER).exists():
        problems.append(
            f"{BUILD_FOLDER}: the folder contains an unfinished build; run rebar-build again or remove it"
        )
    return Check("files against the manifest", f"{len(folder.files)} files", "all SHA-256 equal", tuple(problems))


def check_crossings(folder: DatasetFolder, bars: Mapping[str, tuple[Bar, ...]]) -> Check:
    """Check that the table of crossings holds the crossings of the bars, to ``_CROSSING_TOLERANCE_M``."""
    if CROSSINGS_FILE not in folder.files:
        return Check("crossings of the bars", "none", f"the folder has no {CROSSINGS_FILE}")
    stored, _ = folder_crossings(folder, bars)
    expected = {
        scene: crossings for scene, of_scene in bars.items() if len(crossings := scene_crossings(of_scene))
    }
    problems = [
        f"{CROSSINGS_FILE}: scene {scene} differs from the crossings of its bars"
        for scene in sorted({*stored, *expected})
        if not _are_equal(stored.get(scene), expected.get(scene))
    ]
    total = sum(len(crossings) for crossings in expected.values())
    return Check("crossings of the bars", f"{total} crossings", "equal to 1 nm", tuple(problems))


def _are_equal(stored: Crossings | None, expected: Crossings | None) -> bool:
    if stored is None or expected is None or len(stored) != len(expected):
        return False
    return all(
        np.allclose(getattr(stored, field.name), getattr(expected, field.name), rtol=0, atol=_CROSSING_TOLERANCE_M)
        for field in fields(Crossings)
    )


def row_problems(view: AuditedView, record: ViewRecord, bar_ids: set[int]) -> Iterator[str]:
    """Yield the problems of a view's row: masks, bar ids, differences from the manifest."""
    for name, eye in view.eyes.items():
        for problem in _ground_truth_problems(eye, bar_ids):
            yield f"{name}: {problem}"
    yield from record_problems(view.view_id, view.eyes, record)


def _ground_truth_problems(eye: AuditedEye, bar_ids: set[int]) -> Iterator[str]:
    if not np.array_equal(eye.mask, eye.bars > 0):
        yield "the mask differs from the pixels that have a bar id"
    if (eye.depth_m[eye.mask] <= 0).any():
        yield "steel pixels without depth"
    unknown = set(np.unique(eye.bars[eye.mask]).tolist()) - bar_ids
    if unknown:
        yield f"bar ids {sorted(unknown)[:5]} are not in bars.parquet"


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
    ViewCheck(board_error, board_verdict),
    ViewCheck(epipolar_counts, epipolar_verdict),
    # The camera check compares K and distortion of every view, so a few views suffice for the lens model.
    ViewCheck(view_projection_error_px, projection_verdict, views=12),
)
"""Checks of every view, in the order of the report."""


def audit(root: str | Path, *, depth_views: int = 4, progress: Progress = silent) -> AuditReport:
    """Check every invariant of a local dataset folder, and its ground truth against independent sources.

    ``depth_views`` evenly spaced views per config are rendered again with Cycles' depth pass. The rows are not
    checked if a file is damaged or missing. Raises ``DatasetError`` if the folder or a row cannot be read or the
    rows are not the views of the manifest, and ``InputError`` for a negative ``depth_views``.
    """
    if depth_views < 0:
        raise InputError(f"--depth-views is {depth_views}, expected 0 or more")
    path = local_folder(root)
    folder = open_folder(path)
    checks = [check_files(folder, path, progress)]
    if checks[0].passed:  # Rows of damaged files cannot be checked.
        bars = read_bars(path / BARS_FILE)
        checks.append(check_crossings(folder, bars))
        for config in folder.config_by_name.values():
            of_config = _config_checks(config, path, bars, depth_views, progress)
            checks += [replace(check, name=f"{config.name}: {check.name}") for check in of_config]
    return AuditReport(str(root), tuple(checks))


def _config_checks(
    config: DatasetConfig, root: Path, bars: Mapping[str, tuple[Bar, ...]], depth_views: int, progress: Progress
) -> Iterator[Check]:
    """Yield the checks of a config; those of several scenes are made of all scenes together.

    Depth is rendered again in ``SAMPLED_SCENES`` of them.
    """
    if config.imported is not None:
        yield from imported_checks(config, config.imported, bars.get(config.scene.name, ()), progress)
        return
    if not config.has_splits:
        yield from _scene_checks(config, root, _steel(config, bars), depth_views, progress)
        return
    scenes = config.by_scene()
    sampled = set(subset(len(scenes), SAMPLED_SCENES))
    by_scene: dict[str, list[Check]] = {}
    for number, scene in enumerate(scenes):
        steel, views = _steel(scene, bars), depth_views if number in sampled else 0
        by_scene[scene.label] = [*cage_checks(scene, steel), *_scene_checks(scene, root, steel, views, silent)]
        progress(f"audit of {config.name}", number + 1, len(scenes))
    yield from _merged_checks(by_scene)


def _merged_checks(by_scene: Mapping[str, Sequence[Check]]) -> Iterator[Check]:
    """Yield one check for each check of the scenes, which are the same in all of them.

    A check that is skipped in all scenes is skipped for the reason of the first one.
    """
    for group in zip(*by_scene.values(), strict=True):
        made = [check for check in group if not check.skipped]
        if not made:
            yield group[0]
            continue
        problems = (
            f"{scene}: {one}" for scene, check in zip(by_scene, group, strict=True) for one in check.problems
        )
        measured = f"{sum(check.passed for check in made)} of {len(made)} scenes, such as: {made[0].measured}"
        yield Check(made[0].name, measured, made[0].bound, tuple(problems))


def _steel(config: DatasetConfig, bars: Mapping[str, tuple[Bar, ...]]) -> tuple[Bar, ...]:
    """Return the bars of a scene; raise ``DatasetError`` if there are none."""
    if config.scene.name not in bars:
        raise DatasetError(f"{config.root}: {BARS_FILE} has no bars of scene {config.scene.name}, expected some")
    return bars[config.scene.name]


def _scene_checks(
    config: DatasetConfig, root: Path, steel: tuple[Bar, ...], depth_views: int, progress: Progress
) -> Iterator[Check]:
    """Yield the checks of a config of one scene, or restricted to one scene, with the bars ``steel``."""
    mesh = root / config.mesh
    audited = AuditedConfig(config.scene.appearance.variants, steel, config.scene.board)
    aim_m, aim_problems = checked_aim_point_m(config, mesh)
    expected = expected_views(config, aim_m, steel)
    row_faults, camera_faults = list[str](), [*aim_problems, *view_list_problems(config, expected)]
    measured = [(check, set(subset(len(config.views), check.views)), list[Any]()) for check in VIEW_CHECKS]
    rendered = set(subset(len(config.views), depth_views) if depth_views else ())
    cycles_eyes: list[AuditedEye] = []
    bar_ids, rays = {bar.bar_id for bar in steel}, RayCache()
    for n, (record, row) in enumerate(zip(config.views, iterate_rows(config, AUDITED_COLUMNS), strict=True)):
        view = view_from_row(row, rays)
        row_faults += [f"{record.view_id}: {problem}" for problem in row_problems(view, record, bar_ids)]
        if n < len(expected):
            camera_faults += [f"{record.view_id}: {problem}" for problem in camera_problems(row, expected[n])]
        for check, selected, measurements in measured:
            if n in selected:
                measurements.append(check.measure(audited, view))
        if n in rendered:
            cycles_eyes += [view.left, view.right]
        progress(f"audit of {config.label}", n + 1, len(config.views))
    yield Check("rows", f"{len(config.views)} views", "all invariants", tuple(row_faults))
    yield Check("cameras", f"{len(expected)} poses of the protocol", "equal to 1e-12", tuple(camera_faults))
    for check, _, measurements in measured:
        yield check.verdict(audited, measurements)
    difference_and_depth_m = cycles_difference_m(
        mesh, cycles_eyes, lambda done, total: progress(f"Cycles depth of {config.label}", done, total)
    )
    yield cycles_verdict(difference_and_depth_m, len(cycles_eyes) // 2)
