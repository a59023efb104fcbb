"""Checks of an imported config: its rows against the manifest, cameras, surveyed bars, and both eyes.

What the ground truth was measured with is not known here, so nothing is compared with a renderer. Distances are
compared with the standard deviation of the depth that the config states.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.audit.checks import Check
from dataset_builder.audit.geometry import polyline_distance_m
from rebar_depth_bench.data.bars import Bar, with_axis
from rebar_depth_bench.data.columns import COLUMNS
from rebar_depth_bench.data.config_tables import Imported, ViewRecord
from rebar_depth_bench.data.dataset import iterate_rows
from rebar_depth_bench.data.dataset_config import DatasetConfig
from rebar_depth_bench.data.eye_view import EyeTruth, truth_from_row
from rebar_depth_bench.geometry.cameras import camera_centre, inverse_rigid, pixel_rays, project, transform
from rebar_depth_bench.progress import Progress
from rebar_depth_bench.scoring.protocol import interior, scored_pixels

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


@dataclass
class _Findings:
    """Problems and deviations of all rows."""

    rows: list[str] = field(default_factory=list)
    cameras: list[str] = field(default_factory=list)
    axes: _Deviations = field(default_factory=_Deviations)
    eyes: _Deviations = field(default_factory=_Deviations)


def imported_checks(
    config: DatasetConfig, imported: Imported, bars: tuple[Bar, ...], progress: Progress
) -> Iterator[Check]:
    """Yield the checks of an imported config with the ``bars`` of its scene, in one pass over its rows."""
    findings, name = _Findings(), config.name
    ids = {bar.bar_id for bar in bars}
    axes = {bar.bar_id: bar for bar in with_axis(bars)} if imported.has_poses else {}
    columns = [column for column in COLUMNS if column != "left_preview"]
    rows = enumerate(iterate_rows(config, columns), start=1)
    for record, (done, row) in zip(config.views, rows, strict=True):
        truths = {eye: truth_from_row(row, eye) for eye in config.truth_eyes}
        findings.rows += [f"{record.view_id}: {one}" for one in _row_problems(row, record, truths, ids)]
        findings.cameras += [f"{record.view_id}: {one}" for one in _camera_problems(row, config)]
        for truth in truths.values():
            _compare_with_axes(truth, axes, imported.truth_sigma_m, findings.axes)
        if "right" in truths:
            _compare_eyes(truths["left"], truths["right"], imported.truth_sigma_m, findings.eyes)
        progress(f"audit of {name}", done, len(config.views))
    yield Check(f"{name}: rows", f"{len(config.views)} views", "all invariants", tuple(findings.rows))
    yield Check(f"{name}: cameras", f"{len(config.views)} views", "plausible", tuple(findings.cameras))
    reason = "no bar ids, no surveyed bars, or no poses"
    yield findings.axes.check(f"{name}: steel from the surface of its surveyed bar", reason)
    yield findings.eyes.check(f"{name}: left depth against right depth", "no depth of the right camera")
    yield Check.skip(f"{name}: depth against a second source", "imported")


def _row_problems(
    row: Mapping[str, Any], record: ViewRecord, truths: Mapping[str, EyeTruth], bar_ids: set[int]
) -> Iterator[str]:
    """Yield the problems of a decoded row: differences from the manifest, bar ids without steel or bar."""
    if row["view_id"] != record.view_id:
        yield f"the row's view_id is {row['view_id']}, expected {record.view_id}"
    for eye, truth in truths.items():
        if truth.digest() != getattr(record, eye):
            yield f"{eye} ground-truth digest differs from the manifest's"
        if not (truth.depth_m > 0).any():
            yield f"{eye}: no pixel has depth"
        if truth.mask is not None and truth.mask.any() and not (truth.depth_m[truth.mask] > 0).any():
            yield f"{eye}: no steel pixel has depth"
        if truth.bars is not None and truth.mask is not None:
            if (truth.bars[~truth.mask] > 0).any():
                yield f"{eye}: pixels beside the steel have bar ids"
            if unknown := sorted(set(np.unique(truth.bars).tolist()) - bar_ids - {0}):
                yield f"{eye}: bar ids {unknown[:5]} are not in bars.parquet"
    left = truths["left"]
    steel_px = None if left.mask is None else int(np.count_nonzero(left.mask))
    if (steel_px, len(scored_pixels(left.mask, left.depth_m))) != (record.steel_px, record.scored_px):
        yield "steel and scored pixel counts differ from the manifest's"


def _camera_problems(row: Mapping[str, Any], config: DatasetConfig) -> Iterator[str]:
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


def _points_cam(truth: EyeTruth) -> Float64[ndarray, "h w 3"]:
    camera = truth.camera
    rays = pixel_rays(camera.K, camera.width, camera.height, camera.distortion)
    return np.asarray(rays * truth.depth_m[..., None].astype(np.float64))


def _compare_with_axes(truth: EyeTruth, axes: Mapping[int, Bar], sigma_m: float, found: _Deviations) -> None:
    """Compare interior steel pixels of bars with a known axis with the surface of a cylinder around it."""
    if truth.bars is None or truth.mask is None or not axes:
        return
    points_m = transform(inverse_rigid(truth.camera.cam_from_world), _points_cam(truth))
    usable = interior(truth.mask) & (truth.depth_m > 0)
    for bar_id, bar in axes.items():
        on_bar_m = points_m[usable & (truth.bars == bar_id)]
        if len(on_bar_m):
            distance_m = polyline_distance_m(on_bar_m, np.array(bar.axis_m))
            found.add(np.abs(distance_m - bar.diameter_m / 2), SIGMAS * sigma_m)


def _compare_eyes(left: EyeTruth, right: EyeTruth, sigma_m: float, found: _Deviations) -> None:
    """Compare left points with the nearest depth of the 2 x 2 right pixels around them, unless one is in front."""
    points_m = transform(inverse_rigid(left.camera.cam_from_world), _points_cam(left)[left.depth_m > 0])
    points_cam = transform(right.camera.cam_from_world, points_m)
    points_cam = points_cam[points_cam[:, 2] > 0]
    corner = np.floor(project(right.camera.K, points_cam, right.camera.distortion)).astype(int)
    height, width = right.depth_m.shape
    inside = ((corner >= 0) & (corner < (width - 1, height - 1))).all(axis=1)
    u, v = corner[inside].T
    z_m = points_cam[inside, 2]
    around_m = np.stack([right.depth_m[v + dv, u + du] for dv in (0, 1) for du in (0, 1)], axis=1)
    off_m = np.where(around_m > 0, np.abs(around_m - z_m[:, None]), np.inf).min(axis=1)
    allowed_m = SIGMAS * sigma_m
    is_hidden = ((around_m > 0) & (around_m < z_m[:, None] - allowed_m)).any(axis=1)
    found.add(off_m[np.isfinite(off_m) & ~(is_hidden & (off_m > allowed_m))], allowed_m)
