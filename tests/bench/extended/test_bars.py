"""Measures of bars: inspection, and deviation from the design."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.extended.fits import MISS_MM
from rebar_depth_bench.extended.ground_truth import load_steel_truth
from rebar_depth_bench.extended.inspection import (
    AS_BUILT_MEASURES,
    OFF_MM,
    as_built_samples,
    inspection_samples,
)
from rebar_depth_bench.extended.measures import STATISTICS, Samples
from rebar_depth_bench.extended.steel import SceneBars, SteelTruth
from rebar_depth_bench.geometry.cameras import rotation_matrix
from tests.bench.extended.cage_scenes import bar, mat, predicted_m, steel_samples, view

# Inspection.


Point = tuple[float, float, float]

TRUTH = view(mat())
EXACT_M = TRUTH.depth_m.astype(np.float64)
EXACT_M.flags.writeable = False  # Measures that change their input raise.


DETECTED_BARS_ONLY = (
    "axis_tilt_deg",
    *(f"{kind}_error_mm" for kind in ("spacing", "cover", "depth_offset", "diameter")),
)

BUILT_MM = np.array([(0, 0, 0), (4, 0, 3), (12, 5, 0), (0, 9, -12), (3, -15, 2), (-8, 0, 7)], float)
"""Displacement of each bar of ``mat`` from its nominal axis."""
ALONG = np.array([(0, 1, 0)] * 3 + [(1, 0, 0)] * 2 + [(0, 1, 0)], float)
TRUE_MM = np.linalg.norm(BUILT_MM * (1 - ALONG), axis=1)


def moved(points_m: Sequence[Sequence[float]], rotation: np.ndarray, shift_m: np.ndarray) -> tuple[Point, ...]:
    """Return points of an axis after a rotation and a shift."""
    return tuple(map(tuple, (np.array(points_m) @ rotation.T + shift_m).tolist()))


def displaced(bar: Bar, by_mm: Sequence[float] | np.ndarray) -> Bar:
    """Return a bar displaced as built, whose nominal axis is where it was."""
    axis_m = moved(bar.axis_m, np.eye(3), np.divide(by_mm, 1000))
    return replace(bar, axis_m=axis_m, nominal_axis_m=bar.axis_m)


BARS = [displaced(bar, by_mm) for bar, by_mm in zip(mat(), BUILT_MM, strict=True)]
BUILT_TRUTH = view(BARS)
BUILT_EXACT_M = BUILT_TRUTH.depth_m.astype(np.float64)


def inspected(p_m: np.ndarray, truth: SteelTruth = TRUTH) -> Samples:
    steel = steel_samples(p_m, truth)
    return inspection_samples(steel.bars, steel.spacings)


def deviations(p_m: np.ndarray, truth: SteelTruth) -> Samples:
    return as_built_samples(steel_samples(p_m, truth).bars)


def test_ground_truth_of_smooth_bars_is_perfect() -> None:
    samples = inspected(EXACT_M)
    assert samples["bar_found"].tolist() == [1.0] * 6
    # Neighbours: 1-2, 2-3 and 4-5 side by side, and 2-6, which lies mostly along the optical axis.
    assert len(samples["spacing_judged_mm"]) == 4
    for name, values in samples.items():
        if name.endswith(("_error_mm", "_judged_mm")) and not name.startswith("cover"):
            assert len(values) > 0
            assert np.abs(values).max() < (0.05 if name.startswith("diameter") else 2e-3), name


@pytest.mark.parametrize("move_mm", [(0, 0, 6), (0, 0, -6), (1.5, 0, 0), (2, 0, 4)])
def test_shifted_bars_have_offsets_of_the_shift(move_mm: tuple[float, float, float]) -> None:
    dx, dy, dz = (value / 1000 for value in move_mm)
    samples = inspected(predicted_m(mat(dx, dy, dz), TRUTH))
    np.testing.assert_allclose(samples["depth_offset_error_mm"], move_mm[2], atol=0.05)
    upright = [np.hypot(move_mm[0], move_mm[2])] * 3
    lying = [np.hypot(move_mm[1], move_mm[2])] * 2
    np.testing.assert_allclose(samples["axis_offset_judged_mm"], [*upright, *lying, upright[0]], atol=0.05)
    np.testing.assert_allclose(samples["spacing_error_mm"], 0, atol=0.05)


@pytest.mark.parametrize("scale", [0.98, 1.03])
def test_scale_error_stretches_all_distances(scale: float) -> None:
    samples = inspected(scale * EXACT_M)
    # The fit keeps the nominal radius, so that scaling moves the visible side of a bar, not its axis, by s - 1
    # times its position. From in front of the gap between two bars, their visible sides are closer together than
    # their axes by less than a diameter.
    across = np.hypot(30, 100)
    np.testing.assert_allclose(samples["spacing_error_mm"] / (scale - 1), [80, 80, across, 100], rtol=0.06)
    np.testing.assert_allclose(
        samples["depth_offset_error_mm"] / (scale - 1), [390, 390, 390, 450, 450, 490], rtol=0.01
    )
    np.testing.assert_allclose(samples["diameter_error_mm"] / (scale - 1), 20, rtol=0.02)


@pytest.mark.parametrize("diameter_m", [0.018, 0.022])
def test_diameter_error_is_measured(diameter_m: float) -> None:
    samples = inspected(predicted_m(mat(diameter_m=diameter_m), TRUTH))
    assert len(samples["diameter_error_mm"]) >= 3
    np.testing.assert_allclose(samples["diameter_error_mm"], 1000 * (diameter_m - 0.02), atol=0.1)


def test_tilt_of_bar_is_measured() -> None:
    steel = mat()
    start, end = np.array(steel[0].axis_m)
    lean_m = np.tan(np.deg2rad(2.0)) * 0.14
    axis_m = ((*start[:2], start[2] - lean_m), (*end[:2], end[2] + lean_m))
    steel[0] = replace(steel[0], axis_m=axis_m)
    tilt_deg = inspected(predicted_m(steel, TRUTH))["axis_tilt_deg"]
    assert tilt_deg[0] == pytest.approx(2.0, abs=0.1)
    assert tilt_deg[1:].max() < 0.01


@pytest.mark.parametrize(("lean_m", "found"), [(0.018, 1), (0.028, 0)])
def test_bar_displaced_at_its_ends_is_not_found(lean_m: float, found: int) -> None:
    truth = view([bar(i, (x, -0.14, 0.4), (x, 0.14, 0.4)) for i, x in ((1, 0.0), (2, 0.04))])
    leaning = bar(1, (0.0, -0.14, 0.4 - lean_m), (0.0, 0.14, 0.4 + lean_m))
    other = bar(2, (0.04, -0.14, 0.4), (0.04, 0.14, 0.4))
    samples = inspected(predicted_m([leaning, other], truth), truth)
    # The middle of the bar does not move; half the distance to the other bar is 20 mm.
    assert samples["bar_found"].tolist() == [found, 1]


def test_noise_does_not_tilt_a_receding_bar() -> None:
    truth = view([bar(1, (-0.1, 0.0, 0.4), (0.06, 0.0, 0.8))])
    exact_m = truth.depth_m.astype(np.float64)
    tilts_deg = [
        inspected(exact_m + 0.05 * rng.standard_normal(len(exact_m)), truth)["axis_tilt_deg"]
        for rng in map(np.random.default_rng, range(20))
    ]
    assert np.median(np.concatenate(tilts_deg)) < 2.5


@pytest.mark.parametrize(("left_out", "found"), [(0.35, 1.0), (0.65, 0.0)])
def test_bar_needs_predictions_on_half_of_its_pixels(left_out: float, found: float) -> None:
    missing = np.random.default_rng(0).random(len(EXACT_M)) < left_out
    assert (inspected(np.where(missing, np.nan, EXACT_M))["bar_found"] == found).all()


def test_bowed_bar_is_judged_by_the_line_through_what_is_seen() -> None:
    """An axis whose bow is 0.6 mm in the middle, of which a bar in front hides the lower half."""
    y_m = np.linspace(-0.14, 0.14, 15)
    points_m = [(0.0, float(y), 0.4 - 0.0006 * (1 - (y / 0.14) ** 2)) for y in y_m]
    pieces = [bar(1, *ends_m) for ends_m in pairwise(points_m)]
    truth = view([*pieces, bar(2, (-0.1, 0.07, 0.3), (0.1, 0.07, 0.3), 0.1)])
    bowed = Bar(1, "bar", 0.02, tuple(points_m))
    scene = SceneBars.of([bowed])
    assert len(scene.cage) == 1, "straight enough for one segment"
    truth = replace(truth, bars=scene, run=np.where(truth.bar_id == 1, 0, -1))
    bars = steel_samples(truth.depth_m.astype(np.float64), truth).bars
    assert bars.found.tolist() == [True]
    y, z = bars.point_m[0, 1], bars.point_m[0, 2]
    assert -0.09 < y < -0.03
    assert z == pytest.approx(0.4 - 0.0006 * (1 - (y / 0.14) ** 2), abs=1e-4)
    assert bars.offset_mm[0] < 0.1
    assert bars.tilt_deg[0] < 0.1


def test_rim_pixels_are_ignored() -> None:
    whole, rim_spoilt = inspected(EXACT_M), inspected(np.where(TRUTH.interior, EXACT_M, 9.0))
    assert not TRUTH.interior.all()
    assert all(whole[name].tobytes() == rim_spoilt[name].tobytes() for name in whole)


def test_missing_bars_count_as_failures() -> None:
    whole, all_missing = inspected(EXACT_M), inspected(np.full(len(EXACT_M), np.nan))
    without_one = inspected(np.where(TRUTH.bar_id == 2, np.nan, EXACT_M))
    for samples in (all_missing, without_one):
        for name in whole:
            if name not in DETECTED_BARS_ONLY:
                assert len(samples[name]) == len(whole[name]), name
    assert not all_missing["bar_found"].any()
    assert (all_missing["spacing_judged_mm"] == MISS_MM).all()
    assert without_one["bar_found"].tolist() == [1, 0, 1, 1, 1, 1]
    assert sorted(without_one["spacing_judged_mm"])[-1] == MISS_MM
    assert (without_one["depth_offset_judged_mm"] == MISS_MM).sum() == 1


@settings(max_examples=5)
@given(
    st.tuples(*[st.floats(-3.0, 3.0)] * 3), st.tuples(*[st.floats(-20.0, 20.0)] * 3), st.permutations(range(1, 7))
)
def test_measures_are_independent_of_world_frame_and_ids(
    rotation_rad: tuple[float, float, float], shift: tuple[float, float, float], ids: list[int]
) -> None:
    rotation, shift_m = rotation_matrix(rotation_rad), np.array(shift)
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = rotation.T
    cam_from_world[:3, 3] = -rotation.T @ shift_m
    noise_m = 0.002 * np.random.default_rng(0).standard_normal(len(EXACT_M))
    for bars, truth, samples_of_view in (
        (mat(), TRUTH, inspected),
        (BARS, BUILT_TRUTH, deviations),
    ):
        p_m = truth.depth_m * 1.01 + noise_m[: len(truth.depth_m)]
        elsewhere = [
            replace(
                steel,
                bar_id=bar_id,
                axis_m=moved(steel.axis_m, rotation, shift_m),
                nominal_axis_m=moved(steel.nominal_axis_m, rotation, shift_m) if steel.nominal_axis_m else (),
            )
            for steel, bar_id in zip(bars, ids, strict=True)
        ]
        bar_id = np.concatenate([[0], ids])[truth.bar_id].astype(np.uint16)
        other = replace(truth, cam_from_world=cam_from_world, bar_id=bar_id, bars=SceneBars.of(elsewhere))
        before, after = samples_of_view(p_m, truth), samples_of_view(p_m, other)
        for name, values in before.items():
            np.testing.assert_allclose(np.sort(after[name]), np.sort(values), atol=1e-6, err_msg=name)


def test_noise_larger_than_bars_averages_out() -> None:
    rng = np.random.default_rng(1)
    samples = inspected(EXACT_M + 0.015 * rng.standard_normal(len(EXACT_M)))
    assert samples["bar_found"].all()
    # 15 mm / sqrt(64 points) is 1.9 mm; Tukey's weights and the slope add a little.
    assert np.abs(samples["depth_offset_error_mm"]).max() < 6.0


def test_outliers_and_extreme_values_do_not_move_a_bar() -> None:
    rng = np.random.default_rng(2)
    is_outlier = rng.random(len(EXACT_M)) < 0.33
    outliers_m = np.where(is_outlier, EXACT_M + rng.uniform(0.05, 2.0, len(EXACT_M)), EXACT_M)
    extreme_m = EXACT_M.copy()
    extreme_m[::9], extreme_m[4::9], extreme_m[7::9] = 1e300, -np.inf, 1e-300
    for p_m, offset_mm in ((outliers_m, 0.5), (extreme_m, 0.05)):
        samples = inspected(p_m)
        assert samples["bar_found"].all()
        assert samples["axis_offset_judged_mm"].max() < offset_mm


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 0.0, -1.0, 1e-320, 1e300, np.finfo(float).max])
def test_uniform_prediction_finds_no_bar(value: float) -> None:
    samples = inspected(np.full(len(EXACT_M), value))
    assert not samples["bar_found"].any()
    assert all(np.isfinite(values).all() for values in samples.values())


def test_no_visible_segment_gives_empty_samples() -> None:
    truth = replace(TRUTH, run=np.full_like(TRUTH.run, -1))
    assert all(len(values) == 0 for values in inspected(EXACT_M, truth).values())
    no_bars = replace(truth, bars=SceneBars.of(()))
    assert all(len(values) == 0 for values in inspected(EXACT_M, no_bars).values())


def test_rendered_truth_is_perfect_up_to_ribs(tiny_root: Path) -> None:
    folder = open_folder(tiny_root)
    steel = load_steel_truth(folder, folder.config("lattice"))
    offsets_mm, detected = [], []
    for number in range(len(steel)):
        truth = steel.view(number)
        samples = inspected(truth.depth_m.astype(np.float64), truth)
        offsets_mm.append(samples["axis_offset_judged_mm"])
        detected.append(samples["bar_found"])
    assert len(np.concatenate(detected)) > 0
    assert np.concatenate(detected).all()
    # A rib of a 7 mm bar is 0.4 mm high.
    assert np.concatenate(offsets_mm).max() < 0.4


# Deviation from the design.


def deviation_samples(p_m: np.ndarray, bars: Sequence[Bar] = BARS) -> Samples:
    return deviations(p_m, replace(BUILT_TRUTH, bars=SceneBars.of(bars)))


def value(samples: Samples, name: str) -> float:
    [measure] = [measure for measure in AS_BUILT_MEASURES if measure.name == name]
    return STATISTICS[measure.statistic](samples[measure.sample])


def test_exact_depth_measures_the_deviation() -> None:
    samples = deviation_samples(BUILT_EXACT_M)
    np.testing.assert_allclose(samples["deviation_true_mm"], TRUE_MM, atol=1e-9)
    assert samples["deviation_judged_mm"].max() < 2e-3
    assert abs(samples["deviation_excess_mm"]).max() < 2e-3
    off = TRUE_MM > OFF_MM
    assert 1 < off.sum() < len(off)
    assert samples["off_reported"].tolist() == samples["off_confirmed"].tolist() == [1.0] * off.sum()


def test_displaced_prediction_has_the_errors_of_its_displacement() -> None:
    """Compare with the closed form: measured deviation = deviation as built + displacement, across the bar."""
    move_mm = np.array([3.0, 2.0, 5.0])
    moved = [replace(bar, axis_m=displaced(bar, move_mm).axis_m) for bar in BARS]
    samples = deviation_samples(predicted_m(moved, BUILT_TRUTH))
    across = move_mm * (1 - ALONG)
    measured_mm = np.linalg.norm((BUILT_MM + move_mm) * (1 - ALONG), axis=1)
    np.testing.assert_allclose(samples["deviation_judged_mm"], np.linalg.norm(across, axis=1), atol=0.06)
    np.testing.assert_allclose(samples["deviation_excess_mm"], measured_mm - TRUE_MM, atol=0.06)
    assert value(samples, "deviation_bias_mm") == pytest.approx(np.mean(measured_mm - TRUE_MM), abs=0.03)
    assert value(samples, "deviation_true_median_mm") == pytest.approx(np.median(TRUE_MM))
    reported, off = measured_mm > OFF_MM, TRUE_MM > OFF_MM
    assert (reported != off).any()
    assert samples["off_reported"].tolist() == reported[off].astype(float).tolist()
    assert samples["off_confirmed"].tolist() == off[reported].astype(float).tolist()


def test_bars_without_prediction_are_missed() -> None:
    hidden = np.isin(BUILT_TRUTH.bar_id, [3, 6])
    samples = deviation_samples(np.where(hidden, np.nan, BUILT_EXACT_M))
    assert (samples["deviation_judged_mm"] == MISS_MM).tolist() == [False, False, True, False, False, True]
    assert len(samples["deviation_excess_mm"]) == 4
    off = TRUE_MM > OFF_MM
    assert samples["off_reported"].tolist() == [0.0 if bar in (3, 6) else 1.0 for bar in np.flatnonzero(off) + 1]
    assert samples["off_confirmed"].all()
    np.testing.assert_array_equal(
        samples["deviation_true_mm"], deviation_samples(BUILT_EXACT_M)["deviation_true_mm"]
    )
    for nothing in (np.full_like(BUILT_EXACT_M, np.nan), np.full_like(BUILT_EXACT_M, 1e300), -BUILT_EXACT_M):
        assert (deviation_samples(nothing)["deviation_judged_mm"] == MISS_MM).all()


def test_found_bars_are_those_of_inspection() -> None:
    noisy_m = BUILT_EXACT_M + 0.02 * np.random.default_rng(5).standard_normal(len(BUILT_EXACT_M))
    noisy_m[BUILT_TRUTH.bar_id == 2] = np.nan
    found = inspected(noisy_m, BUILT_TRUTH)["bar_found"]
    assert ((deviation_samples(noisy_m)["deviation_judged_mm"] == MISS_MM) == (found == 0)).all()


def test_bars_that_are_in_no_design_are_not_judged() -> None:
    in_design = [replace(bar, nominal_axis_m=()) if bar.bar_id in (1, 4) else bar for bar in BARS]
    chosen = [1, 2, 4, 5]
    np.testing.assert_allclose(deviation_samples(BUILT_EXACT_M, in_design)["deviation_true_mm"], TRUE_MM[chosen])
    none = deviation_samples(BUILT_EXACT_M, [replace(bar, nominal_axis_m=()) for bar in BARS])
    assert none == {}
    points = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    without_length = deviation_samples(BUILT_EXACT_M, [replace(bar, nominal_axis_m=points) for bar in BARS])
    assert without_length == {}


def test_arm_of_a_bent_bar_is_compared_with_the_same_arm() -> None:
    """An arm of the nominal axis that ends on the bar as built, nearer but across it, is not taken."""
    built = displaced(mat()[1], (6, 0, 8))
    (x, y, z), end = built.nominal_axis_m
    across = ((0.1, 0.0, z + 0.008), (x + 0.006, 0.0, z + 0.008))
    nominal = ((x, y, z), end, *across)
    bars = [replace(built, nominal_axis_m=nominal)]
    truth = view(bars)
    samples = deviations(truth.depth_m.astype(float), truth)
    np.testing.assert_allclose(samples["deviation_true_mm"], [10.0], atol=1e-6)
    assert samples["deviation_judged_mm"].max() < 2e-3


def test_bow_of_a_bar_is_measured() -> None:
    """The axis as built is bowed by 0.6 mm, which its chord is not; the predicted bar is straight."""
    y_m = np.linspace(-0.14, 0.14, 15)
    bow_m = 0.0006 * (1 - (y_m / 0.14) ** 2)
    nominal = ((0.0, -0.14, 0.4), (0.0, 0.14, 0.4))
    axis_m = tuple((0.0, float(y), 0.4 - float(b)) for y, b in zip(y_m, bow_m, strict=True))
    straight = Bar(1, "bar", 0.02, nominal, nominal)
    truth = view([straight])
    truth = replace(truth, bars=replace(truth.bars, designed={1: replace(straight, axis_m=axis_m)}))
    samples = deviations(truth.depth_m.astype(float), truth)
    np.testing.assert_allclose(samples["deviation_true_mm"], [0.6], atol=0.01)
    np.testing.assert_allclose(samples["deviation_judged_mm"], [0.6], atol=0.01)
