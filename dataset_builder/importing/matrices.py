"""Matrices of single views in files: poses and intrinsics as text, NumPy arrays or JSON."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.importing.layout import PosesTable
from rebar_depth_bench.errors import EntryError, InputError, Problem, escape_text
from rebar_depth_bench.geometry.cameras import inverse_rigid, swap_camera_axes
from rebar_depth_bench.limits import TOML_BYTES
from rebar_depth_bench.reading import parse_json, read_file
from rebar_depth_bench.validation import UNITS_M, short_repr

MATRIX_SUFFIXES = (".txt", ".npy", ".json")
_ROUNDED_ROTATION = 1e-3
"""Largest deviation of ``R @ R.T`` from the identity in files with few digits; the rotation is made exact."""


def read_matrix(path: Path, key: str | None, shape: tuple[int, int]) -> Float64[ndarray, "n m"]:
    """Return the matrix in a file, of ``shape`` or, for poses, without the row 0 0 0 1.

    ``key`` is that of a JSON object. Raises ``EntryError`` for anything but finite numbers.
    """
    content = read_file(path, TOML_BYTES, "a matrix", InputError)
    try:
        values = np.asarray(_READERS[path.suffix.lower()](content, key), dtype=np.float64)
    except EntryError:
        raise
    except Exception as error:  # NumPy raises many types, which depend on the damage.
        reason = escape_text(str(error) or type(error).__name__)
        raise EntryError(Problem("damaged", path.name, f"cannot be read: {reason}", "numbers")) from None
    if values.size == 12 and shape == (4, 4):
        values = np.vstack([values.reshape(3, 4), [0, 0, 0, 1]])
    if values.size != shape[0] * shape[1] or not np.isfinite(values).all():
        found = f"holds {values.size} numbers"
        raise EntryError(Problem("invalid", path.name, found, f"{shape[0]} x {shape[1]} finite numbers"))
    return values.reshape(shape)


def cam_from_world(path: Path, table: PosesTable) -> Float64[ndarray, "4 4"]:
    """Return a pose in OpenCV axes and metres. Raises ``EntryError`` for a matrix that is no rigid pose."""
    pose = read_matrix(path, table.key, (4, 4))
    rotation = pose[:3, :3]
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not (error <= _ROUNDED_ROTATION and np.linalg.det(rotation) > 0 and (pose[3] == (0, 0, 0, 1)).all()):
        found = f"holds {short_repr(pose.tolist())}"
        raise EntryError(Problem("invalid", path.name, found, "a rotation, a translation, and 0 0 0 1"))
    u, _, vt = np.linalg.svd(rotation)
    pose[:3, :3] = u @ vt
    pose[:3, 3] *= UNITS_M[table.unit]
    if table.kind == "world_from_cam":
        pose = inverse_rigid(pose)
    return swap_camera_axes(pose) if table.axes == "opengl" else pose


def _text(content: bytes, _: str | None) -> ndarray:
    return np.loadtxt(io.StringIO(content.decode().replace(",", " ")), ndmin=2)


def _npy(content: bytes, _: str | None) -> ndarray:
    return np.asarray(np.load(io.BytesIO(content), allow_pickle=False))


def _json(content: bytes, key: str | None) -> object:
    value, problems = parse_json(content)
    if problems:
        raise EntryError(problems[0])
    for part in key.split(".") if key is not None else ():
        if not isinstance(value, dict) or part not in value:
            raise ValueError(f"it has no key {key}")
        value = value[part]
    return value


_READERS = {".txt": _text, ".npy": _npy, ".json": _json}
