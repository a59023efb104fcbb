"""Rank error: its definition, and that no omission of predictions ever lowers it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy import ndarray

from rebar_depth_bench import score
from rebar_depth_bench.scoring.columns import rounded
from rebar_depth_bench.scoring.metrics import is_valid_prediction, rank_error
from rebar_depth_bench.scoring.score import ViewTruth, score_view, tabulate
from rebar_depth_bench.scoring.table import ViewScore

INVALID = (np.nan, 0.0, -0.0, -1.0, np.inf, -np.inf)


def scored(p_m: ndarray, z_m: ndarray) -> ViewScore:
    truth = ViewTruth("lattice/0000", np.arange(len(z_m), dtype=np.uint32), z_m, float(np.median(z_m)))
    return score_view(truth, p_m.reshape(1, -1))


def ranked_value(*views: ViewScore) -> float:
    """Return the number that ranks: the mean over views, rounded as in the JSON."""
    value = rounded(tabulate(views).rank_error)
    assert value is not None
    return value


def noisy_view(seed: int, pixels: int = 300) -> tuple[ndarray, ndarray]:
    rng = np.random.default_rng(seed)
    z_m = rng.uniform(0.2, 17.0, pixels).astype(np.float32)
    p_m = (z_m * rng.lognormal(0, rng.choice([0.001, 0.1, 2.0]), pixels)).astype(np.float32)
    p_m[rng.uniform(size=pixels) < 0.2] = rng.choice(INVALID)
    return p_m, z_m


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_equals_the_sum_in_pixel_order(dtype: type) -> None:
    p_m, z_m = noisy_view(1, 20_000)
    p_m = p_m.astype(dtype)
    total = 0.0
    for p, z in zip(p_m.astype(float).tolist(), z_m.astype(float).tolist(), strict=True):
        total += abs(p - z) / max(p, z) if 0 < p < float("inf") else 1.0
    assert rank_error(p_m, z_m, is_valid_prediction(p_m)) == total / len(z_m)


@pytest.mark.parametrize(
    ("p", "expected"),
    [(1.0, 0.0), (2.0, 0.5), (0.5, 0.5), (1e308, 1.0), (5e-324, 1.0), *((value, 1.0) for value in INVALID)],
)
def test_known_values(p: float, expected: float) -> None:
    assert scored(np.array([p]), np.ones(1, np.float32)).rank_error == expected


@given(st.integers(0, 2**32 - 1), st.floats(0, 1), st.sampled_from(INVALID))
def test_no_removal_lowers_it(seed: int, share: float, invalid: float) -> None:
    p_m, z_m = noisy_view(seed)
    removed = p_m.copy()
    removed[np.random.default_rng(seed + 1).uniform(size=len(p_m)) < share] = invalid
    worst = p_m.copy()
    worst[np.argsort(-np.abs(p_m - z_m))[: int(share * len(p_m))]] = invalid
    other = scored(*noisy_view(seed + 2))
    assert ranked_value(scored(p_m, z_m), other) <= ranked_value(scored(removed, z_m), other)
    assert ranked_value(scored(p_m, z_m), other) <= ranked_value(scored(worst, z_m), other)


@given(st.integers(0, 2**32 - 1), st.floats(5e-324, 1e308))
def test_filling_holes_never_raises_it(seed: int, fill: float) -> None:
    p_m, z_m = noisy_view(seed)
    filled = np.where(is_valid_prediction(p_m), p_m.astype(np.float64), fill)
    value = ranked_value(scored(filled, z_m))
    assert 0 <= value <= ranked_value(scored(p_m, z_m))


def test_omitting_the_worst_pixels_lowers_abs_rel_but_not_the_rank_error(
    tiny_truth: dict[str, ndarray], tiny_root: Path, archive_of: Callable[..., Path]
) -> None:
    """Omit the worst 4.5 % of the pixels: AbsRel on valid pixels falls to a fifth."""
    rng = np.random.default_rng(0)
    whole, partial = {}, {}
    for view_id, depth_m in tiny_truth.items():
        is_far = rng.uniform(size=depth_m.shape) < 0.045
        whole[view_id] = np.where(is_far, 3 * depth_m, 1.01 * depth_m).astype(np.float32)
        partial[view_id] = np.where(is_far, np.nan, whole[view_id]).astype(np.float32)
    complete, omitted = (
        score(archive_of(depths, f"{name}.zip"), tiny_root).tables["lattice"]
        for name, depths in (("whole", whole), ("partial", partial))
    )
    assert complete.native is not None
    assert omitted.native is not None
    assert omitted.is_comparable
    assert omitted.native.abs_rel < complete.native.abs_rel / 5
    assert complete.rank_error is not None
    assert omitted.rank_error is not None
    assert omitted.rank_error > complete.rank_error
