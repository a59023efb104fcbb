"""Calibration of one camera or of a stereo pair, and its table in TOML.

``calibration_files.read_calibration`` documents the keys; a table of one camera has the table ``[left]`` alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, TypeVar

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from pydantic import Field, Strict, ValidationInfo, field_validator

from rebar_depth_bench.errors import Problem
from rebar_depth_bench.geometry.cameras import rigid, rotation_matrix, rotation_vector, undistort
from rebar_depth_bench.validation import (
    Expected,
    StrictModel,
    Triple,
    field_error,
    number,
    validate_table,
    whole_number,
)


@dataclass(frozen=True)
class Lens:
    """Intrinsics of one camera: pinhole parameters, pixels, and distortion k1 k2 p1 p2 k3 (OpenCV's order)."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float]


@dataclass(frozen=True)
class StereoCalibration:
    """Calibrated stereo pair, with ``x_right = R(rotation_rad) @ x_left + translation_m`` in OpenCV axes.

    ``rotation_rad`` is a Rodrigues vector; ``translation_m`` is about (-baseline, 0, 0). The intrinsics apply to
    images of ``width`` x ``height`` pixels.
    """

    width: int
    height: int
    left: Lens
    right: Lens
    rotation_rad: tuple[float, float, float]
    translation_m: tuple[float, float, float]


@dataclass(frozen=True)
class MonoCalibration:
    """Calibrated camera, for images of ``width`` x ``height`` pixels."""

    width: int
    height: int
    left: Lens


Calibration = StereoCalibration | MonoCalibration
_AnyCalibration = TypeVar("_AnyCalibration", StereoCalibration, MonoCalibration, Calibration)


def lens_K(lens: Lens) -> Float64[ndarray, "3 3"]:
    """Return the pinhole matrix of a camera, pixels."""
    return np.array([[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]])


def lens_distortion(lens: Lens) -> Float64[ndarray, 5]:
    """Return the distortion coefficients k1 k2 p1 p2 k3."""
    return np.array(lens.distortion, dtype=np.float64)


def right_from_left(calibration: StereoCalibration) -> Float64[ndarray, "4 4"]:
    """Return the rigid motion ``x_right = R x_left + T`` as a 4 x 4 matrix, metres."""
    return rigid(rotation_matrix(calibration.rotation_rad), np.array(calibration.translation_m))


def calibrated_baseline_m(calibration: StereoCalibration) -> float:
    """Return the distance between the camera centres, metres."""
    return float(np.linalg.norm(calibration.translation_m))


def scale_calibration(calibration: _AnyCalibration, width: int, height: int) -> _AnyCalibration:
    """Return the calibration for another image size that covers the same sensor area.

    Pixel centres are at integers, so scaling a side from W to W' gives cx' = (cx + 0.5) W'/W - 0.5. The distortion
    coefficients refer to the plane z = 1 and do not change.
    """
    scale_x, scale_y = width / calibration.width, height / calibration.height
    if (scale_x, scale_y) == (1.0, 1.0):
        return calibration

    def scale_lens(lens: Lens) -> Lens:
        cx, cy = (lens.cx + 0.5) * scale_x - 0.5, (lens.cy + 0.5) * scale_y - 0.5
        return replace(lens, fx=lens.fx * scale_x, fy=lens.fy * scale_y, cx=cx, cy=cy)

    scaled = replace(calibration, width=width, height=height, left=scale_lens(calibration.left))
    return scaled if isinstance(scaled, MonoCalibration) else replace(scaled, right=scale_lens(scaled.right))


def check_invertible(lens: Lens, width: int, height: int) -> None:
    """Check that the distortion can be inverted at all pixels on the rim of a ``width`` x ``height`` image.

    The rim is farthest from the principal point and the model folds at a radius, so that an invertible rim implies
    an invertible image. Raises ``ValueError`` if it cannot be inverted.
    """
    u, v = np.arange(-0.5, width), np.arange(-0.5, height)
    rim = np.concatenate(
        [np.stack(np.broadcast_arrays(u, edge), axis=-1) for edge in (v[0], v[-1])]
        + [np.stack(np.broadcast_arrays(edge, v), axis=-1) for edge in (u[0], u[-1])]
    )
    undistort((rim - (lens.cx, lens.cy)) / (lens.fx, lens.fy), lens_distortion(lens))


# Bounds of the numbers: image sizes, intrinsics, distortion, and the motion of a pair.


SIDES_PX = range(16, 16385)
"""Accepted widths and heights of images, pixels."""
MIN_PRINCIPAL_POINT = -0.5
"""Smallest coordinate of a principal point, pixels: the left edge of the first pixel, whose centre is at 0."""
ROTATION_TOLERANCE = 1e-6
"""Largest deviation of ``R @ R.T`` from the identity for a 3 x 3 rotation."""


def quantity(low: float, high: float, unit: str) -> Expected:
    """Return the description of numbers from ``low`` to ``high``."""
    return number(low, high, f"a number from {low:g} to {high:g} {unit}")


def principal_point(side_px: int) -> Expected:
    """Return the description of a coordinate of the principal point in an image of ``side_px`` pixels."""
    return quantity(MIN_PRINCIPAL_POINT, side_px - 0.5, "pixels")


FOCAL_PX = quantity(1, 1e5, "pixels")
DISTORTION = number(-1000, 1000)
ANGLE_RAD = quantity(-0.5, 0.5, "radians")
BASELINE_MM = quantity(1, 10_000, "millimetres")
OFFSET_MM = quantity(-1000, 1000, "millimetres")
BASELINE_M = quantity(0.001, 10, "metres")
OFFSET_M = quantity(-10, 10, "metres")


# Table of a calibration.


_Matrix = Annotated[tuple[Triple, Triple, Triple], Strict(False)]
_Offset = Annotated[float, OFFSET_M]
_Pixels = Annotated[float, Expected("a number of pixels")]
_Side = Annotated[int, whole_number(SIDES_PX[0], SIDES_PX[-1])]
_PINHOLE_ENTRIES: Mapping[str, tuple[int, int]] = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}
_PINHOLE = Expected(
    "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", lambda K: (K[0][1], K[1][0], *K[2]) == (0, 0, 0, 0, 1)
)
_TERMS = Expected("[k1, k2, p1, p2] or [k1, k2, p1, p2, k3]", lambda terms: len(terms) in (4, 5))


def is_small_rotation(rotation: Triple | _Matrix) -> bool:
    """Return whether a Rodrigues vector, or a rotation matrix, has a plausible angle."""
    values = np.array(rotation)
    if values.ndim == 1:
        return all(map(ANGLE_RAD.accept, rotation))
    if not (np.abs(values) <= 1 + ROTATION_TOLERANCE).all():  # The products stay finite; false for NaN.
        return False
    cosine = (float(np.trace(values)) - 1.0) / 2
    return bool(
        np.abs(values @ values.T - np.eye(3)).max() <= ROTATION_TOLERANCE
        and np.linalg.det(values) >= 0
        and ANGLE_RAD.accept(math.acos(max(-1.0, min(1.0, cosine))))
    )


_ROTATION = Expected(
    f"a Rodrigues vector or a 3 x 3 rotation matrix, each angle {ANGLE_RAD.text}", is_small_rotation
)


class _LensTable(StrictModel):  # Order matters: validators read the fields above theirs.
    """Table ``[left]`` or ``[right]``; ``info.context`` is the image size."""

    K: Annotated[_Matrix, _PINHOLE] | None = None
    fx: Annotated[float, FOCAL_PX] = Field(default=None, validate_default=True)
    fy: Annotated[float, FOCAL_PX] = Field(default=None, validate_default=True)
    cx: _Pixels = Field(default=None, validate_default=True)
    cy: _Pixels = Field(default=None, validate_default=True)
    distortion: Annotated[list[Annotated[float, DISTORTION]], _TERMS]

    @field_validator(*_PINHOLE_ENTRIES, mode="before")
    @classmethod
    def _take_from_K(cls, value: object, info: ValidationInfo) -> object:
        """Return the number, or the entry of K; any valid number if K is given but invalid."""
        K = info.data.get("K", ((1, 0, 1), (0, 1, 1), (0, 0, 1)))
        _check_one_given({str(info.field_name): value, "K": K})
        row, column = _PINHOLE_ENTRIES[str(info.field_name)]
        return value if K is None else K[row][column]

    @field_validator("cx", "cy")
    @classmethod
    def _check_inside_image(cls, value: float, info: ValidationInfo[Mapping[str, int]]) -> float:
        expected = principal_point(info.context["width" if info.field_name == "cx" else "height"])
        if not expected.accept(value):
            raise field_error(f"got {value}", expected.text)
        return value

    @property
    def lens(self) -> Lens:
        """Lens of the table."""
        k1, k2, p1, p2, k3 = (*self.distortion, 0.0)[:5]
        return Lens(self.fx, self.fy, self.cx, self.cy, (k1, k2, p1, p2, k3))


class _StereoTable(StrictModel):
    """Table ``[stereo]``; the baseline is converted to a translation."""

    rotation: Annotated[Triple | _Matrix, _ROTATION]
    baseline_m: Annotated[float, BASELINE_M] | None = None
    translation_m: Annotated[
        tuple[_Offset, _Offset, _Offset], Strict(False), Expected("three numbers, metres")
    ] = Field(default=None, validate_default=True)

    @field_validator("translation_m", mode="before")
    @classmethod
    def _take_from_baseline(cls, translation_m: object, info: ValidationInfo) -> object:
        """Return the translation, or that along x; any valid one if the baseline is given but invalid."""
        baseline_m = info.data.get("baseline_m", 1.0)
        _check_one_given({"translation_m": translation_m, "baseline_m": baseline_m})
        return translation_m if baseline_m is None else (-baseline_m, 0.0, 0.0)

    @field_validator("translation_m")
    @classmethod
    def _check_baseline(cls, translation_m: Triple) -> Triple:
        if not BASELINE_M.accept(-translation_m[0]):
            raise field_error(f"got {list(translation_m)}", f"[-baseline, y, z], the baseline {BASELINE_M.text}")
        return translation_m


class _OneCamera(StrictModel):
    """Content of a file of one camera."""

    width: _Side
    height: _Side
    left: _LensTable


class _TwoCameras(_OneCamera):
    """Content of a file of a stereo pair."""

    right: _LensTable
    stereo: _StereoTable


def _check_one_given(values: Mapping[str, object]) -> None:
    """Check that one of two keys has a value. Raises the error of a field otherwise."""
    given = [key for key, value in values.items() if value is not None]
    if len(given) != 1:
        found = f"got {' and '.join(given)}" if given else "missing"
        raise field_error(found, f"either {' or '.join(values)}", "conflict" if given else "missing")


def table_calibration(
    document: Mapping[str, Any], width: int, height: int, problems: list[Problem], *, is_stereo: bool
) -> Calibration | None:
    """Return the calibration in the content of a TOML file, of a stereo pair or of one camera.

    It is for the image size in the file, or else ``width`` x ``height``. Problems are added to ``problems``; the
    result is None if there are any.
    """
    sides_px = {"width": width, "height": height}
    values = {**sides_px, **document}
    context = {key: values[key] if values[key] in SIDES_PX else side_px for key, side_px in sides_px.items()}
    table = validate_table(_TwoCameras if is_stereo else _OneCamera, values, problems, context=context)
    if table is None:
        return None
    if not isinstance(table, _TwoCameras):
        return MonoCalibration(table.width, table.height, table.left.lens)
    rotation = np.array(table.stereo.rotation)
    x, y, z = (rotation if rotation.ndim == 1 else rotation_vector(rotation)).tolist()
    left, right, translation_m = table.left.lens, table.right.lens, table.stereo.translation_m
    return StereoCalibration(table.width, table.height, left, right, (x, y, z), translation_m)
