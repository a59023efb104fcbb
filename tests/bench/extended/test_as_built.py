"""Tests of the deviation from the design: closed forms of displaced bars, misses, bends, bows and other frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import rebar_depth_bench as rdb
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.extended.as_built import MEASURES, OFF_MM, as_built_samples
from rebar_depth_bench.extended.fits import MISS_MM
from rebar_depth_bench.extended.inspection import inspection_samples
from rebar_depth_bench.extended.measures import STATISTICS, Samples
from rebar_depth_bench.extended.registry import score_extended
from rebar_depth_bench.extended.steel import SceneBars
from rebar_depth_bench.geometry.cameras import rotation_matrix
from rebar_depth_bench.scoring.evaluation import open_evaluation
from tests.bench.extended.cage_scenes import mat, predicted_m, view

BUILT_MM = np.array([(0, 0, 0), (4, 0, 3), (12, 5, 0), (0, 9, -12), (3, -15, 2), (-8, 0, 7)], float)
"""Displacement of each bar of ``mat`` from its nominal axis."""
ALONG = np.array([(0, 1, 0)] * 3 + [(1, 0, 0)] * 2 + [(0, 1, 0)], float)
TRUE_MM = np.linalg.norm(BUILT_MM * (1 - ALONG), axis=1)


def displaced(bar: Bar, by_mm: Sequence[float] | np.ndarray) -> Bar:
    """Return a bar displaced as built, whose nominal axis is where it was."""
    axis_m = tuple(tuple(float(v) for v in np.add(point, np.divide(by_mm, 1000))) for point in bar.axis_m)
    return replace(bar, axis_m=axis_m, nominal_axis_m=bar.axis_m)  # type: ignore[arg-type]


BARS = [displaced(bar, by_mm) for bar, by_mm in zip(mat(), BUILT_MM, strict=True)]
TRUTH = view(BARS)
EXACT_M = TRUTH.depth_m.astype(np.float64)


def samples_of(p_m: np.ndarray, bars: Sequence[Bar] = BARS) -> Samples:
    return as_built_samples(p_m, replace(TRUTH, bars=SceneBars.of(bars)))


def value(samples: Samples, name: str) -> float:
    [measure] = [measure for measure in MEASURES if measure.name == name]
    return STATISTICS[measure.statistic](samples[measure.sample])


def test_exact_depth_measures_the_deviation() -> None:
    samples = samples_of(EXACT_M)
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
    samples = samples_of(predicted_m(moved, TRUTH))
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
    hidden = np.isin(TRUTH.bar_id, [3, 6])
    samples = samples_of(np.where(hidden, np.nan, EXACT_M))
    assert (samples["deviation_judged_mm"] == MISS_MM).tolist() == [False, False, True, False, False, True]
    assert len(samples["deviation_excess_mm"]) == 4
    off = TRUE_MM > OFF_MM
    assert samples["off_reported"].tolist() == [0.0 if bar in (3, 6) else 1.0 for bar in np.flatnonzero(off) + 1]
    assert samples["off_confirmed"].all()
    np.testing.assert_array_equal(samples["deviation_true_mm"], samples_of(EXACT_M)["deviation_true_mm"])
    for nothing in (np.full_like(EXACT_M, np.nan), np.full_like(EXACT_M, 1e300), -EXACT_M):
        assert (samples_of(nothing)["deviation_judged_mm"] == MISS_MM).all()


def test_found_bars_are_those_of_inspection() -> None:
    noisy_m = EXACT_M + 0.02 * np.random.default_rng(5).standard_normal(len(EXACT_M))
    noisy_m[TRUTH.bar_id == 2] = np.nan
    found = inspection_samples(noisy_m, TRUTH)["bar_found"]
    assert ((samples_of(noisy_m)["deviation_judged_mm"] == MISS_MM) == (found == 0)).all()


def test_bars_that_are_in_no_design_are_not_judged() -> None:
    in_design = [replace(bar, nominal_axis_m=()) if bar.bar_id in (1, 4) else bar for bar in BARS]
    chosen = [1, 2, 4, 5]
    np.testing.assert_allclose(samples_of(EXACT_M, in_design)["deviation_true_mm"], TRUE_MM[chosen])
    none = samples_of(EXACT_M, [replace(bar, nominal_axis_m=()) for bar in BARS])
    assert none == {}
    points = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    without_length = samples_of(EXACT_M, [replace(bar, nominal_axis_m=points) for bar in BARS])
    assert without_length == {}


def test_arm_of_a_bent_bar_is_compared_with_the_same_arm() -> None:
    """An arm of the nominal axis that ends on the bar as built, nearer but across it, is not taken."""
    built = displaced(mat()[1], (6, 0, 8))
    (x, y, z), end = built.nominal_axis_m
    across = ((0.1, 0.0, z + 0.008), (x + 0.006, 0.0, z + 0.008))
    nominal = ((x, y, z), end, *across)
    bars = [replace(built, nominal_axis_m=nominal)]
    truth = view(bars)
    samples = as_built_samples(truth.depth_m.astype(float), truth)
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
    samples = as_built_samples(truth.depth_m.astype(float), truth)
    np.testing.assert_allclose(samples["deviation_true_mm"], [0.6], atol=0.01)
    np.testing.assert_allclose(samples["deviation_judged_mm"], [0.6], atol=0.01)


@settings(max_examples=15)
@given(
    st.tuples(*[st.floats(-3, 3)] * 3),
    st.tuples(*[st.floats(-5, 5)] * 3),
)
def test_samples_do_not_depend_on_the_world_frame(
    turn: tuple[float, float, float], shift_m: tuple[float, float, float]
) -> None:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_matrix(np.array(turn)), shift_m

    def moved(points: Sequence[Sequence[float]]) -> tuple[tuple[float, ...], ...]:
        return tuple(map(tuple, (np.array(points) @ pose[:3, :3].T + pose[:3, 3]).tolist()))

    bars = [
        replace(bar, axis_m=moved(bar.axis_m), nominal_axis_m=moved(bar.nominal_axis_m))  # type: ignore[arg-type]
        for bar in BARS
    ]
    truth = view(bars, np.linalg.inv(pose))
    samples = as_built_samples(truth.depth_m.astype(float) + 0.001, truth)
    expected = samples_of(EXACT_M + 0.001)
    for name, values in samples.items():
        np.testing.assert_allclose(values, expected[name], atol=0.02, err_msg=name)


def test_configs_without_design_have_null(tmp_path: Path, tiny_root: Path) -> None:
    archive = tmp_path / "a.zip"
    with rdb.SubmissionWriter(archive, "truth") as writer:
        for row in rdb.load(tiny_root, "lattice", columns=["view_id", "left_depth"]):
            writer.add(row["view_id"], row["left_depth"])
    with open_evaluation(archive, tiny_root) as evaluation:
        result = score_extended(evaluation).extended
    assert result is not None
    extended = result.to_dict()
    for measure in MEASURES:
        null = {"value": None, "ci95": None, "samples": 0}
        assert extended["tables"]["lattice"]["native"][measure.name] == null
