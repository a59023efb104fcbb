"""Lines in docs/captures.md that rectify images: a ray is where the pinhole camera that they leave has it."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

pytest.importorskip("cv2")

import cv2
import numpy as np

from tests.project.pages import DOCS, blocks

K = np.array([[240.0, 0, 322.5], [0, 240.0, 198.25], [0, 0, 1]])
RATIONAL = (4.9342, 1.8712, 0.0, 0.0, 0.06134, 5.0742, 2.0070, 0.2)
"""k1 k2 p1 p2 k3 k4 k5 k6 of a ZED X."""
FISHEYE = (-0.0386674, 0.0304795, -0.0237575, 0.0167972)
RAY = (0.6, -0.35)
"""x / z and y / z."""


def rational_scale(r: float) -> float:
    """Return distorted by ideal radius (OpenCV, calib3d: detailed description)."""
    k1, k2, _, _, k3, k4, k5, k6 = RATIONAL
    return (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)


def fisheye_scale(r: float) -> float:
    """Return distorted by ideal radius (OpenCV, fisheye: theta_d / r)."""
    angle = math.atan(r)
    return angle * (1 + sum(k * angle ** (2 * n) for n, k in enumerate(FISHEYE, start=1))) / r


@pytest.mark.parametrize("model", ["rational", "fisheye"])
def test_documented_lines_rectify_images(model: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    x, y = RAY
    scale = (rational_scale if model == "rational" else fisheye_scale)(math.hypot(x, y))
    u, v = 240.0 * x * scale + 322.5, 240.0 * y * scale + 198.25
    rows, columns = np.mgrid[:400, :640]
    spot = 255 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / (2 * 3.0**2))
    for folder in ("raw", "left"):
        (tmp_path / folder).mkdir()
    cv2.imwrite("raw/a.png", spot.round().astype(np.uint8))
    lines, fisheye_line, _ = blocks(DOCS / "captures.md", "py")
    if model == "fisheye":
        [line] = [line for line in lines.splitlines() if line.startswith("maps = ")]
        lines = lines.replace(line, fisheye_line.strip())
    terms = np.array(RATIONAL if model == "rational" else FISHEYE)
    exec(lines, {"cv2": cv2, "np": np, "Path": Path, "K": K, "D": terms, "size": (640, 400)})
    rectified = cv2.imread("left/a.png", cv2.IMREAD_GRAYSCALE).astype(float)
    centre = (rectified * columns).sum() / rectified.sum(), (rectified * rows).sum() / rectified.sum()
    assert centre == pytest.approx((240.0 * x + 322.5, 240.0 * y + 198.25), abs=0.5)
    assert math.hypot(u - (240.0 * x + 322.5), v - (240.0 * y + 198.25)) > 4
