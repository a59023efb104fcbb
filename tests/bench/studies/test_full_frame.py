"""Full-frame score on arrays: known cases, and coverage that never rises when depth is removed."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from rebar_depth_bench.studies.pseudo_reference.study import (
    DepthRange,
    FrameScore,
    compare_references,
    has_depth,
    mask_invalid_depth,
    reference_as_truth,
    restrict_to_pixels,
    score_frame,
)

from rebar_depth_bench.errors import InputError

ALLOWED = DepthRange(0.5, 10.0)
SHAPE = (4, 6)
MAPS = arrays.arrays(
    np.float32, SHAPE, elements=st.sampled_from([np.nan, 0.0, -1.0, np.inf, 0.75, 1.0, 3.0, 9.0, 50.0])
)


def score_maps(reference: np.ndarray, prediction: np.ndarray) -> FrameScore:
    truth = reference_as_truth("v/0", mask_invalid_depth(reference, ALLOWED))
    return score_frame(truth, mask_invalid_depth(prediction, ALLOWED))


def test_depth_range_includes_its_ends() -> None:
    values = np.array([[np.nan, np.inf, -np.inf, -1, 0, 0.49, 0.5, 10, 10.1]])
    assert has_depth(mask_invalid_depth(values, ALLOWED)).tolist() == [[False] * 6 + [True, True, False]]


def test_float16_depth_is_compared_with_exact_range() -> None:
    just_below = np.full((1, 1), 0.1, np.float16)  # 0.09998
    assert not has_depth(mask_invalid_depth(just_below, DepthRange(0.1, 1))).any()


@pytest.mark.parametrize("ends", [(1, 1), (2, 1), (-1, 1), (math.nan, 1), (0, math.nan), (math.inf, math.inf)])
def test_invalid_range_raises(ends: tuple[float, float]) -> None:
    with pytest.raises(InputError, match="expected 0 <= near < far"):
        DepthRange(*ends)


def test_score_of_known_view() -> None:
    reference, prediction = (np.full(SHAPE, np.nan, np.float32) for _ in range(2))
    reference.ravel()[:8] = [1, 2, 4, 8, 0.2, 99, 2, 2]  # Six are in range.
    prediction.ravel()[:8] = [2, 2, 2, 4, 1, 1, 0.1, np.nan]  # Four of those are in range.
    frame = score_maps(reference, prediction)
    assert frame.score is not None
    assert frame.score.native is not None
    assert frame.reference_px == 6
    assert frame.score.coverage == 4 / 6
    assert frame.frame_share == pytest.approx(4 / 24)
    assert frame.score.native.abs_rel == pytest.approx((1 + 0 + 0.5 + 0.5) / 4)
    assert frame.score.native.rmse_cm == pytest.approx(100 * math.sqrt((1 + 0 + 4 + 16) / 4))
    assert frame.score.native.mae_cm == pytest.approx(100 * (1 + 0 + 2 + 4) / 4)
    assert frame.score.native.delta1 == 1 / 4
    assert frame.score.scale == 3 / 2  # Medians of (1, 2, 4, 8) and of (2, 2, 2, 4).


def test_missing_prediction_has_zero_coverage() -> None:
    frame = score_maps(np.ones(SHAPE), np.full(SHAPE, np.nan))
    assert frame.score is not None
    assert (frame.score.native, frame.score.coverage, frame.frame_share) == (None, 0, 0)


def test_empty_reference_gives_no_score() -> None:
    frame = score_maps(np.zeros(SHAPE), np.ones(SHAPE))
    assert (frame.score, frame.reference_px, frame.frame_share) == (None, 0, 0)


def test_agreement_uses_common_pixels_and_is_asymmetric() -> None:
    a_m, b_m = np.array([[1.0, 2.0, np.nan, 3.0]]), np.array([[2.0, 2.0, 5.0, np.nan]])
    forward, backward = compare_references(a_m, b_m), compare_references(b_m, a_m)
    assert (forward.common_share, forward.abs_rel, forward.median_ratio) == (0.5, 0.25, 0.75)
    assert (backward.common_share, backward.abs_rel, backward.median_ratio) == (0.5, 0.5, 1.5)
    nothing = compare_references(a_m, np.full_like(a_m, np.nan))
    assert (nothing.common_share, nothing.abs_rel, nothing.median_ratio) == (0, None, None)


@given(MAPS, MAPS, arrays.arrays(bool, SHAPE))
def test_removing_depth_never_raises_coverage(
    reference: np.ndarray, prediction: np.ndarray, retained: np.ndarray
) -> None:
    whole = score_maps(reference, prediction)
    part = score_maps(reference, np.where(retained, prediction, np.nan))
    assert part.frame_share <= whole.frame_share <= 1
    assert part.reference_px == whole.reference_px
    if whole.score is not None:
        assert part.score is not None
        assert part.score.coverage <= whole.score.coverage <= 1


@given(MAPS, MAPS)
def test_counts_match_plain_python(reference: np.ndarray, prediction: np.ndarray) -> None:
    pairs = list(zip(reference.ravel().tolist(), prediction.ravel().tolist(), strict=True))
    inside = [(z, p) for z, p in pairs if 0.5 <= z <= 10]
    both = [(z, p) for z, p in inside if 0.5 <= p <= 10]
    frame = score_maps(reference, prediction)
    assert frame.reference_px == len(inside)
    assert frame.frame_share == pytest.approx(len(both) / 24)
    if both:
        assert frame.score is not None
        assert frame.score.native is not None
        expected = sum(abs(p - z) / z for z, p in both) / len(both)
        assert frame.score.native.abs_rel == pytest.approx(expected, rel=1e-6)


@given(MAPS, arrays.arrays(bool, SHAPE))
def test_restricted_map_has_depth_where_both_have(depth: np.ndarray, pixels: np.ndarray) -> None:
    cut = restrict_to_pixels(mask_invalid_depth(depth, ALLOWED), pixels)
    assert np.array_equal(has_depth(cut), pixels & has_depth(mask_invalid_depth(depth, ALLOWED)))
