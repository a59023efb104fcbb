"""A scanner's beams against walls and rods whose ranges are known in closed form."""

from __future__ import annotations

import math
from dataclasses import replace
from statistics import NormalDist

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dataset_builder.lidar import MOBILE, SURVEY, ScannerSpec
from dataset_builder.lidar.beams import beam_angles, bundle, directions_of, sector_of, sub_rays
from dataset_builder.lidar.scanner import BeamWidth, Reports
from dataset_builder.lidar.simulate import noise_generator, reported_range_m, scan
from dataset_builder.scene.model import WorldMesh
from dataset_builder.scene.raycast import RayCaster
from rebar_depth_bench.geometry.cameras import ideal_K, look_at, pixel_rays
from tests.builder.lidar.lidar_scenes import PERFECT, camera, joined, wall

SHARE_OF_PEAK = {"1/e2": math.exp(-2), "1/e": math.exp(-1), "fwhm": 0.5}
WIDE = replace(PERFECT, divergence_rad=0.01, exit_diameter_m=0.004, rays_per_beam=400, range_resolution_m=0.1)
HALF_STEP = 0.005


def one_beam_m(spec: ScannerSpec, mesh: WorldMesh) -> float:
    """The range that beam (0, 0) reports, from the world's origin."""
    zero = np.zeros(1, np.int64)
    origins, directions = sub_rays(spec, *beam_angles(spec, zero, zero))
    hits = RayCaster(mesh).hits(origins[0], directions[0])
    return float(reported_range_m(spec, hits.range_m[None], hits.cos_incidence[None])[0])


def edge_of_beam(depth_m: float) -> float:
    """Where beam (0, 0)'s axis crosses a wall, along x."""
    return depth_m * math.tan(HALF_STEP)


def sigma_on_wall_m(spec: ScannerSpec, depth_m: float) -> float:
    return spec.diameter_m(depth_m) / 4 if spec.beam_width == "1/e2" else spec.diameter_m(depth_m) / 8**0.5


@pytest.mark.parametrize("width", SHARE_OF_PEAK)
def test_a_beam_is_as_wide_as_its_data_sheet_says(width: BeamWidth) -> None:
    spec = replace(WIDE, beam_width=width)
    edge = (spec.exit_diameter_m / 2 / spec.exit_sigma_m) ** 2 / 2
    assert math.exp(-edge) == pytest.approx(SHARE_OF_PEAK[width], rel=1e-12)
    lean = (spec.divergence_rad / 2 / spec.divergence_sigma_rad) ** 2 / 2
    assert math.exp(-lean) == pytest.approx(SHARE_OF_PEAK[width], rel=1e-12)


@given(st.floats(0, 50), st.floats(-1, 1), st.floats(-1, 1), st.sampled_from([2, 24, 60]))
def test_straight_sub_rays_have_the_gaussian_beams_width_at_every_range(
    range_m: float, azimuth: float, elevation: float, count: int
) -> None:
    spec = replace(WIDE, beam_width="1/e2", rays_per_beam=count)
    at = np.array([azimuth]), np.array([elevation])
    origins, directions = sub_rays(spec, *at)
    off = (origins + range_m * directions - range_m * directions_of(*at)[:, None])[0]
    assert off.mean(axis=0) == pytest.approx(np.zeros(3), abs=1e-12)
    assert np.abs(off @ directions_of(*at)[0]).max() < 1e-9
    squared_m2 = (off**2).sum(axis=1).mean()  # ISO 11146: d = 2 sqrt(2) times the root mean square radius
    assert 8 * squared_m2 == pytest.approx(0.004**2 + (0.01 * range_m) ** 2, rel=1e-9)


def test_the_pattern_is_a_round_gaussian() -> None:
    points = bundle(2000)
    for direction in np.linspace(0, math.pi, 7):
        across = np.sort(points @ [math.cos(direction), math.sin(direction)])
        shares = np.array([NormalDist().cdf(value) for value in across])
        assert np.abs(shares - (np.arange(2000) + 0.5) / 2000).max() < 0.01
    assert bundle(1).tolist() == [[0, 0]]


@settings(max_examples=30)
@given(st.floats(0.15, 30), st.floats(-0.06, 0.06), st.floats(-0.06, 0.06))
def test_the_sector_holds_every_pixel_at_every_distance(depth_m: float, right_m: float, down_m: float) -> None:
    spec = replace(PERFECT, position_left_m=(right_m, down_m, 0.0))
    rays = camera().rays
    sector = sector_of(spec, rays)
    x, y, z = np.moveaxis(depth_m * rays - np.array([right_m, down_m, 0.0]), -1, 0)
    column = np.floor(np.arctan2(x, z) / 0.01)
    row = np.floor(np.arctan2(-y, np.hypot(x, z)) / 0.01)
    assert column.min() >= sector.first_column
    assert column.max() < sector.first_column + sector.columns
    assert row.min() >= sector.first_row
    assert row.max() < sector.first_row + sector.rows


def test_rows_end_where_the_scanners_field_does() -> None:
    K = ideal_K(1280, 720)
    sector = sector_of(MOBILE, pixel_rays(K, 1280, 720))
    assert (sector.first_row, sector.rows) == (-64, 128)
    highest = (sector.first_row + sector.rows - 0.5) * MOBILE.elevation_step_rad
    assert math.degrees(highest) == pytest.approx(22.5)
    assert sector_of(replace(PERFECT, elevation_limits_rad=(1.4, 1.5)), camera().rays).rows == 0


def test_hits_are_as_exact_as_the_ground_truth_and_know_their_incidence() -> None:
    pose = look_at(np.array([0.21, -0.13, 0.31]), np.array([0.01, 0.02, 0.0]))
    mesh = WorldMesh(
        np.array([[-9.0, -9, 0], [9, -9, 0], [0, 9, 0]]), np.array([[0, 1, 2]], np.int32), np.ones(1, np.uint16)
    )
    rays = camera().rays
    truth = RayCaster(mesh).cast(rays, pose)
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
def test_an_edge_within_the_range_resolution_gives_the_mean_by_light(covered_sigma: float, step_m: float) -> None:
    near_m, far_m = 2.0, 2.0 + step_m
    edge_m = edge_of_beam(near_m) + covered_sigma * sigma_on_wall_m(WIDE, near_m)
    found = one_beam_m(WIDE, joined(wall(near_m, right_m=edge_m), wall(far_m)))
    share = NormalDist().cdf(covered_sigma)
    level = math.cos(HALF_STEP) ** 2  # beam (0, 0) looks half a step aside and half a step up
    assert found == pytest.approx((share * near_m + (1 - share) * far_m) / level, abs=0.012 * step_m + 1e-4)
    if covered_sigma == 0:
        assert found == pytest.approx((near_m + far_m) / 2 / level, abs=1e-4)


@settings(max_examples=40)
@given(st.floats(-2.5, 2.5), st.floats(0.15, 5), st.sampled_from(["strongest", "first"]))
def test_an_edge_beyond_the_range_resolution_gives_one_side_and_never_between(
    covered_sigma: float, step_m: float, reports: Reports
) -> None:
    spec = replace(WIDE, reports=reports, least_share=0.1)
    edge_m = edge_of_beam(2.0) + covered_sigma * sigma_on_wall_m(spec, 2.0)
    found = one_beam_m(spec, joined(wall(2.0, right_m=edge_m), wall(2.0 + step_m))) * math.cos(HALF_STEP) ** 2
    share = NormalDist().cdf(covered_sigma)
    threshold = 0.5 if reports == "strongest" else 0.1
    if abs(share - threshold) > 0.02:
        assert found == pytest.approx(2.0 if share > threshold else 2.0 + step_m, abs=2e-3)


@pytest.mark.parametrize("reports", ["strongest", "first"])
@pytest.mark.parametrize("width_sigma", [0.1, 0.2, 0.3, 1.0, 2.0, 4.0])
def test_a_rod_thinner_than_the_footprint_shows_by_the_light_it_holds(
    reports: Reports, width_sigma: float
) -> None:
    spec = replace(WIDE, reports=reports, least_share=0.1)
    middle, half = edge_of_beam(2.0), width_sigma / 2 * sigma_on_wall_m(spec, 2.0)
    mesh = joined(wall(2.0, middle - half, middle + half), wall(5.0))
    share = math.erf(width_sigma / 2 / 2**0.5)
    shows = share > (0.5 if reports == "strongest" else 0.1)
    found = one_beam_m(spec, mesh) * math.cos(HALF_STEP) ** 2
    assert found == pytest.approx(2.0 if shows else 5.0, abs=2e-3)
    alone = one_beam_m(spec, wall(2.0, middle - half, middle + half))
    assert math.isnan(alone) == (share < 0.1)


def test_a_rod_thinner_than_the_step_slips_between_beams_as_often_as_it_should() -> None:
    rod_m, depth_m = 0.003, 1.0
    gap_m = depth_m * (math.tan(1.5 * 0.01) - math.tan(0.5 * 0.01))  # between beams 0 and 1
    columns = np.arange(4)
    met = 0
    for shift in np.linspace(0, 1, 200, endpoint=False):
        start_m = depth_m * math.tan(HALF_STEP) + shift * gap_m
        caster = RayCaster(wall(depth_m, start_m, start_m + rod_m))
        origins, directions = sub_rays(PERFECT, *beam_angles(PERFECT, np.zeros(4, np.int64), columns))
        met += bool(np.isfinite(caster.hits(origins[:, 0], directions[:, 0]).range_m).any())
    assert met / 200 == pytest.approx(rod_m / gap_m, abs=0.01)


def test_noise_is_as_strong_as_the_spec_says_and_the_same_each_time() -> None:
    noisy = replace(PERFECT, noise_m=0.004, noise_per_m=0.002)
    caster, sector = RayCaster(wall(3.0)), sector_of(PERFECT, camera().rays)
    pose = PERFECT.lidar_from_left
    clean = scan(caster, PERFECT, sector, pose, noise_generator("a/0000"))
    found = scan(caster, noisy, sector, pose, noise_generator("a/0000"))
    in_sigmas = ((found - clean) / (0.004 + 0.002 * clean)).ravel()
    assert len(in_sigmas) > 10_000
    assert in_sigmas.mean() == pytest.approx(0, abs=5 / len(in_sigmas) ** 0.5)
    assert in_sigmas.std() == pytest.approx(1, abs=5 / (2 * len(in_sigmas)) ** 0.5)
    assert found.tobytes() == scan(caster, noisy, sector, pose, noise_generator("a/0000")).tobytes()
    assert not np.isclose(found, scan(caster, noisy, sector, pose, noise_generator("a/0001"))).all()
    half = scan(RayCaster(wall(3.0, left_m=0.0)), noisy, sector, pose, noise_generator("a/0000"))
    heard = np.isfinite(half)
    assert 0.4 < heard.mean() < 0.6
    assert np.array_equal(half[heard], found[heard]), "one beam's noise hangs on what another meets"


def by_hand(spec: ScannerSpec, range_m: np.ndarray, cosines: np.ndarray) -> float:
    """The rule of ``reported_range_m``, one hit after the other."""
    hits = sorted(
        (r, c) for r, c in zip(range_m, cosines, strict=True) if spec.min_range_m <= r <= spec.max_range_m
    )
    groups: list[list[tuple[float, float]]] = []
    for hit in hits:
        if not groups or hit[0] > groups[-1][0][0] + spec.range_resolution_m:
            groups.append([])
        groups[-1].append(hit)
    least = spec.least_share * len(range_m)
    lights = [(sum(c for _, c in group), group) for group in groups]
    strong = [(light, group) for light, group in lights if light >= least and light > 0]
    if not strong:
        return math.nan
    light, group = max(strong, key=lambda pair: pair[0]) if spec.reports == "strongest" else strong[0]
    return sum(r * c for r, c in group) / light


RANGES = st.sampled_from([0.2, 0.9, 1.0, 1.1, 1.2, 2.0, 30.0, math.inf])
CHAIN = np.tile([0.9, 1.0, 1.1, 1.2, 2.0, math.inf], (3, 1))  # neighbours are near, the ends are not


@given(
    arrays(float, (3, 6), elements=RANGES, fill=st.nothing()),
    arrays(float, (3, 6), elements=st.integers(0, 64).map(lambda value: value / 64)),
    st.sampled_from(["strongest", "first"]),
    st.sampled_from([0.0, 0.15, 0.4]),
    st.permutations(range(6)),
)
@example(CHAIN, np.ones((3, 6)), "strongest", 0.0, [5, 3, 1, 0, 2, 4])
@example(CHAIN, np.ones((3, 6)), "first", 0.0, [5, 3, 1, 0, 2, 4])
def test_returns_follow_the_rule_whatever_the_order_of_rays(
    range_m: np.ndarray, cosines: np.ndarray, reports: Reports, least: float, order: list[int]
) -> None:
    spec = replace(
        WIDE, reports=reports, least_share=least, range_resolution_m=0.12, min_range_m=0.5, max_range_m=20.0
    )
    found = reported_range_m(spec, range_m, cosines)
    expected = [by_hand(spec, *beam) for beam in zip(range_m, cosines, strict=True)]
    assert found == pytest.approx(expected, rel=1e-12, nan_ok=True)
    shuffled = reported_range_m(spec, range_m[:, order], cosines[:, order])
    assert shuffled == pytest.approx(found, rel=1e-12, nan_ok=True)


def test_what_is_too_near_is_not_heard_and_is_still_in_the_way() -> None:
    spec = replace(PERFECT, min_range_m=0.6)
    assert math.isnan(one_beam_m(spec, joined(wall(0.5), wall(2.0))))
    assert one_beam_m(spec, wall(0.7)) == pytest.approx(0.7 / math.cos(HALF_STEP) ** 2)
    assert math.isnan(one_beam_m(replace(spec, max_range_m=0.65), wall(0.7)))
    assert one_beam_m(replace(spec, min_range_m=0.0), joined(wall(0.5), wall(2.0))) < 0.6


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"azimuth_step_rad": 0.0}, "steps are not above 0"),
        ({"elevation_step_rad": math.nan}, "steps are not above 0"),
        ({"elevation_limits_rad": (0.2, 0.1)}, "elevation limits"),
        ({"divergence_rad": -1e-3}, "width is below 0"),
        ({"rays_per_beam": 7}, "not 1 or an even number"),
        ({"rays_per_beam": 0}, "not 1 or an even number"),
        ({"least_share": 1.5}, "least_share"),
        ({"min_range_m": 5.0, "max_range_m": 4.0}, "0 <= min < max"),
        ({"noise_m": -0.1}, "noise is below 0"),
    ],
)
def test_what_is_no_scanner_is_refused(changes: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        replace(SURVEY, **changes)  # type: ignore[arg-type]
