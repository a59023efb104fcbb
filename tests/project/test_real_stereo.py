"""The example that turns real stereo pairs into captures, on a pair of known disparity."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rebar_depth_bench.captures.views import open_capture
from rebar_depth_bench.geometry.rectification import is_rectified
from tests.bench.methods.predictors import load_predictor

EXAMPLE = Path("examples/real_stereo.py")


@pytest.mark.slow
def test_disparity_becomes_depth_of_the_stated_camera(tmp_path: Path) -> None:
    """SGBM does not know the measured disparity, and finds the same depth with the camera in the file."""
    disparity_px, offset_px = 12, 31.086
    texture = np.random.default_rng(5).integers(0, 256, (25, 60, 3), np.uint8).repeat(4, 0).repeat(4, 1)
    pair = [Image.fromarray(texture[:, start : start + 200]) for start in (0, disparity_px)]
    camera = {"fx": 200.0, "cx": 90.0, "cy": 49.5, "right_cx": 90.0 + offset_px, "baseline_m": 0.2}
    measured_px = np.full((100, 200), float(disparity_px))
    measured_px[:10] = np.nan
    runpy.run_path(str(EXAMPLE))["write"](tmp_path, "pair", *pair, measured_px, camera)
    measured_m = np.load(tmp_path / "pair-measured" / "0001.npy")
    assert measured_m[50, 100] == pytest.approx(200 * 0.2 / (disparity_px + offset_px))
    assert not measured_m[:10].any()
    views = open_capture(tmp_path / "pair")
    [row] = views.rows(*views.columns, "right_cam_from_world")
    assert is_rectified(row)
    depth_m = load_predictor("sgbm")(row)
    assert np.nanmedian(depth_m) == pytest.approx(measured_m[50, 100], rel=5e-3)
