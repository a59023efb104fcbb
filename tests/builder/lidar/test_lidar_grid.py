"""A scan on the left grid: covered where a wall is, nearest surface first, nothing beyond a beam's cell."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.builder.lidar.lidar_scenes import HEIGHT, PERFECT, WIDTH, camera, joined, seen, wall

LENS = np.array([-0.175, 0.028, 6.7e-5, -1.5e-4, 0.0])
STEPS = st.floats(0.01, 0.1)


@settings(max_examples=20)
@given(st.floats(0.2, 20), STEPS, STEPS, st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.booleans())
def test_a_wall_is_exact_and_covered_at_any_step(
    depth_m: float, across: float, up: float, right_m: float, down_m: float, distorted: bool
) -> None:
    spec = replace(PERFECT, azimuth_step_rad=across, elevation_step_rad=up, position_left_m=(right_m, down_m, 0.0))
    found = seen(spec, wall(depth_m), camera(LENS if distorted else None))
    assert np.isfinite(found).all()
    assert found == pytest.approx(np.full((HEIGHT, WIDTH), depth_m), rel=2e-7)


@settings(max_examples=15)
@given(st.floats(0.2, 1), st.floats(0.005, 0.05), st.floats(-0.35, 0.35), st.floats(-0.06, 0.06), st.booleans())
@example(0.2, 0.05, 0.35, -0.06, False)
@example(0.2, 0.05, -0.35, -0.06, False)
def test_a_slanted_wall_is_covered_and_off_by_no_more_than_a_cell(
    depth_m: float, step: float, slope: float, right_m: float, distorted: bool
) -> None:
    spec = replace(PERFECT, azimuth_step_rad=step, elevation_step_rad=step, position_left_m=(right_m, -0.03, 0.0))
    view = camera(LENS if distorted else None)
    found = seen(spec, wall(depth_m, slope=slope), view)
    x = view.rays[..., 0]
    truth = depth_m / (1 - slope * x)  # z = depth + slope x z
    assert np.isfinite(found).mean() > 0.995
    cell = 1 / (1 - abs(slope) * np.abs(x).max()) * (1 + np.abs(x).max() ** 2) * step
    assert np.nanmax(np.abs(found - truth) / truth) < 1.5 * cell


def test_the_nearer_surface_wins_where_the_scanner_sees_round_it() -> None:
    """From 0.3 m to the right the scanner sees the wall that the strip hides from the left camera."""
    spec = replace(PERFECT, position_left_m=(0.3, 0.0, 0.0))
    strip, background = wall(1.0, -0.05, 0.05), wall(2.0)
    found = seen(spec, joined(strip, background))
    x = camera().rays[..., 0]
    on_strip = np.abs(x) < 0.05 - 0.011  # by more than a cell
    assert found[on_strip] == pytest.approx(np.ones(on_strip.sum()), rel=1e-6)
    # The strip's shadow from the scanner: x from 2 (-0.05 - 0.3) + 0.3 to 2 (0.05 - 0.3) + 0.3 on the wall.
    shadow = (x > -0.4 / 2 + 0.011) & (x < -0.2 / 2 - 0.011)
    assert shadow.any()
    assert np.isnan(found[shadow]).all()
    free = (x > 0.05 + 0.011) & np.isfinite(found)
    assert found[free] == pytest.approx(np.full(free.sum(), 2.0), rel=1e-6)


def test_nothing_is_filled_in_beyond_a_beams_cell() -> None:
    """A strip that one column of beams meets alone is as wide as that column's cell."""
    step = 0.04
    spec = replace(PERFECT, azimuth_step_rad=step, elevation_step_rad=step, position_left_m=(0.0, 0.0, 0.0))
    middle = math.tan(step / 2)
    found = seen(spec, wall(1.0, middle - 0.002, middle + 0.002))
    azimuth = np.arctan(camera().rays[0, :, 0])
    in_cell = (azimuth >= 0) & (azimuth < step)
    assert in_cell.sum() == 1
    assert np.array_equal(np.isfinite(found), np.broadcast_to(in_cell, found.shape))
    slipped = seen(spec, wall(1.0, middle + 0.002, middle + 0.006))
    assert not np.isfinite(slipped).any()


def test_a_cell_reaches_beyond_its_edge_only_where_no_other_answers() -> None:
    step, near_m = 0.095, 0.15
    spec = replace(PERFECT, azimuth_step_rad=step, elevation_step_rad=step)
    edge_m = near_m * math.tan(step)  # where a column of cells begins
    found = seen(spec, joined(wall(near_m, right_m=edge_m), wall(0.25)))
    azimuth = np.arctan(camera().rays[..., 0])  # the scanner stands above the camera: the same from both
    beyond = azimuth >= step
    assert azimuth[beyond].min() < step + 0.06 / near_m * step / 2, "no pixel that a cell could reach"
    assert found[~beyond] == pytest.approx(near_m, rel=1e-6)
    assert found[beyond] == pytest.approx(0.25, rel=1e-6)


def test_a_mixed_return_stands_between_the_surfaces_it_mixes() -> None:
    wide = replace(PERFECT, divergence_rad=0.02, exit_diameter_m=0.001, rays_per_beam=24, range_resolution_m=0.5)
    edge_m = camera().rays[0, WIDTH // 2, 0]  # the near wall ends in the middle of a column of pixels
    mesh = joined(wall(1.0, -10.0, edge_m), wall(1.3))
    mixed, apart = (seen(replace(wide, range_resolution_m=metres), mesh) for metres in (0.5, 0.1))
    assert ((mixed > 1.01) & (mixed < 1.29)).sum() == HEIGHT
    assert not ((apart > 1.01) & (apart < 1.29)).any()


def test_a_scanner_has_no_answer_nearer_than_its_least_range() -> None:
    found = seen(replace(PERFECT, min_range_m=0.6), wall(0.5))
    range_m = np.linalg.norm(0.5 * camera().rays - np.array(PERFECT.position_left_m), axis=-1)
    cell_m = 0.01
    assert np.isfinite(found[range_m > 0.6 + cell_m]).all()
    assert (range_m > 0.6 + cell_m).any()
    assert not np.isfinite(found[range_m < 0.6 - cell_m]).any()
