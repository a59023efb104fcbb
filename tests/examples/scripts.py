"""Runs of the paper's scripts in this process, and a small KITTI folder: calibrations, scans and depth maps."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image as Picture

from outputs import run_script

EIGEN_SPLIT = Path("examples/paper/kitti_eigen_test_697.txt")
WIDTH, HEIGHT = 124, 38
FX, CX, CY = 72.15377, 60.95593, 17.2854
PX, PY, PZ = 4.485728, 0.02163791, 0.002745884
R_RECT = (
    (0.9999239, 0.00983776, -0.007445048),
    (-0.009869795, 0.9999421, -0.004278459),
    (0.007402527, 0.004351614, 0.9999631),
)
R_VELO = (
    (0.007533745, -0.9999714, -0.000616602),
    (0.01480249, 0.0007280733, -0.9998902),
    (0.9998621, 0.00752379, 0.01480755),
)
T_VELO = (-0.004069766, -0.07631618, -0.2717806)

CAM_TO_CAM = f"""\
calib_time: 09-Jan-2012 13:57:47
corner_dist: 9.950000e-02
S_00: 1.392000e+03 5.120000e+02
R_rect_00: {" ".join(f"{value:.6e}" for row in R_RECT for value in row)}
S_rect_02: {WIDTH:.6e} {HEIGHT:.6e}
P_rect_02: {FX:.6e} 0.000000e+00 {CX:.6e} {PX:.6e} 0.000000e+00 {FX:.6e} {CY:.6e} {PY:.6e} 0 0 1 {PZ:.6e}
S_rect_03: {WIDTH:.6e} {HEIGHT:.6e}
P_rect_03: {FX:.6e} 0.000000e+00 {CX:.6e} -3.395242e+01 0 {FX:.6e} {CY:.6e} 2.199936e-01 0 0 1 2.729905e-03
"""
VELO_TO_CAM = f"""\
calib_time: 15-Mar-2012 11:37:16
R: {" ".join(f"{value:.6e}" for row in R_VELO for value in row)}
T: {" ".join(f"{value:.6e}" for value in T_VELO)}
delta_f: 0.000000e+00 0.000000e+00
"""

Scan = NDArray[np.float32]


@dataclass(frozen=True)
class Image:
    """Image of the Eigen test split."""

    date: str
    drive: str
    frame: str
    side: str

    @property
    def name(self) -> str:
        """Name of the prediction."""
        return f"{self.drive}_{self.frame}_{self.side}"


def first_images(count: int) -> tuple[Image, ...]:
    """Return the first ``count`` images of the Eigen test split, by drive and frame."""
    lines = EIGEN_SPLIT.read_text().splitlines()
    return tuple(Image(*line.replace("/", " ").split()) for line in sorted(lines)[:count])


def random_scan(seed: int, count: int = 4000) -> Scan:
    """Return a scan, ``count`` x 4 float32, of random points around the scanner, a few of them behind it."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-5, 90, count)
    spread = np.abs(x) + 1
    points: Scan = np.stack(
        [x, rng.uniform(-1, 1, count) * spread, rng.uniform(-0.5, 0.3, count) * spread, rng.uniform(0, 1, count)]
    )
    return np.asarray(points.T, "<f4")


def write_day(day: Path, cam_to_cam: str = CAM_TO_CAM, velo_to_cam: str = VELO_TO_CAM) -> None:
    """Write the two calibration files of a day."""
    day.mkdir(parents=True, exist_ok=True)
    (day / "calib_cam_to_cam.txt").write_text(cam_to_cam)
    (day / "calib_velo_to_cam.txt").write_text(velo_to_cam)


def scan_path(root: Path, image: Image) -> Path:
    """Return the path of an image's scan."""
    return root / image.date / image.drive / "velodyne_points" / "data" / f"{image.frame}.bin"


def write_raw(root: Path, images: tuple[Image, ...]) -> None:
    """Write the raw data of images, each with its own scan."""
    for seed, image in enumerate(images):
        write_day(root / image.date)
        path = scan_path(root, image)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(random_scan(seed).tobytes())


def write_picture(root: Path, image: Image, camera: int) -> Path:
    """Write a random picture of a colour camera and return its path."""
    path = root / image.date / image.drive / f"image_{camera:02d}" / "data" / f"{image.frame}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    Picture.fromarray(np.random.default_rng(camera).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)).save(path)
    return path


def improved_path(root: Path, image: Image, part: str = "val") -> Path:
    """Return the path of an image's improved depth map."""
    return root / part / image.drive / "proj_depth" / "groundtruth" / "image_02" / f"{image.frame}.png"


def write_improved(path: Path, depth_m: NDArray[Any]) -> None:
    """Write a depth map in KITTI's format: 16-bit PNG of metres times 256."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Picture.fromarray(np.round(depth_m * 256).astype(np.uint16)).save(path)


def project_reference(scan: Scan) -> dict[tuple[int, int], tuple[float, float]]:
    """Return the nearest point per pixel (row, column) as (planar depth, scanner x) in metres; plain Python."""
    nearest: dict[tuple[int, int], tuple[float, float]] = {}
    for x, y, z, _ in scan.tolist():
        if x < 0:
            continue
        cam = [
            sum(r * p for r, p in zip(row, (x, y, z), strict=True)) + t
            for row, t in zip(R_VELO, T_VELO, strict=True)
        ]
        rect = [sum(r * c for r, c in zip(row, cam, strict=True)) for row in R_RECT]
        depth = rect[2] + PZ
        if depth <= 0:
            continue
        u, v = (FX * rect[0] + CX * rect[2] + PX) / depth, (FX * rect[1] + CY * rect[2] + PY) / depth
        pixel = (round(v) - 1, round(u) - 1)
        if 0 <= pixel[0] < HEIGHT and 0 <= pixel[1] < WIDTH and depth < nearest.get(pixel, (1e9, 0))[0]:
            nearest[pixel] = (depth, x)
    return nearest


def run(script: ModuleType, *arguments: str | Path) -> int:
    """Run a script with its arguments and return its exit status."""
    return run_script(script.argument_parser(), script.run, [str(argument) for argument in arguments])


def result_of(script: ModuleType, folder: Path, *arguments: str | Path) -> dict[str, Any]:
    """Run a script, which must succeed, and return its JSON."""
    assert run(script, *arguments, "--json", folder / "result.json") == 0
    content: dict[str, Any] = json.loads((folder / "result.json").read_text())
    return content


def repeated_files(
    script: ModuleType, folder: Path, *arguments: str | Path, again: tuple[str, ...] = ()
) -> dict[str, bytes]:
    """Run a script twice, the second time with the options ``again``; return the files, which must be equal."""
    files = written_files(script, folder, *arguments)
    assert files == written_files(script, folder, *arguments, *again)
    return files


def refusal(script: ModuleType, printed: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """Run a script that must refuse its input without output, and return its message."""
    printed.readouterr()
    assert run(script, *arguments) == 2
    captured = printed.readouterr()
    assert captured.out == ""
    return captured.err


def written_files(script: ModuleType, folder: Path, *arguments: str | Path) -> dict[str, bytes]:
    """Run a script, which must succeed, with all outputs, and return their contents by suffix."""
    files = {suffix: folder / f"out.{suffix}" for suffix in ("json", "csv", "png")}
    options = zip(("--json", "--csv", "--figure"), files.values(), strict=True)
    assert run(script, *arguments, *(word for option in options for word in option)) == 0
    return {suffix: file.read_bytes() for suffix, file in files.items()}
