"""Depth Anything 3 with the original package, where it is installed, and a small random network.

The test runs in a separate process, so that the package and the stand-in of other tests do not conflict.
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("cv2")
pytest.importorskip("torch")

import cv2
import numpy as np

H, W, FX, FY = 90, 160, 87.5, 80.0
SMALL = """
__object__: {path: depth_anything_3.model.da3, name: DepthAnything3Net, args: as_params}
net:
  __object__: {path: depth_anything_3.model.dinov2.dinov2, name: DinoV2, args: as_params}
  name: vits
  out_layers: [2, 5, 8, 11]
  alt_start: -1
  qknorm_start: -1
  rope_start: -1
  cat_token: false
head:
  __object__: {path: depth_anything_3.model.dpt, name: DPT, args: as_params}
  dim_in: 384
  output_dim: 1
  features: 32
  out_channels: [16, 16, 32, 32]
"""
RUN = f"""
import sys
from pathlib import Path
from types import ModuleType
import numpy as np
import torch
# Nothing is exported here, and what its exports import (films, plots, splats) breaks with the versions of others.
sys.modules["depth_anything_3.utils.export"] = ModuleType("export")
sys.modules["depth_anything_3.utils.export"].export = None
from depth_anything_3 import api
from rebar_depth_bench.methods import find_method

place = Path(sys.argv[1])
api.MODEL_REGISTRY["da3metric-large"] = str(place / "small.yaml")
torch.manual_seed(3)
network = api.DepthAnything3("da3metric-large")
network.save_pretrained(place / "weights")
rgb = np.random.default_rng(1).integers(0, 256, ({H}, {W}, 3), np.uint8)
K = np.array([[{FX}, 0, {(W - 1) / 2}], [0, {FY}, {(H - 1) / 2}], [0, 0, 1]])
found = find_method(f"depth-anything-3:{{place / 'weights'}}").load()({{"left_rgb": rgb, "left_K": K}})
torch.manual_seed(1)
np.savez(place / "out.npz", rgb=rgb, found=found, theirs=network.eval().inference([rgb]).depth)
"""


@pytest.mark.skipif(
    importlib.util.find_spec("depth_anything_3") is None, reason="depth-anything-3 is not installed"
)
def test_package_output_becomes_metres_on_left_grid(tmp_path: Path) -> None:
    (tmp_path / "small.yaml").write_text(SMALL)
    command = [sys.executable, "-c", RUN, str(tmp_path)]
    finished = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert finished.returncode == 0, finished.stderr
    out = np.load(tmp_path / "out.npz")
    [network_depth] = out["theirs"]
    assert network_depth.shape == (280, 504)
    assert np.ptp(network_depth) > 0.01 * np.median(network_depth)
    focal_px = (FX * 504 / W + FY * 280 / H) / 2
    expected = cv2.resize(network_depth, (W, H), interpolation=cv2.INTER_LINEAR) * focal_px / 300
    assert out["found"].dtype == np.float32
    np.testing.assert_allclose(out["found"], expected, rtol=1e-3)
