"""Single-bar interior: its pixels, share and errors, against loops over pixels."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import ndarray

from rebar_depth_bench.extended.single_bar import single_bar_samples
from rebar_depth_bench.scoring.protocol import scored_pixels, single_bar_pixels
from tests.bench.extended.thin_scenes import random_images, random_prediction, random_truth, steel_truth

SEEDS = st.integers(0, 2**32 - 1)


def expected_pixels(bars: ndarray, pixels: ndarray) -> list[bool]:
    """Return which flat indices have nine equal ids other than 0 around them, by a loop."""
    width, chosen = bars.shape[1], []
    for pixel in pixels:
        row, column = divmod(int(pixel), width)
        around = {int(bars[y, x]) for y in range(row - 1, row + 2) for x in range(column - 1, column + 2)}
        chosen.append(len(around) == 1 and 0 not in around)
    return chosen


@settings(max_examples=30)
@given(SEEDS)
def test_pixels_equal_a_loop(seed: int) -> None:
    rng = np.random.default_rng(seed)
    depth_m, bars = random_images(rng)
    bars = np.concatenate([[0], rng.permutation(np.arange(1, 60_000))]).astype(np.uint16)[bars]
    pixels = scored_pixels(bars > 0, depth_m)
    assert single_bar_pixels(bars, pixels).tolist() == expected_pixels(bars, pixels)
    truth = steel_truth(depth_m, bars)
    assert all(0 <= share <= 1 for share in single_bar_samples(truth.depth_m, truth)["single_bar_share"])


@settings(max_examples=30)
@given(SEEDS)
def test_measures_equal_numpy_on_the_chosen_pixels(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = random_truth(rng)
    p_m = random_prediction(rng, truth)
    chosen = truth.single_bar
    assert not (chosen & ~truth.interior).any()
    samples = {name: values.tolist() for name, values in single_bar_samples(p_m, truth).items()}
    count = np.count_nonzero(truth.interior)
    assert samples["single_bar_share"] == ([np.count_nonzero(chosen) / count] if count else [])
    with np.errstate(invalid="ignore"):
        valid = chosen & np.isfinite(p_m) & (p_m > 0)
    if not chosen.any():
        assert all(samples.get(f"single_bar_{name}", []) == [] for name in ("abs_rel", "coverage"))
        return
    assert samples["single_bar_coverage"] == [np.count_nonzero(valid) / np.count_nonzero(chosen)]
    z, p = truth.depth_m[valid].astype(np.float64), p_m[valid]
    if valid.any():
        assert samples["single_bar_abs_rel"] == pytest.approx([np.mean(np.abs(p - z) / z)], rel=1e-12)
        assert samples["single_bar_rmse_cm"] == pytest.approx([100 * math.sqrt(np.mean((p - z) ** 2))], rel=1e-12)
        assert samples["single_bar_delta1"] == [np.mean(np.maximum(p / z, z / p) < 1.25)]


def test_steel_without_a_bar_id_is_scored_but_of_no_single_bar() -> None:
    """Imported masks may have steel without a bar id: it counts in the interior that single bars stand beside."""
    depth_m, bars = np.full((9, 14), 0.5, np.float32), np.ones((9, 14), np.uint16)
    truth = steel_truth(depth_m, bars)
    no_id = truth.index % 14 >= 7
    truth = replace(truth, bar_id=np.where(no_id, 0, truth.bar_id), single_bar=truth.single_bar & ~no_id)
    samples = single_bar_samples(np.where(no_id, 1.0, 0.5), truth)
    assert samples["single_bar_abs_rel"] == [0.0]
    assert samples["single_bar_views_abs_rel"] == samples["single_bar_share"] == [0.5]


def test_view_without_single_bar_pixels_has_no_errors() -> None:
    bars = np.indices((9, 9)).sum(axis=0).astype(np.uint16) % 2 + 1
    truth = steel_truth(np.ones((9, 9), np.float32), bars)
    samples = single_bar_samples(truth.depth_m.astype(np.float64), truth)
    assert {name: values for name, values in samples.items() if len(values)} == {"single_bar_share": [0.0]}
