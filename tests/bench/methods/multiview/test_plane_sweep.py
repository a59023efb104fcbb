"""The plane sweep and the agreement of views, on planes whose depth is known by formula."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from jaxtyping import Float64, UInt8
from numpy import ndarray

from rebar_depth_bench.geometry.cameras import ideal_K, look_at, pixel_rays
from rebar_depth_bench.methods.multiview.dense import consistent
from rebar_depth_bench.methods.multiview.plane_sweep import PosedPicture, SweepSpec, inverse_depths, sweep

WIDTH, HEIGHT = 160, 90
K = ideal_K(WIDTH, HEIGHT)
SPEC = SweepSpec()
TEXTURE_PX_PER_M = 400


def texture() -> UInt8[ndarray, "h w"]:
    noise = np.random.default_rng(3).integers(0, 256, (1200, 1200)).astype(np.uint8)
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), 2.0) * 2.0 - 128, np.float32).clip(0, 255).astype(np.uint8)


def picture(pose: Float64[ndarray, "4 4"]) -> UInt8[ndarray, "h w"]:
    """What a camera sees of the textured plane z = 0 of the world, point by point from its rays."""
    rays = pixel_rays(K, WIDTH, HEIGHT) @ pose[:3, :3]
    centre = -pose[:3, :3].T @ pose[:3, 3]
    points = centre + rays * (-centre[2] / rays[..., 2])[..., None]
    places = (points[..., :2] * TEXTURE_PX_PER_M + 600).astype(np.float32)
    return np.asarray(cv2.remap(texture(), places[..., 0], places[..., 1], cv2.INTER_LINEAR))


def true_depth(pose: Float64[ndarray, "4 4"]) -> Float64[ndarray, "h w"]:
    """Depth of the plane z = 0: the height of centre + depth * ray is zero."""
    rays_up = pixel_rays(K, WIDTH, HEIGHT) @ pose[:3, 2]
    centre_up = -(pose[:3, 2] @ pose[:3, 3])
    return np.asarray(-centre_up / rays_up)


def view_from(x: float, y: float) -> Float64[ndarray, "4 4"]:
    return look_at(np.array([x, y, 1.0]), np.array([0.0, 0.1, 0.0]))


VIEW = view_from(0.0, -0.4)
OTHERS = [view_from(0.2, -0.4), view_from(-0.2, -0.4), view_from(0.0, -0.2), view_from(0.1, -0.6)]


def test_a_slanted_plane_comes_out_at_its_depth() -> None:
    neighbours = [PosedPicture(picture(pose), pose) for pose in OTHERS]
    found = sweep(PosedPicture(picture(VIEW), VIEW), neighbours, K, (0.6, 2.0), SPEC)
    off = np.abs(found - true_depth(VIEW)) / true_depth(VIEW)
    known = np.isfinite(found)
    assert known[10:-10, 10:-10].mean() > 0.9
    assert np.median(off[known]) < 0.005
    assert np.percentile(off[known], 95) < 0.02


def test_a_plain_picture_has_no_answer() -> None:
    plain = np.full((HEIGHT, WIDTH), 90, np.uint8)
    found = sweep(PosedPicture(plain, VIEW), [PosedPicture(plain, pose) for pose in OTHERS], K, (0.6, 2.0), SPEC)
    assert not np.isfinite(found).any()


def test_a_depth_out_of_range_has_no_answer() -> None:
    """All of the plane is nearer than 1.5: the best of the planes swept is an end or agrees badly."""
    neighbours = [PosedPicture(picture(pose), pose) for pose in OTHERS]
    found = sweep(PosedPicture(picture(VIEW), VIEW), neighbours, K, (3.0, 9.0), SPEC)
    assert np.isfinite(found).mean() < 0.05


def test_planes_lie_about_a_step_apart() -> None:
    """Sideways motion by b moves a pixel by fx b (1/near - 1/far): one plane more than steps that fit."""
    b, near, far = 0.2, 0.6, 2.0
    shift = K @ np.outer([-b, 0.0, 0.0], [0.0, 0.0, 1.0])
    spread_px = K[0, 0] * b * (1 / near - 1 / far)
    planes = inverse_depths([(np.eye(3), shift)], (HEIGHT, WIDTH), (near, far), SPEC)
    assert len(planes) == max(SPEC.least_planes, int(np.ceil(spread_px / SPEC.step_px)) + 1)
    assert planes[0] == pytest.approx(1 / far)
    assert planes[-1] == pytest.approx(1 / near)


def test_views_confirm_true_depth_and_nothing_else() -> None:
    truth = true_depth(VIEW).astype(np.float32)
    others = [(true_depth(pose).astype(np.float32), pose) for pose in OTHERS]
    spoiled = truth.copy()
    spoiled[:, 70:90] *= 1.1
    spoiled[:5] = np.nan
    agreed = consistent(spoiled, VIEW, others, K, 3)
    assert agreed[20:70, 20:60].mean() > 0.99
    assert not agreed[:, 70:90].any()
    assert not agreed[:5].any()
    nothing = [(np.full_like(depth, np.nan), pose) for depth, pose in others]
    assert not consistent(truth, VIEW, nothing, K, 1).any()
