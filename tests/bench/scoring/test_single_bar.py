"""Single-bar interior: its pixels, share and errors, against loops over pixels."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import ndarray

from rebar_depth_bench.extended.profiles import DISTANCE_EDGES_M, MIN_PIXELS, profile_samples
from rebar_depth_bench.extended.regions import REGION_NUMBERS, region_samples
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
    assert all(0 <= share <= 1 for share in region_samples(truth.depth_m, truth)["single_bar_share"])


@settings(max_examples=30)
@given(SEEDS)
def test_measures_equal_numpy_on_the_chosen_pixels(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = random_truth(rng)
    p_m = random_prediction(rng, truth)
    chosen = truth.single_bar
    assert not (chosen & ~truth.interior).any()
    samples = {name: values.tolist() for name, values in region_samples(p_m, truth).items()}
    count = np.count_nonzero(truth.interior)
    assert samples["single_bar_share"] == ([np.count_nonzero(chosen) / count] if count else [])
    with np.errstate(invalid="ignore"):
        valid = chosen & np.isfinite(p_m) & (p_m > 0)
    if not chosen.any():
        assert not any(f"single_bar_{name}" in samples for name in REGION_NUMBERS)
        return
    assert samples["single_bar_coverage"] == [np.count_nonzero(valid) / np.count_nonzero(chosen)]
    z, p = truth.depth_m[valid].astype(np.float64), p_m[valid]
    if valid.any():
        assert samples["single_bar_abs_rel"] == pytest.approx([np.mean(np.abs(p - z) / z)], rel=1e-12)
        assert samples["single_bar_rmse_cm"] == pytest.approx([100 * math.sqrt(np.mean((p - z) ** 2))], rel=1e-12)
        assert samples["single_bar_delta1"] == [np.mean(np.maximum(p / z, z / p) < 1.25)]


def test_steel_without_a_bar_id_is_scored_but_in_no_region() -> None:
    """Imported masks may have steel without a bar id: it counts in the interior that single bars stand beside."""
    depth_m, bars = np.full((9, 14), 0.5, np.float32), np.ones((9, 14), np.uint16)
    truth = steel_truth(depth_m, bars)
    no_id = truth.index % 14 >= 7
    truth = replace(truth, bar_id=np.where(no_id, 0, truth.bar_id), single_bar=truth.single_bar & ~no_id)
    samples = region_samples(np.where(no_id, 1.0, 0.5), truth)
    assert samples["interior_abs_rel"] == samples["single_bar_abs_rel"] == [0.0]
    assert samples["single_bar_views_abs_rel"] == samples["single_bar_share"] == [0.5]
    assert samples["full_mask_coverage"] == [1.0]


def test_profile_bins_equal_numpy() -> None:
    rng = np.random.default_rng(3)
    z_m = np.repeat(np.linspace(0.21, 0.95, 60), 60).reshape(60, 60).astype(np.float32)
    bars = np.broadcast_to(1 + np.arange(60) // 4, (60, 60)).astype(np.uint16)
    truth = steel_truth(z_m, bars)
    p_m = truth.depth_m * rng.uniform(0.9, 1.1, len(truth.index))
    p_m[rng.random(len(p_m)) < 0.2] = math.nan
    samples = profile_samples(p_m, truth)
    filled = 0
    for low, high in pairwise(DISTANCE_EDGES_M):
        inside = truth.interior & (truth.depth_m >= low) & (truth.depth_m < high)
        chosen = inside & truth.single_bar & np.isfinite(p_m)
        share, error = (samples[f"single_bar_{name}_at_{low:g}-{high:g}m"] for name in ("share", "abs_rel"))
        assert len(share) == (np.count_nonzero(inside) >= MIN_PIXELS)
        assert len(error) == (np.count_nonzero(chosen) >= MIN_PIXELS)
        if len(error):
            filled += 1
            z = truth.depth_m[chosen].astype(np.float64)
            assert share[0] == pytest.approx(np.mean(truth.single_bar[inside]), rel=1e-12)
            assert error[0] == pytest.approx(np.mean(np.abs(p_m[chosen] - z) / z), rel=1e-12)
    assert filled == 6


def test_share_and_error_use_the_same_bins() -> None:
    """A depth at the edge of two bins, which float32 rounds down, is in one bin for both numbers."""
    z_m = np.full((20, 20), np.float32(0.7))
    truth = steel_truth(z_m, np.ones(z_m.shape, np.uint16))
    samples = profile_samples(truth.depth_m.astype(np.float64), truth)
    filled = {name.rpartition("_")[2] for name, values in samples.items() if len(values) and name.endswith("m")}
    assert filled == {"0.5-0.7m"}


def test_view_without_single_bar_pixels_has_no_errors() -> None:
    bars = np.indices((9, 9)).sum(axis=0).astype(np.uint16) % 2 + 1
    truth = steel_truth(np.ones((9, 9), np.float32), bars)
    samples = region_samples(truth.depth_m.astype(np.float64), truth)
    single_bar = {name: values for name, values in samples.items() if name.startswith("single_bar")}
    assert single_bar == {"single_bar_share": [0.0]}
