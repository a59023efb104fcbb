"""Layout file: a TOML file that describes a set of images, depth maps, cameras and bars of another program.

```toml
description = "Column mock-up, scanned with a terrestrial laser scanner"
source = "https://example.org/mock-up"
licence = "CC-BY-4.0"
truth_sigma_m = 0.002             # standard deviation of the depth, metres; required

[files]                           # below this file's folder; {view} stands for the name of a view
left_depth = "depth/{view}.exr"   # .exr, .tif, .png (16 bit), .npy, .npz, .pfm; required; and right_depth
left_rgb = "left/{view}.jpg"      # .png, .jpg; and right_rgb
left_mask = "masks/{view}.png"    # .png, .tif, .npy; and right_mask
left_bars = "ids/{view}.png"      # bar ids, 0 where no steel; and right_bars

[depth]
unit = "mm"                       # "m" (default), "cm", "mm", "in" or "ft"; or scale = 0.001, metres of one unit
kind = "z"                        # along the optical axis, the default; "range" along the ray; "disparity", pixels
invalid = [65535]                 # values without depth, beside those that are not finite or not above 0
max_m = 20                        # farther pixels are left out, and counted; without it, 1000 m is an error
channel = "R"                     # of EXR files with several channels

[cameras]                         # the keys of cameras.toml
calibration = "camera.yml"        # or views = "FILE", with the cameras of all views

[poses]                           # of the left camera; or [[cameras.pose]]
file = "poses/{view}.txt"         # 4 x 4 or 3 x 4 numbers: .txt, .npy, .json
key = "pose"                      # of JSON files; "a.b" is the key b in a
kind = "world_from_cam"           # or "cam_from_world", the default
axes = "opengl"                   # or "opencv", the default
unit = "m"

[intrinsics]                      # K of images of one camera, where it differs between views
file = "intrinsics/{view}.json"   # fx 0 cx, 0 fy cy, 0 0 1 in pixels; the distortion is that of [cameras]
key = "K"                         # of JSON files

[masks]
values = [255]                    # steel; default: all but 0

[bars]
file = "bars.csv"                 # surveyed bars: bar_id, diameter_m, x_m, y_m, z_m, and role if wanted
```
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import Strict, model_validator

from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.base.limits import TOML_BYTES
from rebar_depth_bench.base.reading import is_below, parse_toml, read_file
from rebar_depth_bench.base.validation import (
    UNITS_M,
    Expected,
    StrictModel,
    field_error,
    number,
    one_of,
    short_repr,
    text,
    validate_table,
    whole_number,
)

VIEW = "{view}"
_MAX_SIDE_PX = 16384
_MAX_DEPTH_M = 10_000.0


def _is_pattern(name: str) -> bool:
    return name.count(VIEW) == 1 and not set(name.replace(VIEW, "")) & set("{}*?[]") and is_below(name)


_Pattern = Annotated[str, Expected(f"a name in or below the layout's folder with one {VIEW}", _is_pattern)]
_File = Annotated[str, Expected("the name of a file in or below the layout's folder", is_below)]
_Unit = Annotated[str, one_of(*UNITS_M)]
_Values = Annotated[tuple[float, ...], Strict(False)]


class FilesTable(StrictModel):
    """Names of the files of each view, by column."""

    left_depth: _Pattern
    left_rgb: _Pattern | None = None
    right_rgb: _Pattern | None = None
    right_depth: _Pattern | None = None
    left_mask: _Pattern | None = None
    right_mask: _Pattern | None = None
    left_bars: _Pattern | None = None
    right_bars: _Pattern | None = None

    @property
    def patterns(self) -> dict[str, str]:
        """The patterns that are given, by column."""
        return {name: pattern for name, pattern in self if pattern is not None}

    @property
    def has_right(self) -> bool:
        """Whether there is a right camera."""
        return any(name.startswith("right_") for name in self.patterns)

    @model_validator(mode="after")
    def _check_eyes(self) -> FilesTable:
        if self.right_depth is None and (self.right_mask or self.right_bars):
            raise field_error("right_depth is missing", "right_depth beside right_mask and right_bars", "conflict")
        if self.right_rgb is not None and self.left_rgb is None:
            raise field_error("left_rgb is missing", "left_rgb beside right_rgb", "conflict")
        return self


class DepthTable(StrictModel):
    """How the values of depth maps are read."""

    unit: _Unit | None = None
    scale: Annotated[float, number(1e-9, 1e6)] | None = None
    kind: Annotated[str, one_of("z", "range", "disparity")] = "z"
    invalid: _Values = ()
    max_m: Annotated[float, number(0, _MAX_DEPTH_M)] | None = None
    channel: Annotated[str, text(100)] | None = None

    @model_validator(mode="after")
    def _check_unit(self) -> DepthTable:
        if self.unit is not None and self.scale is not None:
            raise field_error("got unit and scale", "one of them", "conflict")
        if self.unit is not None and self.kind == "disparity":
            raise field_error("got unit", "scale, pixels of one unit, for disparity", "conflict")
        return self

    @property
    def factor(self) -> float:
        """Metres (pixels of disparity) of one unit."""
        return UNITS_M[self.unit] if self.unit is not None else 1.0 if self.scale is None else self.scale


class MatricesTable(StrictModel):
    """Files with one matrix per view."""

    file: _Pattern
    key: Annotated[str, text(100)] | None = None


class PosesTable(MatricesTable):
    """Poses of the left camera."""

    kind: Annotated[str, one_of("cam_from_world", "world_from_cam")] = "cam_from_world"
    axes: Annotated[str, one_of("opencv", "opengl")] = "opencv"
    unit: _Unit = "m"


class MasksTable(StrictModel):
    """Values of masks that are steel; all but 0 if it is empty."""

    values: _Values = ()


class BarsTable(StrictModel):
    """Surveyed bars."""

    file: _File


class Layout(StrictModel):
    """Content of a layout file. ``width`` and ``height`` are required without images."""

    description: Annotated[str, text(1000)] = ""
    source: Annotated[str, text(1000)] = ""
    licence: Annotated[str, text(200)] = ""
    truth_sigma_m: Annotated[float, number(1e-9, 10, "the standard deviation of the depth, metres, above 0")]
    width: Annotated[int, whole_number(16, _MAX_SIDE_PX)] | None = None
    height: Annotated[int, whole_number(16, _MAX_SIDE_PX)] | None = None
    files: FilesTable
    cameras: dict[str, Any]
    depth: DepthTable = DepthTable()
    poses: PosesTable | None = None
    intrinsics: MatricesTable | None = None
    masks: MasksTable = MasksTable()
    bars: BarsTable | None = None

    @property
    def views(self) -> str | None:
        """Name of the file with the cameras of all views, or None."""
        return str(self.cameras["views"]) if "views" in self.cameras else None

    @model_validator(mode="after")
    def _check_sizes(self) -> Layout:
        if self.files.left_rgb is None and (self.width is None or self.height is None):
            raise field_error("width or height is missing", "both, or files.left_rgb", "missing")
        if self.poses is not None and "pose" in self.cameras:
            raise field_error("got poses and cameras.pose", "one of them", "conflict")
        tables = {"poses": self.poses, "intrinsics": self.intrinsics}
        shared = {"a right camera": self.files.has_right, "disparity": self.depth.kind == "disparity"}
        if self.views is not None:
            others = [f"cameras.{key}" for key in self.cameras if key != "views"]
            if others := [*others, *(name for name, given in {**tables, **shared}.items() if given)]:
                found = f"got cameras.views and {others[0]}"
                raise field_error(found, "cameras.views alone, for one camera", "conflict")
            if not isinstance(self.cameras["views"], str) or not is_below(self.views):
                found = f"cameras.views is {short_repr(self.cameras['views'])}"
                raise field_error(found, "the name of a file in or below the layout's folder")
        if self.bars is not None and self.poses is None and not {"pose", "views"} & set(self.cameras):
            raise field_error("got bars without poses", "poses in the frame of the bars", "conflict")
        if self.intrinsics is not None and any(shared.values()):
            other = next(name for name, is_given in shared.items() if is_given)
            raise field_error(f"got intrinsics of each view and {other}", "one calibration", "conflict")
        return self


def read_layout(path: Path) -> Layout:
    """Read a layout file. Raises ``InputError`` with all problems, which name keys."""
    content = read_file(path, TOML_BYTES, "a layout of data to import", InputError)
    values, problems = parse_toml(content)
    layout = None if problems else validate_table(Layout, values, problems)
    if layout is None:
        raise InputError.from_problems(path, problems)
    return layout
