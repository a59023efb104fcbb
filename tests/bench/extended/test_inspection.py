from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.extended.ground_truth import steel_config
from rebar_depth_bench.extended.inspection.evaluate import MEASURES, inspection_samples
from rebar_depth_bench.extended.inspection.measures import MISS_MM
from rebar_depth_bench.extended.inspection.segments import cage_truth
from rebar_depth_bench.extended.inspection.tolerances import PROFILES, pass_sample
from rebar_depth_bench.extended.measures import STATISTICS, Samples
from rebar_depth_bench.geometry.cameras import rotation_matrix
from tests.bench.extended.cage_scenes import bar, mat, predicted_m, view

TRUTH, CAGE = view(mat())
EXACT_M = TRUTH.depth_m.astype(np.float64)
FOUND_ONLY = (
    "axis_offset_mm",
    "axis_tilt_deg",
    *(f"{kind}_error_mm" for kind in ("spacing", "layer", "cover", "diameter")),
)
HIGHER_IS_BETTER = ("bar_found", *(pass_sample(t) for profile in PROFILES for t in profile.tolerances))


def sampled(p_m: np.ndarray) -> Samples:
    return inspection_samples(p_m, TRUTH, CAGE)


def test_truth_is_perfect_on_smooth_bars() -> None:
    samples = sampled(EXACT_M)
    assert samples["bar_found"].tolist() == [1.0] * 6
    # Neighbours: 1-2, 2-3 and 4-5 side by side, and 2-6, which lies mostly along the optical axis.
    assert len(samples["spacing_judged_mm"]) == 3
    assert len(samples["layer_judged_mm"]) == 1
    for name, values in samples.items():
        if name.endswith(("_error_mm", "_judged_mm", "_offset_mm")):
            assert len(values) > 0
            assert np.abs(values).max() < (0.05 if name.startswith("diameter") else 2e-3), name
        if name.startswith("pass_"):
            assert values.all()


@pytest.mark.parametrize("move_mm", [(0, 0, 6), (0, 0, -6), (1.5, 0, 0), (2, 0, 4)])
def test_bars_moved_by_a_vector_are_found_moved_by_it(move_mm: tuple[float, float, float]) -> None:
    dx, dy, dz = (value / 1000 for value in move_mm)
    samples = sampled(predicted_m(mat(dx, dy, dz), TRUTH))
    np.testing.assert_allclose(samples["cover_error_mm"], move_mm[2], atol=0.05)
    upright = [np.hypot(move_mm[0], move_mm[2])] * 3
    lying = [np.hypot(move_mm[1], move_mm[2])] * 2
    np.testing.assert_allclose(samples["axis_offset_mm"], [*upright, *lying, upright[0]], atol=0.05)
    np.testing.assert_allclose(samples["spacing_error_mm"], 0, atol=0.05)
    np.testing.assert_allclose(samples["layer_error_mm"], 0, atol=0.05)


def test_one_bar_moved_away_changes_its_layer_distance_only() -> None:
    steel = mat()
    steel[5] = mat(dz=0.004)[5]
    samples = sampled(predicted_m(steel, TRUTH))
    # Bars 2 and 6 are 30 mm aside and 100 mm behind one another.
    expected_mm = 4 * 0.1 / np.hypot(0.03, 0.1)
    np.testing.assert_allclose(samples["layer_error_mm"], expected_mm, atol=0.05)
    assert np.sort(np.abs(samples["cover_error_mm"]))[-2] < 0.01


@pytest.mark.parametrize("scale", [0.98, 1.03])
def test_a_scale_stretches_all_separations_alike(scale: float) -> None:
    samples = sampled(scale * EXACT_M)
    # The bar keeps its nominal radius, so what moves by s - 1 times its place is its visible side, not its axis:
    # seen from before the gap, the visible sides of two bars are closer than their axes by less than a diameter.
    np.testing.assert_allclose(samples["spacing_error_mm"] / (scale - 1), [80, 80, 100], rtol=0.06)
    np.testing.assert_allclose(samples["layer_error_mm"] / (scale - 1), [np.hypot(30, 100)], rtol=0.01)
    np.testing.assert_allclose(samples["cover_error_mm"] / (scale - 1), [390, 390, 390, 450, 450, 490], rtol=0.01)
    np.testing.assert_allclose(samples["diameter_error_mm"] / (scale - 1), 20, rtol=0.02)


@pytest.mark.parametrize("diameter_m", [0.018, 0.022])
def test_a_wrong_radius_is_measured(diameter_m: float) -> None:
    samples = sampled(predicted_m(mat(diameter_m=diameter_m), TRUTH))
    assert len(samples["diameter_error_mm"]) >= 3
    np.testing.assert_allclose(samples["diameter_error_mm"], 1000 * (diameter_m - 0.02), atol=0.1)


def test_a_tilted_bar_is_found_tilted() -> None:
    steel = mat()
    start, end = np.array(steel[0].axis_m)
    lean_m = np.tan(np.deg2rad(2.0)) * 0.14
    axis_m = ((*start[:2], start[2] - lean_m), (*end[:2], end[2] + lean_m))
    steel[0] = replace(steel[0], axis_m=axis_m)
    tilt_deg = sampled(predicted_m(steel, TRUTH))["axis_tilt_deg"]
    assert tilt_deg[0] == pytest.approx(2.0, abs=0.1)
    assert tilt_deg[1:].max() < 0.01


@pytest.mark.parametrize(("lean_m", "found"), [(0.018, 1), (0.028, 0)])
def test_a_bar_that_leaves_its_place_at_its_ends_is_not_found(lean_m: float, found: int) -> None:
    truth, cage = view([bar(i, (x, -0.14, 0.4), (x, 0.14, 0.4)) for i, x in ((1, 0.0), (2, 0.04))])
    leaning = bar(1, (0.0, -0.14, 0.4 - lean_m), (0.0, 0.14, 0.4 + lean_m))
    other = bar(2, (0.04, -0.14, 0.4), (0.04, 0.14, 0.4))
    samples = inspection_samples(predicted_m([leaning, other], truth), truth, cage)
    # Its middle stays where it was; half way to the other bar is 20 mm.
    assert samples["bar_found"].tolist() == [found, 1]


def test_noise_does_not_turn_a_bar_that_runs_away_from_the_camera() -> None:
    truth, cage = view([bar(1, (-0.1, 0.0, 0.4), (0.06, 0.0, 0.8))])
    exact_m = truth.depth_m.astype(np.float64)
    tilts_deg = [
        inspection_samples(exact_m + 0.05 * rng.standard_normal(len(exact_m)), truth, cage)["axis_tilt_deg"]
        for rng in map(np.random.default_rng, range(20))
    ]
    assert np.median(np.concatenate(tilts_deg)) < 2.5


@pytest.mark.parametrize(("left_out", "found"), [(0.35, 1.0), (0.65, 0.0)])
def test_a_bar_needs_half_of_its_pixels(left_out: float, found: float) -> None:
    gone = np.random.default_rng(0).random(len(EXACT_M)) < left_out
    assert (sampled(np.where(gone, np.nan, EXACT_M))["bar_found"] == found).all()


def test_the_rim_does_not_count() -> None:
    whole, rim_spoilt = sampled(EXACT_M), sampled(np.where(TRUTH.interior, EXACT_M, 9.0))
    assert not TRUTH.interior.all()
    assert all(whole[name].tobytes() == rim_spoilt[name].tobytes() for name in whole)


def test_what_is_left_out_fails() -> None:
    whole, nothing = sampled(EXACT_M), sampled(np.full(len(EXACT_M), np.nan))
    without_one = sampled(np.where(TRUTH.bar_id == 2, np.nan, EXACT_M))
    for samples in (nothing, without_one):
        for name in whole:
            if name not in FOUND_ONLY:
                assert len(samples[name]) == len(whole[name]), name
    assert not any(nothing[name].any() for name in HIGHER_IS_BETTER)
    assert (nothing["spacing_judged_mm"] == MISS_MM).all()
    assert without_one["bar_found"].tolist() == [1, 0, 1, 1, 1, 1]
    assert sorted(without_one["spacing_judged_mm"])[-1] == MISS_MM
    assert without_one["pass_gb50204_cover_beam"].sum() == 5


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 1.0), st.floats(0.0, 0.03))
def test_damage_never_helps(seed: int, left_out: float, noise_m: float) -> None:
    rng = np.random.default_rng(seed)
    damaged_m = EXACT_M + noise_m * rng.standard_normal(len(EXACT_M))
    damaged_m[rng.random(len(EXACT_M)) < left_out] = np.nan
    once, twice = sampled(damaged_m), sampled(np.where(rng.random(len(EXACT_M)) < 0.6, np.nan, damaged_m))
    whole = sampled(EXACT_M)
    for name in HIGHER_IS_BETTER:
        assert once[name].mean() <= whole[name].mean()
    # Six tenths of anything is more than half: no bar has enough predictions after that.
    assert twice["bar_found"].sum() <= once["bar_found"].sum()


@settings(max_examples=15)
@given(
    st.tuples(*[st.floats(-3.0, 3.0)] * 3), st.tuples(*[st.floats(-20.0, 20.0)] * 3), st.permutations(range(1, 7))
)
def test_neither_the_world_frame_nor_bar_ids_matter(
    turn_rad: tuple[float, float, float], shift_m: tuple[float, float, float], ids: list[int]
) -> None:
    rotation = rotation_matrix(turn_rad)
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = rotation.T
    cam_from_world[:3, 3] = -rotation.T @ np.array(shift_m)
    moved = []
    for steel, bar_id in zip(mat(), ids, strict=True):
        ends_m = np.array(steel.axis_m) @ rotation.T + np.array(shift_m)
        moved.append(replace(steel, bar_id=bar_id, axis_m=tuple(map(tuple, ends_m.tolist()))))
    bar_id = np.concatenate([[0], ids])[TRUTH.bar_id].astype(np.uint16)
    truth = replace(TRUTH, cam_from_world=cam_from_world, bar_id=bar_id)
    p_m = EXACT_M * 1.01 + 0.002 * np.random.default_rng(0).standard_normal(len(EXACT_M))
    before, after = sampled(p_m), inspection_samples(p_m, truth, cage_truth(moved))
    for name, values in before.items():
        np.testing.assert_allclose(np.sort(after[name]), np.sort(values), atol=1e-6, err_msg=name)


def test_noise_wider_than_the_bars_averages_out() -> None:
    rng = np.random.default_rng(1)
    samples = sampled(EXACT_M + 0.015 * rng.standard_normal(len(EXACT_M)))
    assert samples["bar_found"].all()
    # 15 mm over the root of 64 points is 1.9 mm; Tukey's weights and the slope cost a little.
    assert np.abs(samples["cover_error_mm"]).max() < 6.0


def test_a_third_of_wild_values_does_not_move_a_bar() -> None:
    rng = np.random.default_rng(2)
    wild = rng.random(len(EXACT_M)) < 0.33
    samples = sampled(np.where(wild, EXACT_M + rng.uniform(0.05, 2.0, len(EXACT_M)), EXACT_M))
    assert samples["bar_found"].all()
    assert samples["axis_offset_mm"].max() < 0.5


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 0.0, -1.0, 1e-320, 1e300, np.finfo(float).max])
def test_no_value_is_worth_anything_by_itself(value: float) -> None:
    samples = sampled(np.full(len(EXACT_M), value))
    assert not samples["bar_found"].any()
    assert all(np.isfinite(values).all() for values in samples.values())


def test_hostile_values_among_good_ones_only_cost_themselves() -> None:
    spoilt = EXACT_M.copy()
    spoilt[::9], spoilt[4::9], spoilt[7::9] = 1e300, -np.inf, 1e-300
    samples = sampled(spoilt)
    assert samples["bar_found"].all()
    assert samples["axis_offset_mm"].max() < 0.05


def test_no_run_seen_gives_empty_samples() -> None:
    truth = replace(TRUTH, run=np.full_like(TRUTH.run, -1))
    assert all(len(values) == 0 for values in inspection_samples(EXACT_M, truth, CAGE).values())
    assert all(len(values) == 0 for values in inspection_samples(EXACT_M, truth, cage_truth([])).values())


def test_a_prediction_of_another_length_is_refused() -> None:
    with pytest.raises(ValueError, match="p_m has shape"):
        sampled(EXACT_M[:-1])


def test_the_same_input_gives_the_same_bytes_and_is_left_alone() -> None:
    p_m = 1.01 * EXACT_M
    kept = p_m.copy()
    first, second = sampled(p_m), sampled(p_m)
    assert all(first[name].tobytes() == second[name].tobytes() for name in first)
    assert p_m.tobytes() == kept.tobytes()


def test_every_measure_stands_on_a_sample_and_every_name_is_taken_once() -> None:
    samples = sampled(EXACT_M)
    assert {measure.sample for measure in MEASURES} <= set(samples)
    assert len({measure.name for measure in MEASURES}) == len(MEASURES)
    assert all(np.isfinite(STATISTICS[measure.statistic](samples[measure.sample])) for measure in MEASURES)
    # What leaves out the bars that were not found is no better for being lower.
    assert all(measure.better == "" for measure in MEASURES if measure.sample in FOUND_ONLY)


@pytest.mark.render
def test_rendered_truth_is_perfect_up_to_ribs(tiny_root: Path) -> None:
    steel = steel_config(open_folder(tiny_root), "lattice")
    offsets_mm, found = [], []
    for place in range(len(steel)):
        truth = steel.view(place)
        samples = inspection_samples(truth.depth_m.astype(np.float64), truth, steel.cage)
        offsets_mm.append(samples["axis_offset_mm"])
        found.append(samples["bar_found"])
    assert len(np.concatenate(found)) > 0
    assert np.concatenate(found).all()
    # A rib of a 7 mm bar is 0.4 mm high.
    assert np.concatenate(offsets_mm).max() < 0.4
