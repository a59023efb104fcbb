"""Crossings in depth: judged crossings, and measures of exact, displaced and noisy depth."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import ndarray

from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.extended.crossings import MEASURES, crossing_samples
from rebar_depth_bench.extended.fits import LATERAL_PRIOR_RADII
from rebar_depth_bench.extended.judged import ViewCrossings, view_crossings
from rebar_depth_bench.extended.measures import Samples
from rebar_depth_bench.extended.steel import SceneBars, SteelTruth
from tests.bench.extended.cage_scenes import FOCAL_PX, bar, steel_samples, view

D = 0.02
UPRIGHT = bar(1, (0.0, -0.15, 0.40), (0.0, 0.15, 0.40))
LYING = bar(2, (-0.2, 0.0, 0.421), (0.2, 0.0, 0.421))


def turned(angle_deg: float, z_m: float, bar_id: int = 2) -> Bar:
    x, y = 0.14 * math.cos(math.radians(angle_deg)), 0.14 * math.sin(math.radians(angle_deg))
    return bar(bar_id, (-x, -y, z_m), (x, y, z_m))


def samples_of(p_m: ndarray, truth: SteelTruth) -> Samples:
    samples = crossing_samples(steel_samples(p_m, truth).crossings)
    assert {measure.sample for measure in MEASURES} == set(samples)
    return samples


def exact_depth(bars: list[Bar]) -> tuple[SteelTruth, ndarray]:
    truth = view(bars)
    return truth, truth.depth_m.astype(np.float64)


def test_two_bars_by_hand() -> None:
    """An upright bar 1 mm before a lying one: the tie point is 410.5 mm from the camera, on its axis."""
    truth, depth_m = exact_depth([UPRIGHT, LYING])
    found = view_crossings(truth)
    assert found.crossing.tolist() == [0]
    np.testing.assert_allclose(found.ties.tie_point_m, [[0, 0, 0.4105]], atol=1e-9)
    np.testing.assert_allclose(found.ties.normal, [[0, 0, 1]], atol=1e-9)
    samples, crossing = samples_of(depth_m, truth), steel_samples(depth_m, truth).crossings
    assert samples["crossing_located"].tolist() == [1.0]
    assert samples["tie_judged_mm"][0] < 0.02
    assert samples["layer_judged_mm"][0] < 0.02
    assert samples["crossing_angle_judged_deg"][0] < 0.1
    assert [samples[f"tie_within_{limit}mm"].tolist() for limit in (2, 5)] == [[1.0]] * 2
    assert (crossing.crossing_id.tolist(), crossing.bar_a.tolist(), crossing.bar_b.tolist()) == ([1], [1], [2])
    assert crossing.distance_m == pytest.approx([0.4105])
    assert crossing.true_layer_mm == pytest.approx([21.0])
    assert crossing.true_angle_deg == pytest.approx([90.0])


def test_three_bars_of_one_node_are_judged_where_they_are_seen() -> None:
    """A third bar right behind the lying one: its tie point is hidden, and it shows no pixels beside the first."""
    behind = bar(3, (0.0, -0.15, 0.442), (0.0, 0.15, 0.442))
    truth = view([UPRIGHT, LYING, behind])
    scene = truth.bars.crossings
    assert list(zip(scene.bar_id.tolist(), scene.crossings.node_id.tolist(), strict=True)) == [
        ([1, 2], 1),
        ([2, 3], 2),
    ]
    assert truth.judged.crossing.tolist() == [0]
    beside = bar(
        3, (0.03, -0.15, 0.442), (0.03, 0.15, 0.442)
    )  # Seen beside the first, its tie point behind bar 2.
    truth = view([UPRIGHT, LYING, beside])
    assert truth.judged.crossing.tolist() == [0, 1]


def at_border(offset_m: float) -> list[Bar]:
    """Return two bars that cross at a distance from the right border of the image, metres to its right."""
    x = 0.4 * 120 / FOCAL_PX + offset_m
    return [bar(1, (x, -0.15, 0.4), (x, 0.15, 0.4)), bar(2, (x - 0.1, 0, 0.421), (x + 0.1, 0, 0.421))]


@pytest.mark.parametrize(
    ("bars", "judged"),
    [
        ([UPRIGHT, LYING, bar(3, (-0.03, 0.0, 0.30), (0.03, 0.0, 0.30), 0.03)], []),
        ([UPRIGHT, LYING, bar(3, (0.03, -0.1, 0.3), (0.03, 0.1, 0.3), 0.01)], [0]),
        (at_border(-0.06), [0]),
        (at_border(-0.005), []),
        (at_border(0.005), []),
        (at_border(0.05), []),
        ([UPRIGHT, bar(2, (-0.001, 0.0, 0.421), (0.2, 0.0, 0.421))], []),
        ([UPRIGHT, bar(2, (-0.029, 0.0, 0.421), (0.029, 0.0, 0.421))], []),  # The interior spans less than 3 d.
        ([UPRIGHT, bar(2, (-0.04, 0.0, 0.421), (0.04, 0.0, 0.421))], [0]),
        ([UPRIGHT, bar(2, (0.0, -0.1, 0.30), (0.0, 0.1, 0.5421))], []),
    ],
    ids=[
        *("hidden", "beside a bar", "inside", "one side at the border", "tie point outside", "outside"),
        *("on one side", "too short", "long enough", "in one image line"),
    ],
)
def test_crossings_are_judged_where_both_bars_are_seen(bars: list[Bar], judged: list[int]) -> None:
    truth, depth_m = exact_depth(bars)
    assert truth.judged.crossing.tolist() == judged
    samples = samples_of(depth_m, truth)
    assert {len(values) for values in samples.values() if len(values) or judged} == ({1} if judged else set())


def test_bent_bar_is_judged_but_not_fitted() -> None:
    """A bend of 1.5 degrees within 6 diameters leaves depth without a value, and the detectors' task as it is."""
    for x_m, bend_deg, expected in ((0.10, 1.5, []), (0.10, 0.9, [0]), (0.13, 1.5, [0])):
        axis_m = (
            (-0.2, 0.0, 0.421),
            (x_m, 0.0, 0.421),
            (x_m + 0.1, 0.1 * math.tan(math.radians(bend_deg)), 0.421),
        )
        bent = Bar(2, "bent", D, axis_m)
        truth = view([UPRIGHT, LYING])
        assert truth.judged.crossing.tolist() == [0]
        # The picture of the straight bar, the axis of the bent.
        bent_truth = replace(truth, bars=SceneBars.of([UPRIGHT, bent], truth.bars.crossings.crossings))
        assert view_crossings(bent_truth).crossing.tolist() == expected


def test_shifted_depth_shifts_the_tie_point() -> None:
    """Both bars 3 mm too far leave the gap; one 2 mm too far moves the tie point by half and closes the gap."""
    truth, depth_m = exact_depth([UPRIGHT, LYING])
    samples = samples_of(depth_m + 0.003, truth)
    assert samples["tie_along_error_mm"] == pytest.approx([3.0], abs=0.05)
    assert samples["tie_across_judged_mm"] == pytest.approx([0.0], abs=0.05)
    assert samples["layer_error_mm"] == pytest.approx([0.0], abs=0.05)
    assert [samples[f"tie_within_{limit}mm"].tolist() for limit in (2, 5)] == [[0.0], [1.0]]
    samples = samples_of(depth_m + 0.002 * (truth.bar_id == 1), truth)
    assert samples["tie_along_error_mm"] == pytest.approx([1.0], abs=0.05)
    assert samples["layer_error_mm"] == pytest.approx([-2.0], abs=0.05)  # Intersecting cylinders: -1 mm.


def test_missing_predictions_are_not_located() -> None:
    truth, depth_m = exact_depth([UPRIGHT, LYING])
    for p_m in (np.full(len(depth_m), np.nan), np.where(truth.bar_id == 1, np.nan, depth_m)):
        samples = samples_of(p_m, truth)
        assert samples["crossing_located"].tolist() == [0.0]
        assert samples["tie_judged_mm"].tolist() == samples["layer_judged_mm"].tolist() == [100.0]
        assert samples["crossing_angle_judged_deg"].tolist() == [90.0]
        assert samples["tie_within_5mm"].tolist() == [0.0]
        assert len(samples["tie_along_error_mm"]) == 0


@pytest.mark.slow
@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 1e-3, 1.0, 1e6, 1e300]))
def test_wild_predictions_never_warn(seed: int, size: float) -> None:
    truth, depth_m = exact_depth([UPRIGHT, LYING, turned(50, 0.442, 3)])
    rng = np.random.default_rng(seed)
    p_m = depth_m + size * rng.standard_normal(len(depth_m))
    p_m[rng.random(len(p_m)) < 0.2] = np.nan
    samples = samples_of(np.where(p_m > 0, p_m, np.nan), truth)
    assert all(np.isfinite(values).all() for values in samples.values())
    assert samples["tie_judged_mm"].max() <= 100


def predicted_sigma_m(view: ViewCrossings, noise_m: float) -> float:
    """Return the standard deviation of the tie point along the optical axis, by propagation of independent noise.

    Each bar is a least-squares line through the fronts of its samples; noise along the line of sight appears in a
    residual times the cosine of the surface. The tie point is half way between both axes.
    """
    variance = 0.0
    visible = view.visible
    for row in (0, 1):
        radius_m = visible.diameter_m[row] / 2
        across, along = visible.truth_m[row, :, 0] / radius_m, visible.truth_m[row, :, 2]
        cosine = np.sqrt(1 - across**2)
        half_m = visible.half_m[row]
        jacobian = np.column_stack([across, -cosine, across * along / half_m, -cosine * along / half_m])
        lateral = (noise_m / (LATERAL_PRIOR_RADII * radius_m)) ** 2
        normal = jacobian.T @ jacobian + np.diag([lateral, 0, lateral, 0])
        gain = np.linalg.solve(normal, jacobian.T) * (-cosine * noise_m)
        away = visible.frame[row, 1]
        at_crossing = (view.ties.tie_point_m[0] - visible.middle_m[row]) @ visible.frame[row, 2] / half_m
        offset = gain[1] + at_crossing * gain[3]
        variance += float(np.sum((away[2] * offset) ** 2)) / 4
    return math.sqrt(variance)


@pytest.mark.slow
@pytest.mark.parametrize("noise_diameters", [0.01, 0.03, 0.1])
@pytest.mark.parametrize("angle_deg", [0.0, 40.0])
def test_noise_has_the_effect_that_error_propagation_predicts(noise_diameters: float, angle_deg: float) -> None:
    truth, depth_m = exact_depth([UPRIGHT, turned(angle_deg, 0.421)])
    found = view_crossings(truth)
    noise_m, rng = noise_diameters * D, np.random.default_rng(7)
    errors_mm = []
    for _ in range(300):
        samples = samples_of(depth_m + noise_m * rng.standard_normal(len(depth_m)), truth)
        errors_mm += samples["tie_along_error_mm"].tolist()
    assert len(errors_mm) >= 294
    expected_mm = 1000 * predicted_sigma_m(found, noise_m)
    # Tukey's biweight has an efficiency of 95 %, and 300 draws determine a deviation to 4 %.
    assert 0.92 * expected_mm < np.std(errors_mm) < 1.15 * expected_mm
    assert abs(np.mean(errors_mm)) < 4 * expected_mm / math.sqrt(300) + 0.02 * noise_m * 1000
