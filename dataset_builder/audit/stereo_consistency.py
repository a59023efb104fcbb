"""The left eye's steel looked up in the right eye's ground truth, through depth and cameras."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from dataset_builder.audit.report import Check
from dataset_builder.audit.views import AuditedConfig, AuditedEye, AuditedView
from dataset_builder.scene.model import Bar
from rebar_depth_bench.geometry.cameras import project, transform
from rebar_depth_bench.scoring.protocol import interior

MAX_CONTRADICTED_SHARE = 1e-4
_MIN_WIDTH_PX = 2.0
_AROUND = tuple((dv, du) for dv in (-1, 0, 1, 2) for du in (-1, 0, 1, 2))
"""The pixel centres round a projection, relative to the one above and left of it."""
_SAME_RAY_PX = 3.0
"""A point projected into the frame must lie this near to that pixel's ray: far outside the frame a distortion
polynomial may turn back and land inside it again."""


@dataclass(frozen=True)
class EpipolarCounts:
    """Interior steel pixels of the left view, looked up in the right one through their depth.

    ``seen`` have the same bar at the same depth there, ``hidden`` lie behind something nearer, ``outside``
    the right frame. ``contradicted`` would be visible but the right view sees past them.
    """

    seen: int = 0
    hidden: int = 0
    outside: int = 0
    contradicted: int = 0


@dataclass(frozen=True, eq=False)
class Landed:
    """Points in another eye: ``px`` in its picture, ``depth_m`` along its axis, ``inside`` its frame or not."""

    px: Float64[ndarray, "n 2"]
    depth_m: Float64[ndarray, " n"]
    inside: Bool[ndarray, " n"]


def landed_in(eye: AuditedEye, points_m: Float64[ndarray, "n 3"], margin_px: int) -> Landed:
    """Project world points into an eye; ``inside`` keeps ``margin_px`` whole pixels from the frame's border."""
    points_cam = transform(eye.camera.cam_from_world, points_m)
    in_front = points_cam[:, 2] > 0
    points_cam = np.where(in_front[:, None], points_cam, [0.0, 0.0, 1.0])
    px = project(eye.camera.K, points_cam, eye.camera.distortion)
    size = np.array([eye.camera.width, eye.camera.height])
    corner = np.floor(px)
    inside = in_front & ((corner >= margin_px) & (corner < size - 1 - margin_px)).all(axis=1)
    u, v = corner[inside].astype(int).T
    slope_off = np.abs(eye.rays_cam[v, u, :2] - points_cam[inside, :2] / points_cam[inside, 2:]).max(axis=1)
    inside[inside] = slope_off * eye.camera.K[0, 0] < _SAME_RAY_PX
    return Landed(px, points_cam[:, 2], inside)


def view_epipolar_counts(config: AuditedConfig, view: AuditedView) -> EpipolarCounts:
    """Return ``epipolar_counts`` of a view with its scene's bars."""
    return epipolar_counts(view, config.steel)


def epipolar_counts(view: AuditedView, steel: Iterable[Bar]) -> EpipolarCounts:
    """Look the left view's interior steel pixels up in the right view.

    The right view is read at the 4 x 4 pixel centres round the projection, and depth compared along its own axis:
    the eyes of a raw rig are not parallel. A point is seen if its bar is there at its depth, give or take the
    bar's diameter and what depth changes by from pixel to pixel on the bar; hidden if something there is nearer;
    contradicted otherwise. Bars thinner than two pixels can slip between pixel centres and are left out.
    """
    left, right = view.left, view.right
    diameter_of = np.zeros(np.iinfo(np.uint16).max + 1)
    for bar in steel:
        diameter_of[bar.bar_id] = bar.diameter_m
    diameter_m = diameter_of[left.bars]
    wide = diameter_m * left.camera.K[0, 0] >= _MIN_WIDTH_PX * left.depth_m
    chosen = interior(left.mask) & wide
    landed = landed_in(right, left.points_m[chosen], margin_px=1)
    inside = landed.inside
    u, v = np.floor(landed.px[inside]).astype(int).T
    around_m = np.stack([right.depth_m[v + dv, u + du] for dv, du in _AROUND], axis=1)
    around_bars = np.stack([right.bars[v + dv, u + du] for dv, du in _AROUND], axis=1)
    depth_m = landed.depth_m[inside, None]
    near_enough = np.abs(around_m - depth_m) <= diameter_m[chosen][inside, None]
    seen = (near_enough & (around_bars == left.bars[chosen][inside, None])).any(axis=1)
    hidden = ~seen & ((around_m > 0) & (around_m < depth_m)).any(axis=1)
    return EpipolarCounts(
        seen=int(np.count_nonzero(seen)),
        hidden=int(np.count_nonzero(hidden)),
        outside=int(np.count_nonzero(~inside)),
        contradicted=int(np.count_nonzero(~seen & ~hidden)),
    )


def epipolar_verdict(config: AuditedConfig, views: Sequence[EpipolarCounts]) -> Check:
    """Hold the share of contradicted pixels of all views against its bound."""
    name = f"{config.name}: left in right through depth"
    seen, hidden, contradicted = (
        sum(getattr(counts, kind) for counts in views) for kind in ("seen", "hidden", "contradicted")
    )
    inside = seen + hidden + contradicted
    if not inside:
        return Check(name, "no bar of two pixels or more", "left out")
    share = contradicted / inside
    problem = f"{contradicted} of {inside} steel pixels should be seen by the right eye and are not"
    return Check(
        name,
        f"{seen / inside:.1%} seen, {hidden / inside:.1%} hidden, {share:.4%} contradicted",
        f"{MAX_CONTRADICTED_SHARE:.2%} contradicted",
        (problem,) if share > MAX_CONTRADICTED_SHARE else (),
    )
