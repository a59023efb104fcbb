"""Cameras: axes, the ideal matrix of the contract, projections and their inverses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rebar_depth_bench.cameras import (
    camera_centre,
    ideal_K,
    inverse_rigid,
    look_at,
    pixel_rays,
    project,
    right_of_rig,
    transform,
)

COORDINATE = st.floats(-5.0, 5.0)
POINT = st.tuples(st.floats(0.3, 5.0), COORDINATE, COORDINATE).map(np.array)


def test_the_contracts_ideal_matrix() -> None:
    assert ideal_K(1280, 720).tolist() == [[700, 0, 639.5], [0, 700, 359.5], [0, 0, 1]]
    assert ideal_K(320, 90).tolist() == [[175, 0, 159.5], [0, 87.5, 44.5], [0, 0, 1]]


def test_axes_are_right_down_forward() -> None:
    pose = look_at(np.array([0.0, -2.0, 1.0]), np.array([0.0, 0.0, 1.0]))
    assert transform(pose, np.array([0.0, 0.0, 1.0])) == pytest.approx([0, 0, 2])
    assert transform(pose, np.array([1.0, 0.0, 1.0]))[0] == pytest.approx(1)  # world x is to the right
    assert transform(pose, np.array([0.0, 0.0, 2.0]))[1] == pytest.approx(-1)  # up is against y


@given(POINT)
def test_look_at_puts_the_target_on_the_optical_axis(eye: np.ndarray) -> None:
    target = np.array([0.1, 0.2, 0.05])
    pose = look_at(eye, target)
    assert transform(pose, target) == pytest.approx([0, 0, np.linalg.norm(target - eye)], abs=1e-9)
    assert camera_centre(pose) == pytest.approx(eye, abs=1e-9)
    assert pose[:3, :3] @ pose[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)


def test_look_at_refuses_to_look_along_up() -> None:
    with pytest.raises(ValueError, match="parallel to the up direction"):
        look_at(np.array([0.0, 0.0, 1.0]), np.zeros(3))


@given(POINT)
def test_inverse_undoes_a_pose(eye: np.ndarray) -> None:
    pose = look_at(eye, np.zeros(3))
    assert inverse_rigid(pose) @ pose == pytest.approx(np.eye(4), abs=1e-12)


def test_rays_and_projection_are_inverse_at_pixel_centres() -> None:
    K = np.array([[70.0, 0, 31.2], [0, 65.0, 17.7], [0, 0, 1]])
    rays = pixel_rays(K, 64, 36)
    v, u = np.mgrid[:36, :64]
    assert project(K, rays * 3.7) == pytest.approx(np.stack([u, v], axis=-1), abs=1e-9)
    assert (rays[..., 2] == 1).all()  # the ray's parameter is planar depth


def test_the_right_camera_stands_one_baseline_along_x() -> None:
    left = look_at(np.array([0.3, -0.2, 0.25]), np.array([0.0, 0.0, 0.05]))
    right = right_of_rig(left, 0.12)
    shift = camera_centre(right) - camera_centre(left)
    assert shift == pytest.approx(0.12 * left[0, :3])
    assert np.array_equal(right[:3, :3], left[:3, :3])
