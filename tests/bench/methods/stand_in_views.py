"""Example view for the stand-in networks, and lookup of a stand-in as a method."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rebar_depth_bench.methods import METHODS, find_method
from tests.bench.methods import stand_in_models as stand_ins

H, W = 90, 160
FX, FY, BASELINE_M = 87.5, 80.0, 0.12
BUILDERS: dict[str, Callable[..., Path]] = {
    "depth-anything-3": stand_ins.da3_weights,
    "foundation-stereo": stand_ins.stereo_clone,
    "metric3d": stand_ins.metric3d_clone,
    "unidepth": stand_ins.unidepth_weights,
}


def stereo_row(red: np.ndarray | None = None, fx: float = FX) -> dict[str, Any]:
    """Return a stereo view with the given red channel, the same in both eyes; the other channels are noise."""
    noise = np.random.default_rng(1).integers(0, 256, (H, W, 3), np.uint8)
    noise[..., 0] = 200 if red is None else red
    K = np.array([[fx, 0, (W - 1) / 2], [0, FY, (H - 1) / 2], [0, 0, 1]])
    right_cam_from_world = np.eye(4)
    right_cam_from_world[0, 3] = -BASELINE_M
    eyes = {
        f"{eye}_{name}": value
        for eye in ("left", "right")
        for name, value in (("rgb", noise), ("K", K), ("distortion", np.zeros(5)))
    }
    poses = {
        "left_cam_from_world": np.eye(4),
        "right_cam_from_world": right_cam_from_world,
        "baseline_m": BASELINE_M,
    }
    return {"view_id": "a/0", **eyes, **poses}


def select_columns(name: str, row: dict[str, Any]) -> dict[str, Any]:
    """Return only the columns of a row that the method ``name`` declares."""
    return {column: row[column] for column in METHODS[name].info.columns}


def find_stand_in(name: str, tmp_path: Path, **weights: Any) -> Any:
    """Write the stand-in of ``name`` into ``tmp_path / "theirs"`` and return the method found there."""
    return find_method(f"{name}:{BUILDERS[name](tmp_path / 'theirs', **weights)}")
