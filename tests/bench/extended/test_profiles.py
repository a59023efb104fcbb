"""Tests of scale and error by distance and bar width: hand-computed values, and each pixel in one bin."""

from __future__ import annotations

import numpy as np
import pytest

from rebar_depth_bench.extended.profiles import (
    DISTANCE_EDGES_M,
    MEASURES,
    MIN_PIXELS,
    WIDTH_EDGES_PX,
    profile_samples,
)
from tests.bench.extended.steel import steel_truth


def bin_values(p: np.ndarray, z: np.ndarray, bar_id: np.ndarray, diameter_m: np.ndarray) -> dict[str, float]:
    samples = profile_samples(p, steel_truth(z, bar_id, diameter_m=diameter_m))
    return {name: value[0] for name, value in samples.items() if len(value)}


def test_values_by_distance_and_width_bin() -> None:
    near, far = np.full(100, 0.35), np.full(60, 0.8)
    z = np.r_[near, far]
    p = np.r_[2 * near, 4 * far]
    bar_id = np.r_[np.full(100, 1), np.full(60, 2)]
    values = bin_values(
        p, z, bar_id, np.array([np.nan, 0.004, 0.016])
    )  # 700 * 4 / 350 = 8 px, 700 * 16 / 800 = 14 px
    assert values == pytest.approx(
        {
            "scale_at_0.3-0.4m": 0.5,
            "abs_rel_at_0.3-0.4m": 1.0,
            "single_bar_share_at_0.3-0.4m": 1.0,
            "single_bar_abs_rel_at_0.3-0.4m": 1.0,
            "scale_at_0.7-1m": 0.25,
            "abs_rel_at_0.7-1m": 3.0,
            "single_bar_share_at_0.7-1m": 1.0,
            "single_bar_abs_rel_at_0.7-1m": 3.0,
            "scale_at_8-12px": 0.5,
            "abs_rel_at_8-12px": 1.0,
            "scale_at_12-16px": 0.25,
            "abs_rel_at_12-16px": 3.0,
        },
        rel=1e-6,
    )


def test_bin_with_few_predictions_has_no_value() -> None:
    z = np.full(MIN_PIXELS, 0.35)
    p = z.copy()
    assert bin_values(p, z, np.ones(len(z)), np.array([np.nan, 0.01]))
    p[0] = np.nan
    values = bin_values(p, z, np.ones(len(z)), np.array([np.nan, 0.01]))
    assert values == {"single_bar_share_at_0.3-0.4m": 1.0}  # The share needs no prediction.


def test_every_bin_has_a_measure() -> None:
    names = {measure.sample for measure in MEASURES}
    assert len(names) == len(MEASURES) == 4 * (len(DISTANCE_EDGES_M) - 1) + 2 * (len(WIDTH_EDGES_PX) - 1)
    z = np.full(60, 0.35)
    assert set(profile_samples(z, steel_truth(z, diameter_m=np.array([np.nan, 0.01])))) == names
    for edge in DISTANCE_EDGES_M[:-1]:
        z = np.full(60, np.float32(edge) + np.float32(1e-6))
        assert any(f"{edge:g}-" in name for name in bin_values(z, z, np.ones(60), np.array([np.nan, 1e-6])))
