"""Checks of an imported config: its rows against the manifest, cameras, surveyed bars, and both eyes.

What the ground truth was measured with is not known here, so nothing is compared with a renderer. Distances are
compared with the standard deviation of the depth that the config states.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.audit.checks import (
    AUDITED_COLUMNS,
    Check,
    EyeWithRays,
    RayCache,
    eye_with_rays,
    record_problems,
)
from dataset_builder.audit.geometry import axis_distances_m
from dataset_builder.audit.independent_depth import project_into
from rebar_depth_bench.base.parallel import Progress
from rebar_depth_bench.data.bars import Bar, with_axis
from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.data.rows import EyeTruth, iterate_rows
from rebar_depth_bench.data.schema import Imported
from rebar_depth_bench.geometry.cameras import camera_centre
from rebar_depth_bench.scoring.protocol import interior

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
        camera_faults += [f"{record.view_id}: {one}" for one in _camera_problems(row, config)]
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
