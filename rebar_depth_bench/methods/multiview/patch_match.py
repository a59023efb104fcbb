"""COLMAP's PatchMatch stereo, which needs CUDA (``pycolmap-cuda12`` instead of ``pycolmap``).

PatchMatch has never been run here because no CUDA device was available; only the reader of depth maps is tested.
Source: J. L. Schoenberger et al., "Pixelwise View Selection for Unstructured Multi-View Stereo", ECCV 2016.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float32
from numpy import ndarray

from rebar_depth_bench.errors import MethodError

_HEADER = re.compile(rb"(\d{1,6})&(\d{1,6})&(\d)&")
_HEADER_BYTES = 24


def require_cuda() -> None:
    """Raise ``MethodError`` if COLMAP was built without CUDA."""
    if not pycolmap.has_cuda:
        raise MethodError(
            "COLMAP's PatchMatch stereo needs CUDA, but this pycolmap was built without it: on a machine with an "
            "NVIDIA GPU, pip install pycolmap-cuda12 instead; on a CPU use sweep-aruco or sweep-anchored"
        )


def patch_match(images: Path, model: Path, work: Path) -> Path:
    """Run PatchMatch with geometric consistency on a sparse model; return the folder of its depth maps.

    An interrupted run is resumed: COLMAP skips views whose depth maps exist, even if they are damaged, so damaged
    maps are removed first.
    """
    dense = work / "dense"
    for path in (dense / "stereo" / "depth_maps").glob("*.bin"):
        try:
            read_depth_map(path)
        except MethodError:
            path.unlink()
    if not (dense / "stereo" / "fusion.cfg").is_file():
        pycolmap.undistort_images(dense, model, images)
    pycolmap.patch_match_stereo(dense)
    return dense / "stereo" / "depth_maps"


def read_depth_map(path: Path) -> Float32[ndarray, "h w"]:
    """Return the depth map in a ``.bin`` file of COLMAP, in the unit of the reconstruction.

    Pixels without depth are NaN. The format is the text ``WIDTH&HEIGHT&CHANNELS&`` followed by little-endian
    float32 values, row by row, plane by plane. Raises ``MethodError`` for any other file.
    """
    data = path.read_bytes()
    header = _HEADER.match(data[:_HEADER_BYTES])
    width, height, channels = (int(number) for number in header.groups()) if header else (0, 0, 0)
    body = data[header.end() :] if header else b""
    if channels != 1 or len(body) != 4 * width * height:
        raise MethodError(
            f"{path}: is not a COLMAP depth map: {len(data)} bytes that start with {data[:_HEADER_BYTES]!r}, "
            "expected WIDTH&HEIGHT&1& and WIDTH x HEIGHT float32 values"
        )
    depth = np.frombuffer(body, "<f4").reshape(height, width)
    return np.where(depth > 0, depth, np.float32(np.nan))
