"""Depth checks against independent sources: Cycles' depth pass of the mesh file, and the other eye of a view."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from dataset_builder.audit.checks import AuditedConfig, AuditedEye, AuditedView, Check, EyeWithRays
from dataset_builder.pipeline.blender_process import BlenderProcesses, DepthTask
from rebar_depth_bench.base.writing import scratch_folder
from rebar_depth_bench.data.bars import with_axis
from rebar_depth_bench.geometry.cameras import project, transform
from rebar_depth_bench.scoring.protocol import interior

MAX_CYCLES_MEDIAN_RATIO = 5e-6
"""Largest median difference, relative to the median depth.

Cycles intersects triangles in float32. The median is 1e-7 on the lattice and 3e-6 on the pier, where the vertical
bars consist of triangles of 6.67 m by 4 mm: there Cycles' points lie up to 7 % of a radius off the bars, those of
the ray caster on the facets.
"""
MAX_CYCLES_OUTLIER_SHARE = 1e-3
"""Largest share of steel pixels that may be outliers."""
CYCLES_OUTLIER_RATIO = 1e-3
"""Difference of an outlier, relative to the depth or to 1 m, whichever is larger.

Only a different surface explains so large a difference.
"""
MAX_CONTRADICTED_SHARE = 1e-4
"""Largest share of contradicted pixels among those that project into the right frame."""
_MIN_BAR_WIDTH_PX = 2.0
_NEIGHBOUR_OFFSETS = tuple((dv, du) for dv in (-1, 0, 1, 2) for du in (-1, 0, 1, 2))
"""Offsets (dv, du) of the 4 x 4 pixel centres around a projection, relative to the one above and left of it."""
_MAX_RAY_DEVIATION_PX = 3.0
"""Largest distance of a projected point from the ray of its pixel, pixels.

A distortion polynomial is not monotonic far outside the frame and may project a point there back into it.
"""


def cycles_difference_m(
    mesh: Path, eyes: Sequence[AuditedEye], progress: Callable[[int, int], None]
) -> Float64[ndarray, "n 2"]:
    """Return |dataset depth - Cycles depth| and the dataset depth of every steel pixel of the eyes, n x 2, metres.

    Cycles renders each eye on its own grid, including distorted grids. Blender is not started if ``eyes`` is
    empty. ``progress`` is called with the number of cameras rendered and their total.
    """
    if not eyes:
        return np.zeros((0, 2))
    cameras = tuple(eye.camera for eye in eyes)
    with scratch_folder("rebar-audit-") as folder, BlenderProcesses() as blender:
        task = DepthTask(mesh, cameras, folder, os.cpu_count() or 1)
        log = folder / "blender.log"
        blender.run(
            task, f"the audit of {mesh.name}", log, lambda event: progress(event["camera"] + 1, len(cameras))
        )
        cycles_depths_m = [np.load(folder / f"{n}.npy") for n in range(len(cameras))]
    differences = []
    for eye, cycles_m in zip(eyes, cycles_depths_m, strict=True):
        depth_m = eye.depth_m[eye.mask].astype(np.float64)
        differences.append(np.stack([np.abs(depth_m - cycles_m[eye.mask]), depth_m], axis=1))
    return np.concatenate(differences)


def cycles_verdict(difference_and_depth_m: ndarray[Any, Any], views: int) -> Check:
    """Return the check of the depth differences of ``views`` views, skipped if no views were requested."""
    name = "depth compared with Cycles"
    if not views:
        return Check.skip(name, "no views requested")
    if not len(difference_and_depth_m):
        return Check.skip(name, f"{views} views: no steel")
    difference_m, depth_m = difference_and_depth_m.T
    median_m = float(np.median(difference_m))
    share = float(np.mean(difference_m > CYCLES_OUTLIER_RATIO * np.maximum(depth_m, 1.0)))
    bound_m = MAX_CYCLES_MEDIAN_RATIO * float(np.median(depth_m))
    measured = (
        f"{views} views: median {median_m * 1e6:.3f} um, 99.9 % {np.quantile(difference_m, 0.999) * 1e6:.2f} um, "
        f"{share:.4%} over 1 mm/m"
    )
    return Check(
        name,
        measured,
        f"median {bound_m * 1e6:.3g} um, {MAX_CYCLES_OUTLIER_SHARE:.1%} over 1 mm/m",
        () if median_m <= bound_m and share <= MAX_CYCLES_OUTLIER_SHARE else (measured,),
    )


@dataclass(frozen=True)
class EpipolarCounts:
    """Numbers of interior steel pixels of the left view by the result of their projection into the right view.

    ``seen``: the right view has the same bar at the same depth; ``hidden``: it has a nearer surface;
    ``contradicted``: the point should be visible, but the right view shows another or a farther surface. Pixels
    whose projections are outside the right frame are not counted.
    """

    seen: int = 0
    hidden: int = 0
    contradicted: int = 0


@dataclass(frozen=True, eq=False)
class ProjectedPoints:
    """Points projected into an eye: pixels, planar depth, and whether they lie inside the frame."""

    px: Float64[ndarray, "n 2"]
    depth_m: Float64[ndarray, " n"]
    inside: Bool[ndarray, " n"]


def project_into(eye: EyeWithRays, points_m: Float64[ndarray, "n 3"], margin_px: int) -> ProjectedPoints:
    """Project world points (metres) into an eye.

    A point counts as inside if it is at least ``margin_px`` whole pixels away from the frame's border.
    """
    points_cam = transform(eye.camera.cam_from_world, points_m)
    in_front = points_cam[:, 2] > 0
    points_cam = np.where(in_front[:, None], points_cam, [0.0, 0.0, 1.0])
    px = project(eye.camera.K, points_cam, eye.camera.distortion)
    size = np.array([eye.camera.width, eye.camera.height])
    corner = np.floor(px)
    inside = in_front & ((corner >= margin_px) & (corner < size - 1 - margin_px)).all(axis=1)
    u, v = corner[inside].astype(int).T
    slope_off = np.abs(eye.rays_cam[v, u, :2] - points_cam[inside, :2] / points_cam[inside, 2:]).max(axis=1)
    inside[inside] = slope_off * eye.camera.K[0, 0] < _MAX_RAY_DEVIATION_PX
    return ProjectedPoints(px, points_cam[:, 2], inside)


def epipolar_counts(config: AuditedConfig, view: AuditedView) -> EpipolarCounts:
    """Return the counts of the left view's interior steel pixels, projected into the right view.

    The right view is read at the 4 x 4 pixel centres around the projection. Depth is compared along the right
    optical axis, because the eyes of a raw rig are not parallel. A point is seen if one of these pixels shows its
    bar at its depth within one bar diameter, hidden if one of them is nearer, and contradicted otherwise. Bars
    thinner than two pixels can fall between pixel centres and are left out, as are bars of unknown diameter.
    """
    left, right = view.left, view.right
    diameter_of = np.zeros(np.iinfo(np.uint16).max + 1)
    for bar in with_axis(config.steel):
        diameter_of[bar.bar_id] = bar.diameter_m
    diameter_m = diameter_of[left.bars]
    wide_enough = diameter_m * left.camera.K[0, 0] >= _MIN_BAR_WIDTH_PX * left.depth_m
    chosen = interior(left.mask) & wide_enough
    projected = project_into(right, left.points_m[chosen], margin_px=1)
    inside = projected.inside
    u, v = np.floor(projected.px[inside]).astype(int).T
    neighbour_depth_m = np.stack([right.depth_m[v + dv, u + du] for dv, du in _NEIGHBOUR_OFFSETS], axis=1)
    neighbour_bars = np.stack([right.bars[v + dv, u + du] for dv, du in _NEIGHBOUR_OFFSETS], axis=1)
    depth_m = projected.depth_m[inside, None]
    same_depth = np.abs(neighbour_depth_m - depth_m) <= diameter_m[chosen][inside, None]
    seen = (same_depth & (neighbour_bars == left.bars[chosen][inside, None])).any(axis=1)
    hidden = ~seen & ((neighbour_depth_m > 0) & (neighbour_depth_m < depth_m)).any(axis=1)
    return EpipolarCounts(
        seen=int(np.count_nonzero(seen)),
        hidden=int(np.count_nonzero(hidden)),
        contradicted=int(np.count_nonzero(~seen & ~hidden)),
    )


def epipolar_verdict(_: AuditedConfig, views: Sequence[EpipolarCounts]) -> Check:
    """Return the check of the share of contradicted pixels of all views."""
    name = "left steel projected into the right eye"
    seen, hidden, contradicted = (
        sum(getattr(counts, kind) for counts in views) for kind in ("seen", "hidden", "contradicted")
    )
    inside = seen + hidden + contradicted
    if not inside:
        return Check.skip(name, "no bar is two pixels wide or more")
    share = contradicted / inside
    problem = f"{contradicted} of {inside} steel pixels should be visible to the right eye but are not"
    return Check(
        name,
        f"{seen / inside:.1%} seen, {hidden / inside:.1%} hidden, {share:.4%} contradicted",
        f"{MAX_CONTRADICTED_SHARE:.2%} contradicted",
        (problem,) if share > MAX_CONTRADICTED_SHARE else (),
    )
