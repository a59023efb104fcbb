"""The left-right check: an answer only where both views give the same one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rebar_depth_bench.methods.stereo.sgbm import AGREEMENT_PX, confirmed
from tests.bench.methods.predictors import loaded


def test_by_hand() -> None:
    left = np.array([[0, 1, 2, 2, 3, 9, 2, -1]], np.float32)
    right = np.array([[2, 5, 2, 0, 2, 7, 0, 0]], np.float32)
    # column 1 looks at 0 (1 against 2), 2 at 0 (2, 2), 3 at 1 (2 against 5), 4 at 1 (3 against 5), 5 leaves the
    # picture, 6 looks at 4 (2, 2); 0 and 7 have no disparity
    assert confirmed(left, right).tolist() == [[False, True, True, False, True, False, True, False]]


@given(st.integers(1, 30), st.integers(0, 2**32 - 1))
def test_a_plane_seen_alike_is_confirmed_wherever_the_right_view_sees_it(disparity: int, seed: int) -> None:
    noise = np.random.default_rng(seed).uniform(-AGREEMENT_PX / 2, AGREEMENT_PX / 2, (2, 4, 64)).astype(np.float32)
    left, right = np.float32(disparity + 1.5) + noise
    found = confirmed(left, right)
    assert found[:, disparity + 3 :].all()
    assert not found[:, : max(disparity - 1, 0)].any()
    assert not confirmed(left, right + np.float32(3 * AGREEMENT_PX)).any()


@pytest.mark.parametrize("where", ["bar", "none"])
def test_what_only_one_eye_sees_has_no_answer(where: str) -> None:
    """A textured bar before a textured wall: behind its edge the wall is hidden from the right eye."""
    rng = np.random.default_rng(1)
    wall, bar = (rng.integers(0, 255, (60, 240, 3), np.uint8) for _ in range(2))
    left, right = wall[:, :200].copy(), wall[:, 8:208].copy()  # the wall at 8 px
    if where == "bar":
        left[:, 100:120], right[:, 70:90] = bar[:, :20], bar[:, :20]  # a bar at 30 px
    K = np.array([[700.0, 0, 99.5], [0, 700.0, 29.5], [0, 0, 1.0]])
    pose = np.eye(4)
    moved = np.eye(4)
    moved[0, 3] = -0.12
    row = {
        "left_rgb": left,
        "right_rgb": right,
        "left_K": K,
        "right_K": K,
        "left_distortion": np.zeros(5),
        "right_distortion": np.zeros(5),
        "left_cam_from_world": pose,
        "right_cam_from_world": moved,
        "baseline_m": 0.12,
    }
    checked, filled = (loaded(name)(row) for name in ("sgbm", "sgbm-filled"))
    truth = np.full((60, 200), 700 * 0.12 / 8)
    if where == "bar":
        truth[:, 100:120] = 700 * 0.12 / 30
    told = np.isfinite(checked[:, 40:])
    off = np.abs(checked[:, 40:] - truth[:, 40:])[told] / truth[:, 40:][told]
    assert np.array_equal(checked[np.isfinite(checked)], filled[np.isfinite(checked)])
    assert np.mean(told) > 0.6
    assert np.mean(off > 0.1) < 0.01
    if where == "bar":
        hidden = np.isfinite(checked[:, 80:97])  # 22 px left of the bar are hidden from the right eye
        assert hidden.mean() < 0.2
        assert np.isfinite(filled).sum() > np.isfinite(checked).sum()
