"""Plane sweep and consistency of views, on a plane of known depth."""

from __future__ import annotations

import pytest

pytest.importorskip("cv2")

import cv2
import numpy as np
from jaxtyping import Float64, UInt8
from numpy import ndarray

from rebar_depth_bench.geometry.cameras import ideal_K, look_at, pixel_rays
from rebar_depth_bench.methods.multiview.dense import (
    MIN_PLANES,
    STEP_PX,
    PosedImage,
    consistency_mask,
    inverse_depths,
    sweep_depth,
)

WIDTH, HEIGHT = 160, 90
K = ideal_K(WIDTH, HEIGHT)
TEXTURE_PX_PER_M = 400


def texture() -> UInt8[ndarray, "h w"]:
    noise = np.random.default_rng(3).integers(0, 256, (1200, 1200)).astype(np.uint8)
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), 2.0) * 2.0 - 128, np.float32).clip(0, 255).astype(np.uint8)


def render_view(pose: Float64[ndarray, "4 4"]) -> UInt8[ndarray, "h w"]:
    """Render the textured world plane z = 0 by intersecting every pixel's ray with it."""
    rays = pixel_rays(K, WIDTH, HEIGHT) @ pose[:3, :3]
    centre = -pose[:3, :3].T @ pose[:3, 3]
    points = centre + rays * (-centre[2] / rays[..., 2])[..., None]
    texture_px = (points[..., :2] * TEXTURE_PX_PER_M + 600).astype(np.float32)
    return np.asarray(cv2.remap(texture(), texture_px[..., 0], texture_px[..., 1], cv2.INTER_LINEAR))


def true_depth(pose: Float64[ndarray, "4 4"]) -> Float64[ndarray, "h w"]:
    """Return the depth of the world plane z = 0: the height of centre + depth * ray is zero."""
    rays_up = pixel_rays(K, WIDTH, HEIGHT) @ pose[:3, 2]
    centre_up = -(pose[:3, 2] @ pose[:3, 3])
    return np.asarray(-centre_up / rays_up)


def view_pose(x: float, y: float) -> Float64[ndarray, "4 4"]:
    return look_at(np.array([x, y, 1.0]), np.array([0.0, 0.1, 0.0]))


VIEW = view_pose(0.0, -0.4)
OTHERS = [view_pose(0.2, -0.4), view_pose(-0.2, -0.4), view_pose(0.0, -0.2), view_pose(0.1, -0.6)]


def test_slanted_plane_is_recovered() -> None:
    neighbours = [PosedImage(render_view(pose), pose) for pose in OTHERS]
    depth_m = sweep_depth(PosedImage(render_view(VIEW), VIEW), neighbours, K, (0.6, 2.0))
    abs_rel = np.abs(depth_m - true_depth(VIEW)) / true_depth(VIEW)
    known = np.isfinite(depth_m)
    assert known[10:-10, 10:-10].mean() > 0.9
    assert np.median(abs_rel[known]) < 0.005
    assert np.percentile(abs_rel[known], 95) < 0.02


def test_textureless_image_has_no_depth() -> None:
    plain = np.full((HEIGHT, WIDTH), 90, np.uint8)
    depth_m = sweep_depth(PosedImage(plain, VIEW), [PosedImage(plain, pose) for pose in OTHERS], K, (0.6, 2.0))
    assert not np.isfinite(depth_m).any()


def test_depth_outside_range_is_rejected() -> None:
    """The plane is nearer than 1.5 m, so the best of the swept planes is an end plane or matches badly."""
    neighbours = [PosedImage(render_view(pose), pose) for pose in OTHERS]
    depth_m = sweep_depth(PosedImage(render_view(VIEW), VIEW), neighbours, K, (3.0, 9.0))
    assert np.isfinite(depth_m).mean() < 0.05


def test_planes_are_one_step_apart() -> None:
    """Sideways motion by b moves a pixel by fx b (1/near - 1/far); there is one plane more than steps."""
    baseline_m, near, far = 0.2, 0.6, 2.0
    shift = K @ np.outer([-baseline_m, 0.0, 0.0], [0.0, 0.0, 1.0])
    spread_px = K[0, 0] * baseline_m * (1 / near - 1 / far)
    planes = inverse_depths([(np.eye(3), shift)], (HEIGHT, WIDTH), (near, far))
    assert len(planes) == max(MIN_PLANES, int(np.ceil(spread_px / STEP_PX)) + 1)
    assert planes[0] == pytest.approx(1 / far)
    assert planes[-1] == pytest.approx(1 / near)


def test_consistency_mask_accepts_only_true_depth() -> None:
    truth = true_depth(VIEW).astype(np.float32)
    others = [(true_depth(pose).astype(np.float32), pose) for pose in OTHERS]
    spoiled = truth.copy()
    spoiled[:, 70:90] *= 1.1
    spoiled[:5] = np.nan
    consistent = consistency_mask(spoiled, VIEW, others, K)
    assert consistent[20:70, 20:60].mean() > 0.99
    assert not consistent[:, 70:90].any()
    assert not consistent[:5].any()
    empty = [(np.full_like(depth, np.nan), pose) for depth, pose in others]
    assert not consistency_mask(truth, VIEW, empty, K).any()
