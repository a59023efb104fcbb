"""Parser of camera calibrations in TOML: of a stereo pair, or of one camera.

``calibration.read_calibration`` documents the keys; a file of one camera has the table ``[left]`` alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from pydantic import Field, Strict, ValidationInfo, field_validator

from rebar_depth_bench.errors import Problem
from rebar_depth_bench.geometry.calibration_quantities import (
    ANGLE_RAD,
    BASELINE_M,
    DISTORTION,
    FOCAL_PX,
    OFFSET_M,
    ROTATION_TOLERANCE,
    SIDES_PX,
    principal_point,
)
from rebar_depth_bench.geometry.cameras import rotation_vector
from rebar_depth_bench.geometry.stereo_calibration import (
    Calibration,
    Lens,
    MonoCalibration,
    StereoCalibration,
)
from rebar_depth_bench.validation import (
    Expected,
    StrictModel,
    Triple,
    field_error,
    validate_table,
    whole_number,
)

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
