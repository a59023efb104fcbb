"""Tests of the robust cylinder fit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rebar_depth_bench.extended.fits import CylinderFits, fit_cylinders

RADIUS_M, HALF_M = 0.008, 0.05


def half_cylinder(
    count: int,
    offset_m: tuple[float, float] = (0, 0),
    slope: tuple[float, float] = (0, 0),
    radius_m: float = RADIUS_M,
) -> np.ndarray:
    """Return random points (metres) on the side facing the camera, up to 64 degrees around; slopes are exact."""
    rng = np.random.default_rng(0)
    u = np.array([*slope, 1.0]) / np.sqrt(1 + slope[0] ** 2 + slope[1] ** 2)
    across = np.array([1.0, 0, 0]) - u[0] * u
    across /= np.linalg.norm(across)
    sine = rng.uniform(-0.9, 0.9, count)
    axis_m = np.array([*offset_m, 0.0]) + rng.uniform(-HALF_M, HALF_M, count)[:, None] * u
    outward = sine[:, None] * across - np.sqrt(1 - sine**2)[:, None] * np.cross(u, across)
    return np.asarray(axis_m + radius_m * outward)


def fit(
    points_m: np.ndarray, used: np.ndarray | None = None, start_m: tuple[float, float] = (0, 0)
) -> CylinderFits:
    ones = np.ones(1)
    used_mask = np.ones((1, len(points_m)), dtype=bool) if used is None else used[None]
    start = np.array([start_m], dtype=np.float64)
    return fit_cylinders(points_m[None], used_mask, start, HALF_M * ones, RADIUS_M * ones, ones > 0)


@pytest.mark.parametrize("offset_m", [(0, 0), (0.001, -0.002), (-0.002, 0.006), (0.0, 0.02)])
@pytest.mark.parametrize("slope", [(0, 0), (0.03, -0.05), (0, 0.1)])
def test_exact_cylinder_is_recovered(offset_m: tuple[float, float], slope: tuple[float, float]) -> None:
    fits = fit(half_cylinder(60, offset_m, slope), start_m=(offset_m[0] + 0.001, offset_m[1] - 0.003))
    assert fits.converged.all()
    np.testing.assert_allclose(fits.offset_m[0], offset_m, atol=2e-5)
    np.testing.assert_allclose(fits.slope[0], slope, atol=1e-3)
    np.testing.assert_allclose(fits.diameter_m, 2 * RADIUS_M, rtol=2e-3)


@pytest.mark.parametrize("ratio", [0.7, 0.9, 1.2, 1.5])
def test_fitted_diameter_follows_radius(ratio: float) -> None:
    fits = fit(half_cylinder(60, radius_m=ratio * RADIUS_M))
    np.testing.assert_allclose(fits.diameter_m, 2 * ratio * RADIUS_M, rtol=0.01)


def test_fit_tolerates_one_third_outliers() -> None:
    points_m = half_cylinder(64, (0, 0.004))
    points_m[::3, 1] += np.random.default_rng(1).uniform(0.02, 1.0, 22)
    fits = fit(points_m)
    assert fits.converged.all()
    np.testing.assert_allclose(fits.offset_m[0], (0, 0.004), atol=5e-4)


def test_depth_noise_does_not_bias_axis_position() -> None:
    rng = np.random.default_rng(3)
    sets = np.stack([half_cylinder(64)] * 200)
    sets[..., 1] += 5 * RADIUS_M * rng.standard_normal(sets.shape[:2])
    used, ones = np.ones(sets.shape[:2], dtype=bool), np.ones(200)
    fits = fit_cylinders(sets, used, np.zeros((200, 2)), HALF_M * ones, RADIUS_M * ones, ones < 0)
    assert fits.converged.mean() > 0.95
    # Each of the 200 fits has an error of about 5 R / 8: their mean is known to 0.05 R; the far side is 2 R away.
    assert abs(fits.offset_m[:, 1].mean()) < 0.2 * RADIUS_M
    # Depth noise does not move a bar across the line of sight.
    assert np.abs(fits.offset_m[:, 0]).max() < 0.5 * RADIUS_M


def test_points_on_one_flank_determine_the_axis() -> None:
    points_m = half_cylinder(200)
    flank_m = points_m[points_m[:, 0] > 0.5 * RADIUS_M]
    fits = fit(flank_m, start_m=(0.0005, 0.0005))
    np.testing.assert_allclose(fits.offset_m[0], (0, 0), atol=5e-4)


def test_unused_points_and_other_sets_have_no_effect() -> None:
    points_m = half_cylinder(40, (0.001, 0.002))
    padded = np.concatenate([points_m, np.full((24, 3), 1e9)])
    used = np.arange(64) < 40
    alone, with_padding = fit(points_m), fit(padded, used)
    np.testing.assert_allclose(with_padding.offset_m, alone.offset_m, atol=1e-12)
    together = fit_cylinders(
        np.stack([padded, 3 * padded]), np.stack([used, used]), np.zeros((2, 2)), HALF_M * np.ones(2),
        np.array([RADIUS_M, 3 * RADIUS_M]), np.array([True, False]),
    )  # fmt: skip
    np.testing.assert_allclose(together.offset_m[0], alone.offset_m[0], atol=1e-12)
    assert np.isnan(together.diameter_m).tolist() == [False, True]


def test_empty_input_does_not_converge() -> None:
    empty = fit(half_cylinder(10), used=np.zeros(10, dtype=bool))
    assert not empty.converged.any()
    assert np.isnan(empty.diameter_m).all()
    no_sets = fit_cylinders(
        np.empty((0, 9, 3)), np.empty((0, 9), dtype=bool), np.empty((0, 2)), np.empty(0), np.empty(0),
        np.empty(0, dtype=bool),
    )  # fmt: skip
    assert no_sets.offset_m.shape == (0, 2)


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1e-9, 1e-3, 1.0, 1e3, 1e6, 1e150, 1e300]))
def test_random_points_never_raise_or_warn(seed: int, size_m: float) -> None:
    points_m = size_m * np.random.default_rng(seed).standard_normal((30, 3))
    fits = fit(points_m)
    assert np.isfinite(fits.offset_m[fits.converged]).all()


def test_fit_is_deterministic() -> None:
    points_m = half_cylinder(64) + 0.002 * np.random.default_rng(5).standard_normal((64, 3))
    assert fit(points_m).offset_m.tobytes() == fit(points_m.copy()).offset_m.tobytes()
