"""Stereo rigs of one's own: the table ``[rig]`` of a scene file, and ``--rig``. docs/cages.md shows the keys."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import model_validator

from dataset_builder.scene.model import to_metres
from dataset_builder.specs.config_specs import STEREO_CAMERAS, RigSpec, focal_of_view_px
from rebar_depth_bench.base.errors import CalibrationError, InputError, Problem
from rebar_depth_bench.base.limits import TOML_BYTES
from rebar_depth_bench.base.reading import parse_toml, read_file
from rebar_depth_bench.base.validation import (
    UNITS_M,
    StrictModel,
    field_error,
    number,
    one_of,
    validate_table,
    whole_number,
)
from rebar_depth_bench.captures.calibration import (
    BASELINE_M,
    FOCAL_PX,
    SIDES_PX,
    Lens,
    StereoCalibration,
    principal_point,
)
from rebar_depth_bench.captures.calibration_files import own_calibration
from rebar_depth_bench.captures.camera_files import cameras_of_table
from rebar_depth_bench.captures.documents import DOCUMENT_SUFFIXES
from rebar_depth_bench.captures.programs import ROUNDED_PX

_FORMS = (
    "exactly one of camera; calibration, with unit, grid, width and height if wanted; or the numbers width, "
    "height, baseline, and horizontal_fov_deg or fx, with unit, cx and cy if wanted"
)
_Side = Annotated[int, whole_number(SIDES_PX[0], SIDES_PX[-1])]


class RigTable(StrictModel):
    """Table of a rig: one of the ``_FORMS``. ``cameras_of_table`` checks the names of files and their content."""

    camera: Annotated[str, one_of(*STEREO_CAMERAS)] | None = None
    calibration: Any = None
    unit: Annotated[str, one_of(*UNITS_M)] | None = None
    grid: Annotated[str, one_of("rectified", "raw")] = "rectified"
    width: _Side | None = None
    height: _Side | None = None
    baseline: Annotated[float, number(0)] | None = None
    horizontal_fov_deg: Annotated[float, number(1, 175)] | None = None
    fx: Annotated[float, FOCAL_PX] | None = None
    cx: float | None = None
    cy: float | None = None

    @model_validator(mode="after")
    def _check_form(self) -> Self:
        given, size = self.model_fields_set, {"width", "height"}
        is_calibration = {"calibration"} <= given <= {"calibration", "unit", "grid", *size}
        is_calibration &= len(given & size) != 1
        is_numbers = {"baseline", *size} <= given and given.isdisjoint({"camera", "calibration", "grid"})
        is_numbers &= len(given & {"horizontal_fov_deg", "fx"}) == 1
        if not (given == {"camera"} or is_calibration or is_numbers):
            raise field_error(f"found {', '.join(sorted(given)) or 'no keys'}", _FORMS, "conflict")
        files = self.calibration if isinstance(self.calibration, list) else [self.calibration]
        if self.unit and any(str(name).lower().endswith((".toml", ".conf")) for name in files):
            found = f"unit is given with {', '.join(map(str, files))}"
            raise field_error(found, "no unit: .toml is in metres, .conf in millimetres", "conflict")
        for key, centre_px, side_px in (("cx", self.cx, self.width), ("cy", self.cy, self.height)):
            if centre_px is not None and not (centre := principal_point(side_px or 0)).accept(centre_px):
                raise field_error(f"{key} is {centre_px:g}", centre.text)
        return self

    def rig(self, path: Path, unit_m: float, where: str = "") -> RigSpec:
        """Return the rig that a file ``path`` of unit ``unit_m`` states in its table ``where``.

        Calibrations are beside the file. On the grid ``rectified``, those without matrices P are rectified by
        ``rig_cameras``. Raises ``CalibrationError``.
        """
        if self.camera is not None:
            return STEREO_CAMERAS[self.camera]
        if self.baseline is not None and self.width is not None and self.height is not None:
            baseline_m = to_metres(self.baseline, UNITS_M[self.unit] if self.unit else unit_m)
            if not BASELINE_M.accept(baseline_m):
                place = f"{where}.baseline" if where else "baseline"
                problem = Problem("invalid", place, f"is {baseline_m:g} m", BASELINE_M.text)
                raise CalibrationError.from_problems(path, [problem])
            fx = self.fx or focal_of_view_px(self.horizontal_fov_deg or 0, self.width)
            cx = (self.width - 1) / 2 if self.cx is None else self.cx
            cy = (self.height - 1) / 2 if self.cy is None else self.cy
            lens = Lens(fx, fx, cx, cy, (0.0, 0.0, 0.0, 0.0, 0.0))
            offset_m = (-baseline_m, 0.0, 0.0)
            pair = StereoCalibration(self.width, self.height, lens, lens, (0.0, 0.0, 0.0), offset_m)
            return RigSpec(self.width, self.height, baseline_m, pair, "ideal")
        has_P = self.grid == "rectified"
        try:
            pair = self._read_pair(path, where, rectified=has_P)
        except CalibrationError as error:
            if not has_P or any(problem.code != "missing" for problem in error.problems):
                raise
            has_P, pair = False, self._read_pair(path, where, rectified=False)
        if has_P:
            left, right = pair.left, pair.right
            difference_px = max(abs(left.fx - right.fx), abs(left.fy - right.fy), abs(left.cy - right.cy))
            if difference_px > ROUNDED_PX:
                found = f"fx, fy or cy of the two matrices P differ by {difference_px:.4g} pixels"
                problem = Problem("conflict", where, found, "those of a rectified pair, which are equal")
                raise CalibrationError.from_problems(path, [problem])
            pair = replace(pair, right=replace(right, fx=left.fx, fy=left.fy, cy=left.cy))
        return RigSpec(pair.width, pair.height, pair.baseline_m, pair, self.grid)

    def _read_pair(self, path: Path, where: str, *, rectified: bool) -> StereoCalibration:
        document = {"calibration": self.calibration, "unit": self.unit or "m", "rectified": rectified}
        cameras = cameras_of_table(path, document, (), self.width, self.height, is_stereo=True, where=where)
        assert isinstance(cameras.calibration, StereoCalibration)
        return cameras.calibration


def read_rig(name: str, width: int | None = None, height: int | None = None) -> RigSpec:
    """Return the rig of a named camera, of a calibration file, or of a TOML file with the keys of ``[rig]``.

    The unit of a TOML file is the metre, unless it states another. Of a ``.conf`` file, the sections nearest to
    ``width`` x ``height`` are read; the rig is not scaled to that size. Raises ``InputError`` for a name of
    neither a camera nor such a file, and for a file that cannot be read.
    """
    path, problems = Path(name), list[Problem]()
    suffix, values = path.suffix.lower(), dict[str, Any](calibration=path.name)
    if name in STEREO_CAMERAS:
        values = {"camera": name}
    elif suffix == ".toml":
        document, problems = parse_toml(read_file(path, TOML_BYTES, "a TOML file of a rig", InputError))
        if document.keys().isdisjoint(("left", "right", "stereo")):  # Tables of calibration.toml.
            values = document
    elif suffix == ".conf":
        pair = own_calibration(path, width, height, is_stereo=True, is_scaled=False)
        assert isinstance(pair, StereoCalibration)
        return RigSpec(pair.width, pair.height, pair.baseline_m, pair, "rectified")
    elif suffix not in DOCUMENT_SUFFIXES:
        cameras = ", ".join(STEREO_CAMERAS)
        raise InputError(
            f"--rig {name!r}: no such camera, expected one of {cameras}, or a calibration or TOML file"
        )
    table = None if problems else validate_table(RigTable, values, problems)
    if table is None:
        raise InputError.from_problems(path, problems)
    return table.rig(path, 1.0)
