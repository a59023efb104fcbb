"""Audit of a dataset folder: files, all checks in one pass over the rows, and checks of imported configs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

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
    EyeWithRays,
    RayCache,
    eye_with_rays,
    record_problems,
    view_from_row,
)
from dataset_builder.audit.geometry import (
    axis_distances_m,
    axis_verdict,
    board_error,
    board_verdict,
    cage_checks,
    max_axis_distance_ratio,
    planes_check,
)
from dataset_builder.audit.independent_depth import (
    cycles_difference_m,
    cycles_verdict,
    epipolar_counts,
    epipolar_verdict,
    project_into,
)
from dataset_builder.cameras.trajectories import subset
from dataset_builder.pipeline.plan import BUILD_FOLDER
from rebar_depth_bench.bar_crossings.crossings_file import CROSSINGS_FILE, folder_crossings
from rebar_depth_bench.bar_crossings.definition import Crossings, scene_crossings
from rebar_depth_bench.base.errors import DatasetError, InputError
from rebar_depth_bench.base.parallel import Progress, silent
from rebar_depth_bench.data.bars import BARS_FILE, Bar, read_bars, with_axis
from rebar_depth_bench.data.files import file_problems, local_folder
from rebar_depth_bench.data.manifest import DatasetConfig, DatasetFolder, open_folder
from rebar_depth_bench.data.rows import EyeTruth, iterate_rows
from rebar_depth_bench.data.schema import Imported, ViewRecord
from rebar_depth_bench.geometry.cameras import camera_centre
from rebar_depth_bench.scoring.protocol import interior

_CROSSING_TOLERANCE_M = 1e-9
"""Largest difference between stored crossings and crossings computed from the bars."""
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
    """Yield the checks of a config; each check covers all scenes of the config.

    Depth is rendered again in ``SAMPLED_SCENES`` scenes.
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
    yield Check("cameras", f"{len(expected)} poses of the trajectory", "equal to 1e-12", tuple(camera_faults))
    yield planes_check(config, mesh)
    for check, _, measurements in measured:
        yield check.verdict(audited, measurements)
    difference_and_depth_m = cycles_difference_m(
        mesh, cycles_eyes, lambda done, total: progress(f"Cycles depth of {config.label}", done, total)
    )
    yield cycles_verdict(difference_and_depth_m, len(cycles_eyes) // 2)


# Imported configs: rows against the manifest, cameras, surveyed bars, and both eyes. What the ground truth was
# measured with is not known here, so nothing is compared with a renderer. Distances are compared with the standard
# deviation of the depth that the config states.

SIGMAS = 4.0
"""Largest deviation of a point from where it should be, in standard deviations of the depth."""
MIN_SHARE = 0.95
"""Smallest share of points within ``SIGMAS``; a survey and a segmentation have outliers."""
_BASELINE_TOLERANCE_M = 1e-6
_FIELD_OF_VIEW_DEG = (2.0, 170.0)
_MAX_ASPECT_DEVIATION = 0.03


@dataclass
class _Deviations:
    """Numbers of points compared, and of those within ``SIGMAS``."""

    points: int = 0
    within: int = 0

    def add(self, deviation_m: Float64[ndarray, " n"], allowed_m: float) -> None:
        """Count points."""
        self.points += len(deviation_m)
        self.within += int(np.count_nonzero(deviation_m <= allowed_m))

    def check(self, name: str, reason: str) -> Check:
        """Return the check of the share within the limit; it is skipped for a ``reason`` without points."""
        if not self.points:
            return Check.skip(name, reason)
        share = self.within / self.points
        problem = f"{self.points - self.within} of {self.points} points are farther off"
        bound = f"{MIN_SHARE:.0%} within {SIGMAS:g} standard deviations"
        return Check(name, f"{share:.1%} within", bound, (problem,) if share < MIN_SHARE else ())


def imported_checks(
    config: DatasetConfig, imported: Imported, bars: tuple[Bar, ...], progress: Progress
) -> Iterator[Check]:
    """Yield the checks of an imported config with the ``bars`` of its scene, in one pass over its rows."""
    row_faults, camera_faults = list[str](), list[str]()
    from_axes, between_eyes = _Deviations(), _Deviations()
    ids = {bar.bar_id for bar in bars}
    surveyed = with_axis(bars) if imported.has_poses else ()
    allowed_m, rays = SIGMAS * imported.truth_sigma_m, RayCache()
    rows = enumerate(iterate_rows(config, AUDITED_COLUMNS), start=1)
    for record, (done, row) in zip(config.views, rows, strict=True):
        eyes = {eye: eye_with_rays(row, eye, rays) for eye in config.truth_eyes}
        row_faults += [f"{record.view_id}: {one}" for one in record_problems(row["view_id"], eyes, record)]
        for eye, truth in eyes.items():
            row_faults += [f"{record.view_id}: {eye}: {one}" for one in _truth_problems(truth, ids)]
            _compare_with_axes(truth, surveyed, allowed_m, from_axes)
        camera_faults += [f"{record.view_id}: {one}" for one in _imported_camera_problems(row, config)]
        if "right" in eyes:
            _compare_eyes(eyes["left"], eyes["right"], allowed_m, between_eyes)
        progress(f"audit of {config.name}", done, len(config.views))
    yield Check("rows", f"{len(config.views)} views", "all invariants", tuple(row_faults))
    yield Check("cameras", f"{len(config.views)} views", "plausible", tuple(camera_faults))
    reason = "no bar ids, no surveyed bars, or no poses"
    yield from_axes.check("steel from the surface of its surveyed bar", reason)
    yield between_eyes.check("left depth against right depth", "no depth of the right camera")
    yield Check.skip("depth against a second source", "imported")


def _truth_problems(truth: EyeTruth, bar_ids: set[int]) -> Iterator[str]:
    """Yield the problems of the ground truth of one eye: no depth, bar ids without steel or bar."""
    if not (truth.depth_m > 0).any():
        yield "no pixel has depth"
    if truth.mask is not None and truth.mask.any() and not (truth.depth_m[truth.mask] > 0).any():
        yield "no steel pixel has depth"
    if truth.bars is not None and truth.mask is not None:
        if (truth.bars[~truth.mask] > 0).any():
            yield "pixels beside the steel have bar ids"
        if unknown := sorted(set(np.unique(truth.bars).tolist()) - bar_ids - {0}):
            yield f"bar ids {unknown[:5]} are not in bars.parquet"


def _imported_camera_problems(row: Mapping[str, Any], config: DatasetConfig) -> Iterator[str]:
    """Yield what is wrong with the cameras of a row."""
    height, width = config.grid
    eyes = [eye for eye in ("left", "right") if row[f"{eye}_K"] is not None]
    for eye in eyes:
        (fx, _, cx), (_, fy, cy), last = row[f"{eye}_K"].tolist()
        field_deg = np.degrees(2 * np.arctan(width / 2 / fx)) if fx > 0 else np.inf
        if not _FIELD_OF_VIEW_DEG[0] <= field_deg <= _FIELD_OF_VIEW_DEG[1] or last != [0, 0, 1]:
            yield f"{eye}: the field of view is {field_deg:.1f} degrees"
        elif abs(fx / fy - 1) > _MAX_ASPECT_DEVIATION:
            yield f"{eye}: fx is {fx / fy:.3f} times fy"
        if not (-0.5 <= cx <= width - 0.5 and -0.5 <= cy <= height - 0.5):
            yield f"{eye}: the principal point ({cx:.1f}, {cy:.1f}) is outside the image"
    if len(eyes) == 2:
        centres_m = [camera_centre(row[f"{eye}_cam_from_world"]) for eye in eyes]
        distance_m = float(np.linalg.norm(centres_m[1] - centres_m[0]))
        if abs(distance_m - row["baseline_m"]) > _BASELINE_TOLERANCE_M:
            yield f"the cameras are {distance_m:.6f} m apart, baseline_m is {row['baseline_m']:.6f}"


def _compare_with_axes(eye: EyeWithRays, bars: Sequence[Bar], allowed_m: float, found: _Deviations) -> None:
    """Compare interior steel pixels of bars with a known axis with the surface of a cylinder around it."""
    if eye.bars is None or eye.mask is None or not bars:
        return
    usable = interior(eye.mask) & (eye.depth_m > 0)
    for bar, distance_m in axis_distances_m(eye.points_m[usable], eye.bars[usable], bars):
        found.add(np.abs(distance_m - bar.diameter_m / 2), allowed_m)


def _compare_eyes(left: EyeWithRays, right: EyeWithRays, allowed_m: float, found: _Deviations) -> None:
    """Compare left points with the nearest depth of the 2 x 2 right pixels around them, unless one is in front."""
    projected = project_into(right, left.points_m[left.depth_m > 0], margin_px=0)
    u, v = np.floor(projected.px[projected.inside]).astype(int).T
    z_m = projected.depth_m[projected.inside]
    around_m = np.stack([right.depth_m[v + dv, u + du] for dv in (0, 1) for du in (0, 1)], axis=1)
    off_m = np.where(around_m > 0, np.abs(around_m - z_m[:, None]), np.inf).min(axis=1)
    is_hidden = ((around_m > 0) & (around_m < z_m[:, None] - allowed_m)).any(axis=1)
    found.add(off_m[np.isfinite(off_m) & ~(is_hidden & (off_m > allowed_m))], allowed_m)
