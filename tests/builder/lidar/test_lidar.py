"""Simulated LiDAR beams compared with walls and rods of analytically known range."""

from __future__ import annotations

import math
from dataclasses import replace
from statistics import NormalDist

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataset_builder.lidar import MOBILE, SURVEY, ScannerSpec
from dataset_builder.lidar.scanner import (
    beam_angles,
    directions_from_angles,
    reported_range_m,
    simulate_scan,
    sub_rays,
    visible_beams,
)
from dataset_builder.scene.model import WorldMesh
from dataset_builder.scene.raycast import RayCaster
from rebar_depth_bench.geometry.cameras import Camera, ideal_K, look_at, pixel_rays
from tests.builder.lidar.lidar_scenes import PERFECT, camera, concatenate_meshes, wall

WIDE_BEAM = replace(
    PERFECT, divergence_sigma_rad=0.0025, exit_sigma_m=0.001, rays_per_beam=400, range_resolution_m=0.1
)
HALF_STEP_RAD = 0.005


def single_beam_range_m(spec: ScannerSpec, mesh: WorldMesh) -> float:
    """Return the range that beam (0, 0) reports from the world origin, in metres."""
    zero = np.zeros(1, np.int64)
    origins, directions = sub_rays(spec, *beam_angles(spec, zero, zero))
    hits = RayCaster(mesh).hits(origins[0], directions[0])
    return float(reported_range_m(spec, hits.range_m[None], hits.cos_incidence[None])[0])


def beam_axis_x_m(depth_m: float) -> float:
    """Return the x coordinate at which the axis of beam (0, 0) meets a wall, in metres."""
    return depth_m * math.tan(HALF_STEP_RAD)


def sigma_on_wall_m(spec: ScannerSpec, depth_m: float) -> float:
    """Return the beam's sigma by the hyperbola of ISO 11146-1, in metres."""
    return math.hypot(spec.exit_sigma_m, spec.divergence_sigma_rad * depth_m)


@pytest.mark.parametrize(
    ("spec", "share_of_peak", "divergence_rad", "exit_diameter_m"),
    [(SURVEY, math.exp(-1), 0.3e-3, 2.12e-3), (MOBILE, 0.5, math.radians(0.18), 10e-3)],
)
def test_beam_width_matches_data_sheet_definition(
    spec: ScannerSpec, share_of_peak: float, divergence_rad: float, exit_diameter_m: float
) -> None:
    exit_exponent = (exit_diameter_m / 2 / spec.exit_sigma_m) ** 2 / 2
    assert math.exp(-exit_exponent) == pytest.approx(share_of_peak, rel=1e-12)
    divergence_exponent = (divergence_rad / 2 / spec.divergence_sigma_rad) ** 2 / 2
    assert math.exp(-divergence_exponent) == pytest.approx(share_of_peak, rel=1e-12)


@given(st.floats(0, 50), st.floats(-1, 1), st.floats(-1, 1), st.sampled_from([2, 24, 60]))
def test_sub_rays_have_gaussian_beam_width_at_any_range(
    range_m: float, azimuth: float, elevation: float, count: int
) -> None:
    spec = replace(WIDE_BEAM, rays_per_beam=count)
    angles = np.array([azimuth]), np.array([elevation])
    origins, directions = sub_rays(spec, *angles)
    offsets_m = (origins + range_m * directions - range_m * directions_from_angles(*angles)[:, None])[0]
    assert offsets_m.mean(axis=0) == pytest.approx(np.zeros(3), abs=1e-12)
    assert np.abs(offsets_m @ directions_from_angles(*angles)[0]).max() < 1e-9
    # ISO 11146: d = 2 sqrt(2) times the root mean square radius
    mean_square_radius_m2 = (offsets_m**2).sum(axis=1).mean()
    assert 8 * mean_square_radius_m2 == pytest.approx(0.004**2 + (0.01 * range_m) ** 2, rel=1e-9)


@settings(max_examples=30)
@given(st.floats(0.15, 30), st.floats(-0.06, 0.06), st.floats(-0.06, 0.06))
def test_visible_sector_contains_all_pixels_at_any_depth(depth_m: float, right_m: float, down_m: float) -> None:
    spec = replace(PERFECT, position_left_m=(right_m, down_m, 0.0))
    rays = camera().rays()
    rows, columns = visible_beams(spec, rays)
    x, y, z = np.moveaxis(depth_m * rays - np.array([right_m, down_m, 0.0]), -1, 0)
    column = np.floor(np.arctan2(x, z) / 0.01)
    row = np.floor(np.arctan2(-y, np.hypot(x, z)) / 0.01)
    assert columns.min() <= column.min() <= column.max() <= columns.max()
    assert rows.min() <= row.min() <= row.max() <= rows.max()


def test_rows_are_limited_to_scanner_field_of_view() -> None:
    K = ideal_K(1280, 720)
    rows, _ = visible_beams(MOBILE, pixel_rays(K, 1280, 720))
    assert (rows.min(), rows.max()) == (-64, 63)
    assert math.degrees((rows.max() + 0.5) * MOBILE.elevation_step_rad) == pytest.approx(22.5)
    rows, _ = visible_beams(replace(PERFECT, elevation_limits_rad=(1.4, 1.5)), camera().rays())
    assert len(rows) == 0


def test_hits_match_ground_truth_depth_and_incidence() -> None:
    pose = look_at(np.array([0.21, -0.13, 0.31]), np.array([0.01, 0.02, 0.0]))
    mesh = WorldMesh(
        np.array([[-9.0, -9, 0], [9, -9, 0], [0, 9, 0]]), np.array([[0, 1, 2]], np.int32), np.ones(1, np.uint16)
    )
    left, rays = camera(), camera().rays()
    truth = RayCaster(mesh).cast(Camera(left.K, left.distortion, pose, rays.shape[1], rays.shape[0]))
    directions = rays.reshape(-1, 3) @ pose[:3, :3]
    centre = np.linalg.inv(pose)[:3, 3]
    hits = RayCaster(mesh).hits(np.broadcast_to(centre, directions.shape), directions)
    length = np.linalg.norm(directions, axis=1)
    hit = np.isfinite(hits.range_m)
    assert hit.any()
    assert np.array_equal(hit, truth.depth_m.ravel() > 0)
    assert (hits.range_m / length)[hit].astype(np.float32).tolist() == truth.depth_m.ravel()[hit].tolist()
    assert hits.cos_incidence[hit] == pytest.approx(-directions[hit, 2] / length[hit], rel=1e-12)


@pytest.mark.parametrize("covered_sigma", [-1.0, -0.3, 0.0, 0.5, 1.5])
@pytest.mark.parametrize("step_m", [0.03, 0.09])
def test_edge_within_range_resolution_gives_weighted_mean(covered_sigma: float, step_m: float) -> None:
    near_m, far_m = 2.0, 2.0 + step_m
    edge_m = beam_axis_x_m(near_m) + covered_sigma * sigma_on_wall_m(WIDE_BEAM, near_m)
    reported_m = single_beam_range_m(WIDE_BEAM, concatenate_meshes(wall(near_m, right_m=edge_m), wall(far_m)))
    share = NormalDist().cdf(covered_sigma)
    cos_squared = math.cos(HALF_STEP_RAD) ** 2  # Beam (0, 0) is half a step off the axis, sideways and up.
    assert reported_m == pytest.approx(
        (share * near_m + (1 - share) * far_m) / cos_squared, abs=0.012 * step_m + 1e-4
    )
    if covered_sigma == 0:
        assert reported_m == pytest.approx((near_m + far_m) / 2 / cos_squared, abs=1e-4)


@pytest.mark.slow
@settings(max_examples=40)
@given(st.floats(-2.5, 2.5), st.floats(0.15, 5))
def test_edge_beyond_range_resolution_gives_one_surface(covered_sigma: float, step_m: float) -> None:
    edge_m = beam_axis_x_m(2.0) + covered_sigma * sigma_on_wall_m(WIDE_BEAM, 2.0)
    depth_m = (
        single_beam_range_m(WIDE_BEAM, concatenate_meshes(wall(2.0, right_m=edge_m), wall(2.0 + step_m)))
        * math.cos(HALF_STEP_RAD) ** 2
    )
    share = NormalDist().cdf(covered_sigma)
    if abs(share - 0.5) > 0.02:
        assert depth_m == pytest.approx(2.0 if share > 0.5 else 2.0 + step_m, abs=2e-3)


@pytest.mark.parametrize("width_sigma", [0.1, 0.2, 0.3, 1.0, 2.0, 4.0])
def test_rod_thinner_than_footprint_needs_enough_light(width_sigma: float) -> None:
    spec = replace(WIDE_BEAM, least_share=0.1)
    middle_m, half_m = beam_axis_x_m(2.0), width_sigma / 2 * sigma_on_wall_m(spec, 2.0)
    mesh = concatenate_meshes(wall(2.0, middle_m - half_m, middle_m + half_m), wall(5.0))
    share = math.erf(width_sigma / 2 / 2**0.5)
    depth_m = single_beam_range_m(spec, mesh) * math.cos(HALF_STEP_RAD) ** 2
    assert depth_m == pytest.approx(2.0 if share > 0.5 else 5.0, abs=2e-3)
    without_background_m = single_beam_range_m(spec, wall(2.0, middle_m - half_m, middle_m + half_m))
    assert math.isnan(without_background_m) == (share < 0.1)


def test_noise_has_specified_sigma_and_is_deterministic() -> None:
    noisy = replace(PERFECT, noise_m=0.004)
    beams = visible_beams(PERFECT, camera().rays())

    def scan_m(spec: ScannerSpec, mesh: WorldMesh, view_id: str) -> np.ndarray:
        return simulate_scan(RayCaster(mesh), spec, *beams, np.eye(4), view_id)

    clean_m = scan_m(PERFECT, wall(3.0), "a/0000")
    noisy_m = scan_m(noisy, wall(3.0), "a/0000")
    normalised = (noisy_m - clean_m) / 0.004
    assert len(normalised) > 10_000
    assert normalised.mean() == pytest.approx(0, abs=5 / len(normalised) ** 0.5)
    assert normalised.std() == pytest.approx(1, abs=5 / (2 * len(normalised)) ** 0.5)
    assert noisy_m.tobytes() == scan_m(noisy, wall(3.0), "a/0000").tobytes()
    assert not np.isclose(noisy_m, scan_m(noisy, wall(3.0), "a/0001")).all()
    half_wall_m = scan_m(noisy, wall(3.0, left_m=0.0), "a/0000")
    has_return = np.isfinite(half_wall_m)
    assert 0.4 < has_return.mean() < 0.6
    assert np.array_equal(half_wall_m[has_return], noisy_m[has_return]), (
        "one beam's noise hangs on what another meets"
    )


INF = math.inf
RETURNS = [
    # Neighbours are within the resolution, the ends are not; of equally bright returns the nearest counts.
    ([0.9, 1.0, 1.1, 1.2, 2.0, INF], [1.0] * 6, 0.0, 0.95),
    ([0.9, 1.0, 1.1, 1.2, 2.0, INF], [0.25, 0.25, 0.5, 0.5, 0.75, 1.0], 0.0, 1.15),
    ([0.9, 0.9, 1.0, 2.0, 2.0, 2.0], [0.5, 0.25, 0.25, 0.25, 0.25, 0.25], 0.15, 0.925),
    ([0.9, 2.0, INF, INF, INF, INF], [0.25, 0.75, 0.0, 0.0, 0.0, 0.0], 0.15, math.nan),
    ([0.9, 2.0, INF, INF, INF, INF], [0.25, 0.75, 0.0, 0.0, 0.0, 0.0], 0.125, 2.0),
    # Nearer and farther than the scanner measures, and without light.
    ([0.2, 0.2, 0.2, 30.0, 30.0, 1.0], [1.0] * 6, 0.15, 1.0),
    ([0.2, 30.0, INF, INF, INF, INF], [1.0] * 6, 0.0, math.nan),
    ([1.0] * 6, [0.0] * 6, 0.0, math.nan),
]


@pytest.mark.parametrize(("range_m", "cosines", "least", "reported_m"), RETURNS)
def test_brightest_return_is_reported_for_any_order_of_rays(
    range_m: list[float], cosines: list[float], least: float, reported_m: float
) -> None:
    spec = replace(WIDE_BEAM, least_share=least, range_resolution_m=0.12, min_range_m=0.5, max_range_m=20.0)
    orders = np.array([np.arange(6), np.arange(6)[::-1], [5, 3, 1, 0, 2, 4], [2, 0, 4, 1, 5, 3]])
    reported = reported_range_m(spec, np.array(range_m)[orders], np.array(cosines)[orders])
    assert reported == pytest.approx(np.full(len(orders), reported_m), rel=1e-12, nan_ok=True)


def test_surface_below_min_range_occludes_without_return() -> None:
    spec = replace(PERFECT, min_range_m=0.6)
    assert math.isnan(single_beam_range_m(spec, concatenate_meshes(wall(0.5), wall(2.0))))
    assert single_beam_range_m(spec, wall(0.7)) == pytest.approx(0.7 / math.cos(HALF_STEP_RAD) ** 2)
    assert math.isnan(single_beam_range_m(replace(spec, max_range_m=0.65), wall(0.7)))
    assert single_beam_range_m(replace(spec, min_range_m=0.1), concatenate_meshes(wall(0.5), wall(2.0))) < 0.6


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"azimuth_step_rad": 0.0}, "steps are not above 0"),
        ({"elevation_step_rad": math.nan}, "steps are not above 0"),
        ({"elevation_limits_rad": (0.2, 0.1)}, "elevation limits"),
        ({"divergence_sigma_rad": -1e-3}, "width is below 0"),
        ({"rays_per_beam": 7}, "not 1 or an even number"),
        ({"rays_per_beam": 0}, "not 1 or an even number"),
        ({"least_share": 1.5}, "least_share"),
        ({"min_range_m": 5.0, "max_range_m": 4.0}, "0 < min < max"),
        ({"min_range_m": 0.0}, "0 < min < max"),
        ({"noise_m": -0.1}, "noise is below 0"),
    ],
)
def test_invalid_scanner_specs_are_rejected(changes: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        replace(SURVEY, **changes)  # type: ignore[arg-type]
