"""Calibration of one camera or of a stereo pair, and its table in TOML.

``calibration_files.read_calibration`` documents the keys; a table of one camera has the table ``[left]`` alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, TypeVar

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from pydantic import Strict, ValidationInfo, field_validator, model_validator

from rebar_depth_bench.base.errors import CalibrationError, Problem
from rebar_depth_bench.base.validation import (
    Expected,
    StrictModel,
    Triple,
    field_error,
    number,
    short_repr,
    validate_table,
    whole_number,
)
from rebar_depth_bench.geometry.cameras import is_rotation, rigid, rotation_matrix, rotation_vector, undistort


@dataclass(frozen=True)
class Lens:
    """Intrinsics of one camera: pinhole parameters, pixels, and distortion k1 k2 p1 p2 k3 (OpenCV's order)."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float]

    @property
    def K(self) -> Float64[ndarray, "3 3"]:
        """Pinhole matrix, pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class StereoCalibration:
    """Calibrated stereo pair, with ``x_right = R(rotation_rad) @ x_left + translation_m`` in OpenCV axes.

    ``rotation_rad`` is a Rodrigues vector; ``translation_m`` is about (-baseline, 0, 0). The intrinsics apply to
    images of ``width`` x ``height`` pixels. ``notes`` say what was left out of the file that states it.
    """

    width: int
    height: int
    left: Lens
    right: Lens
    rotation_rad: tuple[float, float, float]
    translation_m: tuple[float, float, float]
    notes: tuple[str, ...] = field(default=(), compare=False, repr=False)

    @property
    def right_from_left(self) -> Float64[ndarray, "4 4"]:
        """Rigid motion ``x_right = R x_left + T`` as a 4 x 4 matrix, metres."""
        return rigid(rotation_matrix(self.rotation_rad), np.array(self.translation_m))

    @property
    def baseline_m(self) -> float:
        """Distance between the camera centres, metres."""
        return float(np.linalg.norm(self.translation_m))

    @property
    def is_rectified(self) -> bool:
        """Whether the cameras have no distortion, are parallel, and differ in x only."""
        left, right = self.left, self.right
        moved = (*self.rotation_rad, *self.translation_m[1:], *left.distortion, *right.distortion)
        return (left.fx, left.fy, left.cy) == (right.fx, right.fy, right.cy) and not any(moved)


@dataclass(frozen=True)
class MonoCalibration:
    """Calibrated camera, for images of ``width`` x ``height`` pixels; ``notes`` as of a stereo pair."""

    width: int
    height: int
    left: Lens
    notes: tuple[str, ...] = field(default=(), compare=False, repr=False)

    @property
    def is_rectified(self) -> bool:
        """Whether the camera has no distortion."""
        return not any(self.left.distortion)


Calibration = StereoCalibration | MonoCalibration
Side = int | None
"""Width or height of images, pixels; None stands for that of the calibration."""
_AnyCalibration = TypeVar("_AnyCalibration", StereoCalibration, MonoCalibration, Calibration)


def camera_columns(calibration: Calibration, left_cam_from_world: Float64[ndarray, "4 4"]) -> dict[str, Any]:
    """Return the columns of a dataset that describe the calibrated cameras, for a pose of the left one."""
    left = calibration.left
    columns = {
        "left_K": left.K,
        "left_distortion": np.array(left.distortion),
        "left_cam_from_world": left_cam_from_world,
    }
    if isinstance(calibration, MonoCalibration):
        return columns
    return columns | {
        "right_K": calibration.right.K,
        "right_distortion": np.array(calibration.right.distortion),
        "right_cam_from_world": calibration.right_from_left @ left_cam_from_world,
        "baseline_m": calibration.baseline_m,
    }


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


def scaled_calibration(calibration: _AnyCalibration, source: object, width: Side, height: Side) -> _AnyCalibration:
    """Return the calibration in the file ``source`` for images of ``width`` x ``height`` pixels.

    Raises ``CalibrationError`` if the right camera is not beside the left one, if a distortion has no inverse, and
    for images of another aspect ratio.
    """
    problems = []
    eyes = {"left": calibration.left}
    if isinstance(calibration, StereoCalibration):
        eyes["right"] = calibration.right
        x_m, y_m, z_m = calibration.translation_m
        if max(abs(y_m), abs(z_m)) > abs(x_m) / 2:
            found = f"the right camera is at {(-x_m, -y_m, -z_m)} m from the left one"
            problems.append(Problem("conflict", "stereo", found, "an offset mostly along x"))
    for eye, lens in eyes.items():
        try:
            _check_invertible(lens, calibration.width, calibration.height)
        except ValueError as error:
            found = f"the distortion cannot be inverted at the image border: {error}"
            problems.append(Problem("conflict", eye, found))
    width, height = width or calibration.width, height or calibration.height
    scaled = scale_calibration(calibration, width, height)
    ratio = scaled.left.fx / scaled.left.fy
    if not problems and abs(ratio - 1) > _SQUARE_PIXEL_TOLERANCE:
        found = f"at {width} x {height} pixels fx is {ratio:.3f} times fy"
        expected = "1: these are the cameras of images of another aspect ratio"
        problems.append(Problem("conflict", "", found, expected))
    if problems:
        raise CalibrationError.from_problems(source, problems)
    return scaled


def _check_invertible(lens: Lens, width: int, height: int) -> None:
    """Check that the distortion can be inverted at all pixels on the rim of a ``width`` x ``height`` image.

    The rim is farthest from the principal point and the model folds at a radius, so that an invertible rim implies
    an invertible image. Raises ``ValueError`` if it cannot be inverted.
    """
    u, v = np.arange(-0.5, width), np.arange(-0.5, height)
    rim = np.concatenate(
        [np.stack(np.broadcast_arrays(u, edge), axis=-1) for edge in (v[0], v[-1])]
        + [np.stack(np.broadcast_arrays(edge, v), axis=-1) for edge in (u[0], u[-1])]
    )
    undistort((rim - (lens.cx, lens.cy)) / (lens.fx, lens.fy), np.array(lens.distortion))


# Bounds of the numbers.

SIDES_PX = range(16, 16385)
"""Accepted widths and heights of images, pixels."""
_SQUARE_PIXEL_TOLERANCE = 0.03
"""Maximum deviation of fx / fy from 1.

Real cameras deviate by a fraction of a per cent; images of a different aspect ratio than the calibration's cause
larger deviations.
"""


def quantity(low: float, high: float, unit: str) -> Expected:
    """Return the description of numbers from ``low`` to ``high``."""
    return number(low, high, f"a number from {low:g} to {high:g} {unit}")


def principal_point(side_px: int) -> Expected:
    """Return the description of a coordinate of the principal point: on a pixel, whose centres are integers."""
    return quantity(-0.5, side_px - 0.5, "pixels")


FOCAL_PX = quantity(1, 1e5, "pixels")
DISTORTION = number(-1000, 1000)
ANGLE_RAD = quantity(-0.5, 0.5, "radians")
BASELINE_M = quantity(0.001, 10, "metres")


# Table of a calibration.


_Matrix = Annotated[tuple[Triple, Triple, Triple], Strict(False)]
_Offset = Annotated[float, quantity(-10, 10, "metres; unit in cameras.toml or [rig] states that of a file")]
_Pixels = Annotated[float, Expected("a number of pixels")]
_Side = Annotated[int, whole_number(SIDES_PX[0], SIDES_PX[-1])]
_TERMS = Expected("[k1, k2, p1, p2] or [k1, k2, p1, p2, k3]", lambda terms: len(terms) in (4, 5))


def _is_small_rotation(rotation: Triple | _Matrix) -> bool:
    """Return whether a Rodrigues vector, or a rotation matrix, has a plausible angle."""
    values = np.array(rotation)
    if values.ndim == 1:
        return all(map(ANGLE_RAD.accept, rotation))
    cosine = (float(np.trace(values)) - 1.0) / 2
    return is_rotation(values) and ANGLE_RAD.accept(math.acos(max(-1.0, min(1.0, cosine))))


_ROTATION = Expected(
    f"a Rodrigues vector or a 3 x 3 rotation matrix, each angle {ANGLE_RAD.text}", _is_small_rotation
)


class _LensTable(StrictModel):
    """Table ``[left]`` or ``[right]``; ``info.context`` is the image size."""

    fx: Annotated[float, FOCAL_PX]
    fy: Annotated[float, FOCAL_PX]
    cx: _Pixels
    cy: _Pixels
    distortion: Annotated[list[Annotated[float, DISTORTION]], _TERMS]

    @model_validator(mode="before")
    @classmethod
    def _take_numbers_of_K(cls, table: Any) -> Any:
        if not isinstance(table, Mapping) or "K" not in table:
            return table
        match table:
            case {"fx": _} | {"fy": _} | {"cx": _} | {"cy": _}:
                raise field_error("has K beside fx, fy, cx or cy", "either K or these", "conflict")
            case {"K": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], **others}:
                return {**others, "fx": fx, "fy": fy, "cx": cx, "cy": cy}
        raise field_error(f"K is {short_repr(table['K'])}", "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")

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
    translation_m: Annotated[
        tuple[_Offset, _Offset, _Offset], Strict(False), Expected("three numbers, metres, or baseline_m")
    ]

    @model_validator(mode="before")
    @classmethod
    def _take_baseline(cls, table: Any) -> Any:
        if not isinstance(table, Mapping) or "baseline_m" not in table:
            return table
        if "translation_m" in table:
            raise field_error("has translation_m beside baseline_m", "one of them", "conflict")
        baseline_m, others = table["baseline_m"], {key: table[key] for key in table if key != "baseline_m"}
        if type(baseline_m) not in (int, float) or not BASELINE_M.accept(baseline_m):
            raise field_error(f"baseline_m is {short_repr(baseline_m)}", BASELINE_M.text)
        return {**others, "translation_m": (-float(baseline_m), 0.0, 0.0)}

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

    @property
    def calibration(self) -> Calibration:
        """Calibration of the table."""
        return MonoCalibration(self.width, self.height, self.left.lens)


class _TwoCameras(_OneCamera):
    """Content of a file of a stereo pair."""

    right: _LensTable
    stereo: _StereoTable

    @property
    def calibration(self) -> StereoCalibration:
        """Calibration of the tables."""
        rotation = np.array(self.stereo.rotation)
        x, y, z = (rotation if rotation.ndim == 1 else rotation_vector(rotation)).tolist()
        left, right, translation_m = self.left.lens, self.right.lens, self.stereo.translation_m
        return StereoCalibration(self.width, self.height, left, right, (x, y, z), translation_m)


def table_calibration(
    document: Mapping[str, Any], width: Side, height: Side, problems: list[Problem], *, is_stereo: bool
) -> Calibration | None:
    """Return the calibration in the content of a TOML file, of a stereo pair or of one camera.

    It is for the image size in the file, or else ``width`` x ``height``. Problems are added to ``problems``; the
    result is None if there are any.
    """
    sides_px = {"width": width, "height": height}
    values = {key: side_px for key, side_px in sides_px.items() if side_px is not None} | dict(document)
    most = {key: side_px or SIDES_PX[-1] for key, side_px in sides_px.items()}
    context = {key: values[key] if values.get(key) in SIDES_PX else side_px for key, side_px in most.items()}
    table = validate_table(_TwoCameras if is_stereo else _OneCamera, values, problems, context=context)
    return None if table is None else table.calibration
