"""One eye (left or right camera) of a stereo view: its camera, colour and ground truth, and their digest."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8, UInt16
from numpy import ndarray

from rebar_depth_bench.geometry.cameras import Camera

CAMERA_KINDS = ("K", "distortion", "cam_from_world")
"""Kinds of the dataset's columns that describe a camera (see ``columns.column_kind``)."""
_CAMERA_SHAPES = dict(zip(CAMERA_KINDS, ((3, 3), (5,), (4, 4)), strict=True))
_MAX_ROTATION_ERROR = 1e-6
"""Largest deviation of a rotation times its transpose from the identity matrix."""


@dataclass(frozen=True, eq=False)
class EyeTruth:
    """Camera and images of one eye of a view, rendered or imported.

    ``rgb`` is None where colour is not needed. ``depth_m`` is planar z (0: no surface), ``mask`` marks steel
    pixels, ``bars`` holds bar ids (0: no steel). Mask and bar ids are None in a config that was imported without.
    """

    camera: Camera
    rgb: UInt8[ndarray, "h w 3"] | None
    depth_m: Float32[ndarray, "h w"]
    mask: Bool[ndarray, "h w"] | None
    bars: UInt16[ndarray, "h w"] | None

    def digest(self) -> str:
        """Return the hex SHA-256 of the ground truth: of image size, depth, mask, bar ids and camera.

        It covers the decoded values, not their encoding, and which of them are absent.
        """
        digest = hashlib.sha256(np.array(self.depth_m.shape, "<u4").tobytes())
        arrays = (
            (self.depth_m, "<f4"),
            (self.mask, "u1"),
            (self.bars, "<u2"),
            (self.camera.K, "<f8"),
            (self.camera.distortion, "<f8"),
            (self.camera.cam_from_world, "<f8"),
        )
        for array, dtype in arrays:
            digest.update(b"absent" if array is None else np.ascontiguousarray(array, dtype=dtype).data)
        return digest.hexdigest()


@dataclass(frozen=True, eq=False)
class EyeView(EyeTruth):
    """One eye of a rendered view, which has a mask and bar ids."""

    mask: Bool[ndarray, "h w"]
    bars: UInt16[ndarray, "h w"]


def truth_columns(eye: str) -> tuple[str, ...]:
    """Return the names of the columns that ``truth_from_row`` requires for ``left`` or ``right``."""
    return tuple(f"{eye}_{kind}" for kind in ("depth", "mask", "bars", *CAMERA_KINDS))


def truth_from_row(row: Mapping[str, Any], eye: str) -> EyeTruth:
    """Return one eye of a decoded row that has its depth; ``rgb`` is None if the row lacks that column."""
    depth_m = row[f"{eye}_depth"]
    camera = camera_from_row(row, eye, depth_m.shape[:2])  # A damaged image may have a third axis.
    return EyeTruth(camera, row.get(f"{eye}_rgb"), depth_m, row[f"{eye}_mask"], row[f"{eye}_bars"])


def camera_from_row(row: Mapping[str, Any], eye: str, grid: tuple[int, int]) -> Camera:
    """Return the camera of one eye of a row, decoded or not; ``grid`` is its image size (height, width).

    Raises ``ValueError`` for arrays that ``camera_array`` rejects.
    """
    K, distortion, cam_from_world = (camera_array(kind, row[f"{eye}_{kind}"]) for kind in CAMERA_KINDS)
    height, width = grid
    return Camera(K, distortion, cam_from_world, width, height)


def absent_cell(kind: str) -> list[Any] | None:
    """Return the cell of an absent column: null, or NaN for ``CAMERA_KINDS``.

    Parquet readers of Arrow fail on null lists of a fixed size.
    """
    return np.full(_CAMERA_SHAPES[kind], np.nan).tolist() if kind in CAMERA_KINDS else None


def is_absent(cell: Any) -> bool:
    """Return whether a cell is null, or a list of NaN."""
    return cell is None or (isinstance(cell, list) and len(cell) > 0 and bool(np.isnan(np.ravel(cell)).all()))


def camera_array(kind: str, cell: Any) -> Float64[ndarray, ...]:
    """Return a cell of one of ``CAMERA_KINDS`` as an array; arrays are returned unchanged.

    Raises ``ValueError`` unless it holds finite numbers of the kind's shape; a pose has to be rigid.
    """
    if isinstance(cell, ndarray):
        return cell
    array = np.array(cell, dtype=np.float64)
    if array.shape != _CAMERA_SHAPES[kind]:
        raise ValueError(f"it has the shape {array.shape}, expected {_CAMERA_SHAPES[kind]}")
    if not np.isfinite(array).all():
        raise ValueError("it has values that are not finite, expected finite numbers")
    if kind == "cam_from_world":
        rotation = array[:3, :3]
        with np.errstate(over="ignore", invalid="ignore"):
            error = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if not (error < _MAX_ROTATION_ERROR and np.linalg.det(rotation) > 0 and (array[3] == (0, 0, 0, 1)).all()):
            raise ValueError("it is no rigid pose: a rotation, a translation and the last row 0 0 0 1")
    return array
