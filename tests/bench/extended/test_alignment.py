"""Tests of alignments: recovery of known scale and shift, independent solvers and missing predictions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rebar_depth_bench.extended.alignment import (
    MEASURES,
    alignment_samples,
    log_scale,
    scale_and_shift,
    scale_invariant_log,
)
from tests.bench.extended.steel import steel_truth

SEEDS = st.integers(0, 2**32 - 1)


def depths(seed: int, count: int = 400) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.2, 1.0, count).astype(np.float32).astype(float)


def values(p: np.ndarray, z: np.ndarray) -> dict[str, float]:
    return {name: samples[0] for name, samples in alignment_samples(p, steel_truth(z)).items() if len(samples)}


def test_golden_case_by_hand() -> None:
    measured = values(np.array([1.0, 2.0, 4.0]), np.array([1.0, 1.0, 2.0]))
    assert measured["scale"] == 0.5
    # native: |1-1|/1, |2-1|/1, |4-2|/2 -> 2/3; with s = 1/2: |0.5-1|/1, 0, 0 -> 1/6
    assert measured["scale_explains"] == pytest.approx(1 - (1 / 6) / (2 / 3))
    # log: offsets 0, -ln 2, -ln 2 -> mean -2/3 ln 2, spread sqrt(2)/3 ln 2
    assert measured["silog"] == pytest.approx(np.sqrt(2) / 3 * np.log(2))
    q = 2 ** (-2 / 3)
    assert measured["log_scaled_abs_rel"] == pytest.approx((abs(q - 1) + abs(2 * q - 1) + abs(4 * q - 2) / 2) / 3)
    # least squares through (1, 1), (2, 1), (4, 2): a = 5/14, b = 1/2
    assert measured["shift_cm"] == pytest.approx(50)
    errors = np.array([5 / 14 + 0.5 - 1, 10 / 14 + 0.5 - 1, 20 / 14 + 0.5 - 2])
    assert measured["shifted_rmse_cm"] == pytest.approx(100 * np.sqrt(np.mean(errors**2)))


@settings(max_examples=40)
@given(SEEDS, st.floats(0.05, 20), st.floats(-0.1, 5))
def test_known_scale_and_shift_are_recovered(seed: int, factor: float, shift_m: float) -> None:
    z = depths(seed)
    scaled = values(factor * z, z)
    assert scaled["scale"] == pytest.approx(1 / factor)
    assert scaled["log_scaled_abs_rel"] == pytest.approx(0, abs=1e-9)
    assert scaled["silog"] == pytest.approx(0, abs=1e-6)
    if abs(factor - 1) > 1e-3:
        assert scaled["scale_explains"] == pytest.approx(1, abs=1e-6)
    moved = factor * z + factor * shift_m
    measured = values(moved, z)
    assert measured["shift_cm"] == pytest.approx(-100 * shift_m, abs=1e-5)
    assert measured["shifted_abs_rel"] == pytest.approx(0, abs=1e-6)
    assert measured["shifted_delta1"] == 1.0


@given(SEEDS)
def test_alignments_agree_with_independent_solvers(seed: int) -> None:
    z = depths(seed)
    p = 2 * z + 0.3 + np.random.default_rng(seed).normal(0, 0.05, len(z))
    a, b_m = scale_and_shift(p, z)
    assert (a, b_m) == pytest.approx(tuple(np.polyfit(p, z, 1)))
    best = log_scale(p, z)
    cost = [np.sum((np.log(s * p) - np.log(z)) ** 2) for s in (0.999 * best, best, 1.001 * best)]
    assert min(cost) == cost[1]
    d = np.log(p) - np.log(z)
    assert scale_invariant_log(p, z) == pytest.approx(np.sqrt(np.mean(d**2) - np.mean(d) ** 2))


@given(SEEDS, st.floats(0.1, 10))
def test_aligned_measures_are_independent_of_unit(seed: int, unit: float) -> None:
    z = depths(seed)
    p = z * np.random.default_rng(seed).uniform(0.7, 1.3, len(z))
    in_metres, in_other_unit = values(p, z), values(unit * p, z)
    for name in in_metres:
        if name.startswith(("log_scaled", "shifted", "silog", "shift_cm")):
            assert in_other_unit[name] == pytest.approx(in_metres[name], rel=1e-6, abs=1e-9)


@given(SEEDS, st.floats(0.005, 0.05))
def test_more_noise_increases_error(seed: int, noise_m: float) -> None:
    z = depths(seed)
    noise = np.random.default_rng(seed).normal(0, 1, len(z))
    little, much = values(z + noise_m * noise, z), values(z + 3 * noise_m * noise, z)
    assert little["silog"] < much["silog"]
    assert little["shifted_rmse_cm"] < much["shifted_rmse_cm"]


def test_constant_prediction_is_only_shifted() -> None:
    z = depths(3)
    assert scale_and_shift(np.full(len(z), 2.0), z) == pytest.approx((1.0, z.mean() - 2.0))


def test_missing_prediction_has_no_samples_extremes_no_warning() -> None:
    z = depths(4)
    assert values(np.full(len(z), np.nan), z) == {}
    assert set(values(np.full(len(z), 1e300), z)) <= {measure.sample for measure in MEASURES}
    assert values(np.full(len(z), 1e-300), z)["scale"] > 1e299


def test_ground_truth_is_perfect() -> None:
    z = depths(5)
    measured = values(z, z)
    assert measured["scale"] == 1.0
    assert "scale_explains" not in measured  # there is no error to explain
    assert all(
        measured[name] == pytest.approx(0, abs=1e-9) for name in measured if "abs_rel" in name or "_cm" in name
    )
    assert measured["log_scaled_delta1"] == measured["shifted_delta1"] == 1.0
