"""KITTI metrics: crops, scored pixels and the scores of one image, on hand-computed cases."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rebar_depth_bench.studies.kitti.metrics import CROPS, KittiMetrics, crop_mask, score_image, scored_mask

NO_CROP = CROPS["none"]


@pytest.mark.parametrize(
    ("crop", "shape", "rows", "columns"),
    [
        # 375 times 0.40810811 = 153.04, times 0.99189189 = 371.96;
        # 1242 times 0.03594771 = 44.65, times 0.96405229 = 1197.35
        ("garg", (375, 1242), (153, 371), (44, 1197)),
        # 0.3324324 * 375 = 124.66, 0.91351351 * 375 = 342.57
        ("eigen", (375, 1242), (124, 342), (44, 1197)),
        # 376 times 0.40810811 = 153.45, times 0.99189189 = 372.95;
        # 1241 times 0.03594771 = 44.61, times 0.96405229 = 1196.39
        ("garg", (376, 1241), (153, 372), (44, 1196)),
        ("none", (3, 5), (0, 3), (0, 5)),
    ],
)
def test_crop_mask_of_known_image_sizes(
    crop: str, shape: tuple[int, int], rows: tuple[int, int], columns: tuple[int, int]
) -> None:
    mask = crop_mask(shape, CROPS[crop])
    mask_rows, mask_columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    assert (mask_rows[0], mask_rows[-1] + 1) == rows
    assert (mask_columns[0], mask_columns[-1] + 1) == columns
    assert mask.sum() == (rows[1] - rows[0]) * (columns[1] - columns[0])


def test_scored_mask_excludes_both_depth_limits() -> None:
    depth_m = np.array([[0, 0.001, 0.002, 79.9, 80, 81]], np.float32)
    assert scored_mask(depth_m, NO_CROP, 80.0).tolist() == [[False, False, True, True, False, False]]


def test_score_of_known_image() -> None:
    z_m = np.array([[2.0, 4.0, 0.0, 10.0]], np.float32)
    p_m = np.array([[1.0, 4.0, 9.0, 14.0]], np.float32)
    score = score_image("image", z_m, p_m, NO_CROP, 80.0)
    assert score is not None
    assert score.native is not None
    assert score.scored_px == 3
    assert score.native.abs_rel == pytest.approx((1 / 2 + 0 + 4 / 10) / 3)
    assert score.native.rmse_m == pytest.approx(math.sqrt((1 + 0 + 16) / 3))
    assert score.native.log_rmse == pytest.approx(math.sqrt((math.log(2) ** 2 + math.log(1.4) ** 2) / 3))
    # Ratios 2, 1 and 1.4 against the thresholds 1.25, 1.5625 and 1.953125.
    assert (score.native.delta1, score.native.delta2, score.native.delta3) == pytest.approx((1 / 3, 2 / 3, 2 / 3))
    assert score.scale == 4.0 / 4.0


def test_predictions_are_clamped_after_alignment() -> None:
    z_m = np.array([[10.0, 20.0, 79.0]], np.float32)
    p_m = np.array([[50.0, 100.0, 500.0]], np.float32)
    score = score_image("image", z_m, p_m, NO_CROP, 80.0)
    assert score is not None
    assert score.native is not None
    assert score.scaled is not None
    assert score.scale == 0.2  # 20 / 100, from the unclamped prediction.
    assert score.native.rmse_m == pytest.approx(math.sqrt((40**2 + 60**2 + 1**2) / 3))
    assert score.scaled.rmse_m == pytest.approx(
        math.sqrt(1 / 3)
    )  # The scaled values are 10, 20 and 100, the last clamped to 80.


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 0.0, -5.0])
def test_invalid_predictions_are_not_clamped(bad: float) -> None:
    z_m = np.array([[0.002, 20.0, 79.0]], np.float32)
    p_m = np.array([[bad, 20.0, bad]], np.float32)
    score = score_image("image", z_m, p_m, NO_CROP, 80.0)
    assert score is not None
    assert score.coverage == pytest.approx(1 / 3)
    assert score.native == KittiMetrics(0, 0, 0, 1, 1, 1)
    all_invalid = score_image("image", z_m, np.full_like(z_m, bad), NO_CROP, 80.0)
    assert all_invalid is not None
    assert (all_invalid.native, all_invalid.scale, all_invalid.coverage) == (None, None, 0)


def test_image_without_scored_pixels_has_no_score() -> None:
    assert score_image("image", np.zeros((2, 3), np.float32), np.ones((2, 3)), NO_CROP, 80.0) is None


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
@pytest.mark.parametrize("value", [1e-300, 6e4, 1e300])
def test_extreme_predictions_give_finite_metrics(value: float, dtype: type) -> None:
    with np.errstate(over="ignore", under="ignore"):
        p_m: np.ndarray = np.full((1, 4), value).astype(dtype)
    score = score_image("image", np.full((1, 4), 5.0, np.float32), p_m, NO_CROP, 80.0)
    assert score is not None
    for metrics in (score.native, score.scaled):
        assert metrics is None or all(math.isfinite(number) for number in vars(metrics).values())


@given(
    st.lists(st.tuples(st.floats(1, 70), st.floats(1, 70)), min_size=1, max_size=20), st.sampled_from([0.5, 2, 4])
)
def test_scaled_metrics_are_scale_invariant(pairs: list[tuple[float, float]], factor: float) -> None:
    z_m, p_m = (np.array([values], np.float64) for values in zip(*pairs, strict=True))
    first, other = (score_image("image", z_m, scale * p_m, NO_CROP, 80.0) for scale in (1.0, factor))
    assert first is not None
    assert other is not None
    assert first.scaled == other.scaled  # Powers of two cause no rounding.
    assert first.scale is not None
    assert other.scale == first.scale / factor
    assert first.native is not None
    assert 0 <= first.native.delta1 <= first.native.delta2 <= first.native.delta3 <= 1
