"""Entry points that read one file of an import: its layout, cameras, bars and depth maps."""

from __future__ import annotations

from dataclasses import astuple
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from dataset_builder.importing.config_import import plan_import
from tests.bench.submission.zips import exr, npy, npz, png
from tests.builder.importing.source_data import tiff
from tests.fuzz.file_entries import file_entry, is_finite
from tests.fuzz.workspace import EntryPoint

IMPORTED_M = np.linspace(0.5, 2.0, 256).reshape(16, 16).astype(np.float32)
_LAYOUT = """
description = "a scan"
truth_sigma_m = 0.001
[files]
left_depth = "depth-{view}.{suffix}"
left_rgb = "rgb-{view}.png"
[cameras]
width = 16
height = 16
[cameras.left]
fx = 20.0
fy = 20.0
cx = 7.5
cy = 7.5
distortion = [0, 0, 0, 0]
[poses]
file = "pose-{view}.txt"
[bars]
file = "bars.csv"
"""
_VIEWS = """
truth_sigma_m = 0.001
[files]
left_depth = "depth-{view}.npy"
left_rgb = "rgb-{view}.png"
[cameras]
views = "views.json"
"""
_BOP = """{
  "0": {"cam_K": [20.0, 0.0, 7.5, 0.0, 20.0, 7.5, 0.0, 0.0, 1.0], "depth_scale": 1000.0,
    "cam_R_w2c": [1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0], "cam_t_w2c": [10.0, -20.0, 500.0]},
  "1": {"cam_K": [20.0, 0.0, 7.5, 0.0, 20.0, 7.5, 0.0, 0.0, 1.0], "depth_scale": 1000.0, "view_level": 2}
}"""
_MILLIMETRES = '[depth]\nunit = "mm"\ninvalid = [65535, 65.535]\nmax_m = 1.8\n'
_BARS = """bar_id,role,diameter_m,x_m,y_m,z_m
1,main,0.016,0.0,0.1,0.2
1,main,0.016,0.5,0.1,0.2
2,stirrup,0.01,0.0,0.0,0.0
2,stirrup,0.01,0.0,0.2,0.0
2,stirrup,0.01,0.1,0.3,0.1
"""
_SPREADSHEET = "\ufeffsep=;\r\n" + _BARS.upper().replace(",", ";").replace("\n", "\r\n")


def _pfm(depth_m: np.ndarray) -> bytes:
    """Return a PFM file, whose rows are from bottom to top."""
    height, width = depth_m.shape
    return f"Pf\n{width} {height}\n-1.0\n".encode() + depth_m[::-1].astype("<f4").tobytes()


def _write_import(
    path: Path, depth: bytes = npy(IMPORTED_M), suffix: str = "npy", table: str = "", bars: str = _BARS
) -> None:
    """Write a layout with a further ``table``, its bars and one view, whose depth has the content ``depth``."""
    folder = path.parent
    (folder / "layout.toml").write_text(_LAYOUT.replace("{suffix}", suffix) + table)
    (folder / "bars.csv").write_text(bars)
    (folder / f"depth-a.{suffix}").write_bytes(depth)
    Image.new("RGB", (16, 16)).save(folder / "rgb-a.png")
    np.savetxt(folder / "pose-a.txt", np.eye(4))


def _import(path: Path) -> object:
    source = plan_import(path.with_name("layout.toml"), "mock-up")
    depth_m = source.views.decode("a")["left_depth"]
    assert np.isfinite(depth_m).all()
    assert (depth_m >= 0).all()
    return source.bars, depth_m.tolist()


def _write_views(content: str, path: Path) -> None:
    """Write a layout with one view, whose cameras are in a file with this content."""
    path.write_text(content)
    path.with_name("layout.toml").write_text(_VIEWS)
    path.with_name("depth-0.npy").write_bytes(npy(IMPORTED_M))
    Image.new("RGB", (16, 16)).save(path.with_name("rgb-0.png"))


def _read_views(path: Path) -> object:
    source = plan_import(path.with_name("layout.toml"), "mock-up")
    camera = source.views.cameras["0"]
    assert is_finite(astuple(camera.calibration))
    assert camera.cam_from_world is None or np.isfinite(camera.cam_from_world).all()
    assert np.isfinite(source.views.decode("0")["left_depth"]).all()
    return camera


_imported = partial(file_entry, read=_import, cpu_s=10.0)


def _imported_depth(kind: str, suffix: str, content: bytes, table: str = "") -> EntryPoint:
    write = partial(_write_import, depth=content, suffix=suffix, table=table)
    return _imported(f"import: {kind}", f"depth-a.{suffix}", write)


IMPORT_ENTRIES = (
    _imported("import: layout", "layout.toml", _write_import),
    file_entry(
        "import: BOP's cameras", "views.json", partial(_write_views, _BOP), _read_views, share=10, cpu_s=10.0
    ),
    _imported("import: bars", "bars.csv", _write_import),
    _imported("import: bars of a spreadsheet", "bars.csv", partial(_write_import, bars=_SPREADSHEET)),
    _imported_depth("npy", "npy", npy(IMPORTED_M)),
    _imported_depth("npz", "npz", npz(depth=IMPORTED_M)),
    _imported_depth("npy of integers", "npy", npy(np.round(1000 * IMPORTED_M).astype(np.int32)), _MILLIMETRES),
    _imported_depth("TIFF", "tif", tiff(IMPORTED_M)),
    _imported_depth("TIFF of integers", "tif", tiff(np.round(1000 * IMPORTED_M).astype(np.uint16)), _MILLIMETRES),
    _imported_depth("PFM", "pfm", _pfm(IMPORTED_M)),
    _imported("import: EXR", "depth-a.exr", lambda path: _write_import(path, exr(path, {"V": IMPORTED_M}), "exr")),
    _imported_depth("PNG", "png", png(np.round(1000 * IMPORTED_M)), _MILLIMETRES),
)
