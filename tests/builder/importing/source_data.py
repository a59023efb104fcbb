"""Data as other programs write them, made from the sample dataset, and the layout file that describes them."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
from PIL import Image

from rebar_depth_bench import load
from rebar_depth_bench.data.bars import read_bars
from rebar_depth_bench.geometry.cameras import inverse_rigid, pixel_rays

Row = dict[str, Any]
NAMES = ("scan-a", "scan-b", "scan-c")
CAMERAS = """
[cameras]
width = 160
height = 90
[cameras.left]
fx = 87.5
fy = 87.5
cx = 79.5
cy = 44.5
distortion = [0, 0, 0, 0]
"""
STEREO = """
[cameras.right]
fx = 87.5
fy = 87.5
cx = 79.5
cy = 44.5
distortion = [0, 0, 0, 0]
[cameras.stereo]
rotation = [0, 0, 0]
baseline_m = 0.12
"""
FILES = {
    "left_depth": "depth/{view}_left.npy",
    "right_depth": "depth/{view}_right.npy",
    "left_rgb": "left/{view}.png",
    "right_rgb": "right/{view}.png",
    "left_mask": "mask/{view}_left.png",
    "right_mask": "mask/{view}_right.png",
    "left_bars": "ids/{view}_left.png",
    "right_bars": "ids/{view}_right.png",
}
POSES = '\n[poses]\nfile = "poses/{view}.txt"\n'
BARS = '\n[bars]\nfile = "bars.csv"\n'


def sample_rows(tiny_root: Path) -> list[Row]:
    """Return the rows of the first views of the sample config ``lattice``."""
    dataset = load(tiny_root, "lattice")
    return [dataset[index] for index in range(len(NAMES))]


def write_layout(
    folder: Path,
    columns: Iterable[str] = FILES,
    *,
    tables: str = STEREO + POSES + BARS,
    files: Mapping[str, str] = {},
) -> Path:
    """Write a layout file that names the files of ``columns``, with ``files`` in place of ``FILES``."""
    names = {name: files.get(name, FILES[name]) for name in columns}
    lines = "".join(f'{name} = "{pattern}"\n' for name, pattern in names.items())
    path = folder / "layout.toml"
    path.write_text(f'description = "a test"\ntruth_sigma_m = 0.001\n\n[files]\n{lines}{CAMERAS}{tables}')
    return path


def write_source(folder: Path, rows: list[Row], tiny_root: Path) -> Path:
    """Write the files of ``FILES``, poses and bars; return the folder."""
    for name, row in zip(NAMES, rows, strict=True):
        for eye in ("left", "right"):
            write(folder / f"depth/{name}_{eye}.npy", npy(row[f"{eye}_depth"]))
            write(folder / f"{eye}/{name}.png", png(row[f"{eye}_rgb"]))
            write(folder / f"mask/{name}_{eye}.png", png(row[f"{eye}_mask"].astype(np.uint8) * 255))
            write(folder / f"ids/{name}_{eye}.png", png(row[f"{eye}_bars"]))
        pose = "\n".join(" ".join(map(repr, line)) for line in row["left_cam_from_world"].tolist())
        write(folder / f"poses/{name}.txt", pose.encode())
    lines = ["bar_id,role,diameter_m,x_m,y_m,z_m"]
    for bar in read_bars(tiny_root / "bars.parquet")["lattice"]:
        for x, y, z in bar.axis_m:
            lines.append(f"{bar.bar_id},{bar.role},{bar.diameter_m!r},{x!r},{y!r},{z!r}")
    write(folder / "bars.csv", "\n".join(lines).encode())
    return folder


def write(path: Path, content: bytes) -> None:
    """Write a file and its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


def npy(values: np.ndarray) -> bytes:
    """Return an array as NumPy saves it."""
    stream = io.BytesIO()
    np.save(stream, values)
    return stream.getvalue()


def png(values: np.ndarray) -> bytes:
    """Return an image as Pillow saves it as PNG."""
    stream = io.BytesIO()
    Image.fromarray(values).save(stream, "PNG")
    return stream.getvalue()


def opencv(values: np.ndarray, suffix: str) -> bytes:
    """Return an image as OpenCV encodes it."""
    return cv2.imencode(suffix, values)[1].tobytes()


def exr(folder: Path, channels: Mapping[str, np.ndarray], **attributes: Any) -> bytes:
    """Return an EXR file with these channels."""
    path = folder / "one.exr"
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **attributes}
    OpenEXR.File(header, dict(channels)).write(str(path))
    content = path.read_bytes()
    path.unlink()
    return content


def tiff(values: np.ndarray, **options: Any) -> bytes:
    """Return an image as Pillow saves it as TIFF."""
    stream = io.BytesIO()
    Image.fromarray(values).save(stream, "TIFF", **options)
    return stream.getvalue()


def range_m(row: Row) -> np.ndarray:
    """Return the distance along the ray of each pixel, metres."""
    rays = pixel_rays(row["left_K"], 160, 90)
    return np.asarray(row["left_depth"] * np.linalg.norm(rays, axis=-1))


def disparity_px(row: Row) -> np.ndarray:
    """Return the disparity of each pixel; infinite without depth."""
    with np.errstate(divide="ignore"):
        return np.asarray(87.5 * 0.12 / row["left_depth"].astype(np.float64))


def opengl_world_from_cam(row: Row) -> np.ndarray:
    """Return a pose as Blender states it."""
    return np.asarray(inverse_rigid(row["left_cam_from_world"]) @ np.diag([1.0, -1.0, -1.0, 1.0]))


Encode = Callable[[Path, Row], bytes]
DEPTH_FORMATS: Mapping[str, tuple[str, str, Encode, float]] = {
    "EXR": (".exr", "", lambda folder, row: exr(folder, {"V": row["left_depth"]}), 0.0),
    "EXR of several channels": (
        ".exr",
        'channel = "R"',
        lambda folder, row: exr(folder, {"R": row["left_depth"], "G": row["left_depth"] * 2}),
        0.0,
    ),
    "TIFF compressed": (".tiff", "", lambda _, row: tiff(row["left_depth"], compression="tiff_lzw"), 0.0),
    "TIFF of OpenCV": (".tiff", "", lambda _, row: opencv(row["left_depth"], ".tiff"), 0.0),
    "PNG millimetres": (".png", 'unit = "mm"', lambda _, row: png(_units(row, 1000)), 0.0005),
    "PNG of OpenCV": (".png", "scale = 0.0001", lambda _, row: opencv(_units(row, 10_000), ".png"), 0.000051),
    "PFM of OpenCV": (".pfm", "", lambda _, row: opencv(row["left_depth"], ".pfm"), 0.0),
    "range": (".npy", 'kind = "range"', lambda _, row: npy(range_m(row)), 1e-7),
    "disparity": (".npy", 'kind = "disparity"', lambda _, row: npy(disparity_px(row)), 1e-6),
    "invalid values": (".npy", "invalid = [-1, 1000]", lambda _, row: npy(_marked(row)), 0.0),
}
"""Suffix, keys of ``[depth]``, encoder of the left depth, and largest error in metres, by name."""


def write_depth_format(folder: Path, rows: list[Row], name: str) -> Path:
    """Write the left depth of the views in one of ``DEPTH_FORMATS``; return the layout file that names it."""
    suffix, keys, encode, _ = DEPTH_FORMATS[name]
    for view, row in zip(NAMES, rows, strict=True):
        write(folder / f"other/{view}{suffix}", encode(folder, row))
    files, tables = {"left_depth": f"other/{{view}}{suffix}"}, f"{STEREO}\n[depth]\n{keys}\n"
    return write_layout(folder, ("left_depth", "left_rgb", "right_rgb"), tables=tables, files=files)


def _units(row: Row, per_metre: float) -> np.ndarray:
    return np.asarray(np.round(row["left_depth"].astype(np.float64) * per_metre).astype(np.uint16))


def _marked(row: Row) -> np.ndarray:
    depth = row["left_depth"].copy()
    rows, columns = np.nonzero(depth == 0)
    depth[rows[::2], columns[::2]] = 1000
    depth[rows[1::2], columns[1::2]] = np.nan
    return np.asarray(depth)


def json_matrix(matrix: np.ndarray) -> bytes:
    """Return a JSON object with a matrix below ``camera.K``."""
    return json.dumps({"camera": {"K": matrix.tolist()}}).encode()
