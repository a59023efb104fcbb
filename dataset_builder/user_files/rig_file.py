"""Stereo rigs of one's own: the table ``[rig]`` of a scene file, and ``--rig``. docs/cages.md shows the keys."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Self, cast

from pydantic import model_validator

from dataset_builder.specs.config_specs import STEREO_CAMERAS, RigSpec, focal_of_view_px
from rebar_depth_bench.base.errors import CalibrationError, InputError, Problem
from rebar_depth_bench.base.limits import TOML_BYTES
from rebar_depth_bench.base.reading import parse_toml, read_file
from rebar_depth_bench.base.validation import UNITS_M, StrictModel, field_error, number, one_of, validate_table
from rebar_depth_bench.captures.calibration import FOCAL_PX, StereoCalibration, principal_point
from rebar_depth_bench.captures.camera_files import cameras_of_table
from rebar_depth_bench.captures.documents import DOCUMENT_SUFFIXES

_FORMS = (
    "exactly one of camera; calibration, with unit, grid, width and height if wanted; or the numbers width, "
    "height, baseline, and horizontal_fov_deg or fx, with unit, cx and cy if wanted"
)
_CALIBRATION_TABLES = frozenset({"left", "right", "stereo"})
"""Keys of ``calibration.toml``, none of which a rig has."""


class RigTable(StrictModel):
    """Table of a rig: one of the ``_FORMS``. ``captures`` checks the numbers and the names of files."""

    camera: Annotated[str, one_of(*STEREO_CAMERAS)] | None = None
    calibration: Any = None
    unit: Annotated[str, one_of(*UNITS_M)] | None = None
    grid: Annotated[str, one_of("rectified", "raw")] = "rectified"
    width: int | None = None
    height: int | None = None
    baseline: float | None = None
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
        for key, centre_px, side_px in (("cx", self.cx, self.width), ("cy", self.cy, self.height)):
            if centre_px is not None and not (expected := principal_point(side_px or 0)).accept(centre_px):
                raise field_error(f"{key} is {centre_px:g}", expected.text)
        return self

    def rig(self, path: Path, unit_m: float, where: str = "") -> RigSpec:
        """Return the rig that a file ``path`` of unit ``unit_m`` states in its table ``where``.

        Calibrations are beside the file. Raises ``CalibrationError``.
        """
        if self.camera is not None:
            return STEREO_CAMERAS[self.camera]
        document: dict[str, Any] = {"calibration": self.calibration, "unit": self.unit or "m", "rectified": False}
        if self.baseline is not None and self.width is not None and self.height is not None:
            fx = self.fx or focal_of_view_px(self.horizontal_fov_deg or 0, self.width)
            cx = (self.width - 1) / 2 if self.cx is None else self.cx
            cy = (self.height - 1) / 2 if self.cy is None else self.cy
            lens = {"fx": fx, "fy": fx, "cx": cx, "cy": cy, "distortion": [0.0] * 4}
            baseline_m = round(self.baseline * (UNITS_M[self.unit] if self.unit else unit_m), 12)
            document = {"left": lens, "right": lens, "stereo": {"rotation": [0.0] * 3, "baseline_m": baseline_m}}
        elif self.grid == "rectified":
            with suppress(CalibrationError):  # Not every file has the matrices P of a rectified pair.
                return self._spec(path, {**document, "rectified": True}, where)
        return self._spec(path, document, where)

    def _spec(self, path: Path, document: dict[str, Any], where: str) -> RigSpec:
        """Return the rig of a table with the keys of ``cameras.toml``."""
        cameras = cameras_of_table(path, document, (), self.width, self.height, is_stereo=True, where=where)
        pair = cast(StereoCalibration, cameras.calibration)
        return RigSpec(pair.width, pair.height, pair.baseline_m, pair, "ideal" if self.baseline else self.grid)


def read_rig(name: str) -> RigSpec:
    """Return the rig of a named camera, of a calibration file, or of a TOML file with the keys of ``[rig]``.

    The unit of a TOML file is the metre, unless it states another. Raises ``InputError`` for a name of neither a
    camera nor such a file, and for a file that cannot be read.
    """
    path, problems = Path(name), list[Problem]()
    values: dict[str, Any] = {"calibration": path.name}
    if name in STEREO_CAMERAS:
        values = {"camera": name}
    elif path.suffix.lower() == ".toml":
        document, problems = parse_toml(read_file(path, TOML_BYTES, "a rig", InputError))
        values = document if _CALIBRATION_TABLES.isdisjoint(document) else values
    elif path.suffix.lower() not in (".conf", *DOCUMENT_SUFFIXES):
        cameras = ", ".join(STEREO_CAMERAS)
        raise InputError(f"--rig {name}: no such camera, expected one of {cameras}, or a calibration or TOML file")
    table = None if problems else validate_table(RigTable, values, problems)
    if table is None:
        raise InputError.from_problems(path, problems)
    return table.rig(path, 1.0)
