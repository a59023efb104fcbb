"""Example captures: blank stereo pairs with a ZED calibration and depth maps of its views, and random images."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from tests.bench.geometry.calibrations import SHIPPED_CALIBRATION

WIDTH, HEIGHT = 64, 36
VIEWS = 24
Depth = NDArray[Any]


def write_capture(root: Path, views: int = VIEWS, size: tuple[int, int] = (WIDTH, HEIGHT)) -> Path:
    """Write a capture of blank images and return its folder."""
    for eye in ("left", "right"):
        (root / eye).mkdir(parents=True)
        for view in range(views):
            Image.new("L", size).save(root / eye / f"{view:06d}.png")
    (root / "calibration.conf").write_bytes(SHIPPED_CALIBRATION.read_bytes())
    return root


def write_images(root: Path, *folders: str, size: tuple[int, int] = (640, 480)) -> None:
    """Write two images, each of one random colour, into each folder."""
    rng = np.random.default_rng(3)
    for folder in folders:
        (root / folder).mkdir(parents=True, exist_ok=True)
        for name in ("0001", "0002"):
            colour = tuple(rng.integers(0, 255, 3).tolist())
            Image.new("RGB", size, colour).save(root / folder / f"{name}.png")


def exact_depth(view: int) -> Depth:
    """Return a depth map in metres: a slope with a box in front of it, different for each view."""
    rng = np.random.default_rng(view)
    depth_m = np.linspace(0.8, 3.0, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) * rng.uniform(0.7, 1.3)
    depth_m[8:20, 10:40] = rng.uniform(0.4, 0.7)
    return depth_m.astype(np.float32)


def write_depths(folder: Path, depths: dict[int, Depth], method: str | None = None) -> Path:
    """Write depth maps by view as a folder of .npy files and return the folder."""
    folder.mkdir()
    for view, depth_m in depths.items():
        np.save(folder / f"{view:06d}.npy", depth_m.astype(np.float32))
    if method is not None:
        (folder / "submission.json").write_text(f'{{"method": "{method}"}}')
    return folder
