"""The full-frame score on arrays: golden cases, and what must never help."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from rebar_depth_bench.errors import InputError
from rebar_depth_bench.studies.pseudo_reference.study import (
    DepthRange,
    FrameScore,
    agreement,
    frame_score,
    has_depth,
    only_on,
    reference_pixels,
    usable,
)

ALLOWED = DepthRange(0.5, 10.0)
SHAPE = (4, 6)
MAPS = arrays.arrays(
    np.float32, SHAPE, elements=st.sampled_from([np.nan, 0.0, -1.0, np.inf, 0.75, 1.0, 3.0, 9.0, 50.0])
)


def scored(reference: np.ndarray, prediction: np.ndarray | None) -> FrameScore:
    truth = reference_pixels("v/0", usable(reference, ALLOWED))
    return frame_score("v/0", SHAPE, truth, None if prediction is None else usable(prediction, ALLOWED))


def test_depths_outside_the_range_are_none_and_its_ends_are_in_it() -> None:
    values = np.array([[np.nan, np.inf, -np.inf, -1, 0, 0.49, 0.5, 10, 10.1]])
    assert has_depth(usable(values, ALLOWED)).tolist() == [[False] * 6 + [True, True, False]]


def test_a_half_float_is_held_against_the_range_itself() -> None:
    just_below = np.full((1, 1), 0.1, np.float16)  # 0.09998
    assert not has_depth(usable(just_below, DepthRange(0.1, 1))).any()


@pytest.mark.parametrize("ends", [(1, 1), (2, 1), (-1, 1), (math.nan, 1), (0, math.nan), (math.inf, math.inf)])
def test_a_range_that_is_none_is_refused(ends: tuple[float, float]) -> None:
    with pytest.raises(InputError, match="expected 0 <= near < far"):
        DepthRange(*ends)


def test_a_golden_view() -> None:
    reference, prediction = (np.full(SHAPE, np.nan, np.float32) for _ in range(2))
    reference.ravel()[:8] = [1, 2, 4, 8, 0.2, 99, 2, 2]  # six in range
    prediction.ravel()[:8] = [2, 2, 2, 4, 1, 1, 0.1, np.nan]  # four of them in range
    found = scored(reference, prediction)
    assert found.score is not None
    assert found.score.native is not None
    assert found.reference_px == 6
    assert found.score.coverage == 4 / 6
    assert found.frame_share == pytest.approx(4 / 24)
    assert found.score.native.abs_rel == pytest.approx((1 + 0 + 0.5 + 0.5) / 4)
    assert found.score.native.rmse_cm == pytest.approx(100 * math.sqrt((1 + 0 + 4 + 16) / 4))
    assert found.score.native.mae_cm == pytest.approx(100 * (1 + 0 + 2 + 4) / 4)
    assert found.score.native.delta1 == 1 / 4
    assert found.score.scale == 3 / 2  # medians of 1 2 4 8 and of 2 2 2 4


def test_a_missing_map_covers_nothing() -> None:
    found = scored(np.ones(SHAPE), None)
    assert found.score is not None
    assert (found.score.native, found.score.coverage, found.frame_share) == (None, 0, 0)


def test_a_reference_without_depth_gives_no_score() -> None:
    found = scored(np.zeros(SHAPE), np.ones(SHAPE))
    assert (found.score, found.reference_px, found.frame_share) == (None, 0, 0)


def test_agreement_is_on_common_pixels_and_has_a_side() -> None:
    a_m, b_m = np.array([[1.0, 2.0, np.nan, 3.0]]), np.array([[2.0, 2.0, 5.0, np.nan]])
    one, other = agreement(a_m, b_m), agreement(b_m, a_m)
    assert (one.common_share, one.abs_rel, one.median_ratio) == (0.5, 0.25, 0.75)
    assert (other.common_share, other.abs_rel, other.median_ratio) == (0.5, 0.5, 1.5)
    nothing = agreement(a_m, np.full_like(a_m, np.nan))
    assert (nothing.common_share, nothing.abs_rel, nothing.median_ratio) == (0, None, None)


@given(MAPS, MAPS, arrays.arrays(bool, SHAPE))
def test_taking_depth_away_never_raises_coverage(
    reference: np.ndarray, prediction: np.ndarray, kept: np.ndarray
) -> None:
    whole = scored(reference, prediction)
    part = scored(reference, np.where(kept, prediction, np.nan))
    assert part.frame_share <= whole.frame_share <= 1
    assert part.reference_px == whole.reference_px
    if whole.score is not None:
        assert part.score is not None
        assert part.score.coverage <= whole.score.coverage <= 1


@given(MAPS, MAPS)
def test_counts_are_those_of_plain_python(reference: np.ndarray, prediction: np.ndarray) -> None:
    pairs = list(zip(reference.ravel().tolist(), prediction.ravel().tolist(), strict=True))
    inside = [(z, p) for z, p in pairs if 0.5 <= z <= 10]
    both = [(z, p) for z, p in inside if 0.5 <= p <= 10]
    found = scored(reference, prediction)
    assert found.reference_px == len(inside)
    assert found.frame_share == pytest.approx(len(both) / 24)
    if both:
        assert found.score is not None
        assert found.score.native is not None
        expected = sum(abs(p - z) / z for z, p in both) / len(both)
        assert found.score.native.abs_rel == pytest.approx(expected, rel=1e-6)


@given(MAPS, arrays.arrays(bool, SHAPE))
def test_a_map_cut_to_pixels_has_depth_where_both_have(depth: np.ndarray, pixels: np.ndarray) -> None:
    cut = only_on(usable(depth, ALLOWED), pixels)
    assert np.array_equal(has_depth(cut), pixels & has_depth(usable(depth, ALLOWED)))
