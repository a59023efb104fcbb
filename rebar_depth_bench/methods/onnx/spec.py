"""TOML description of an ONNX depth model: its input pre-processing and the meaning of its output.

::

    model = "model.onnx"            # relative to this file; external data must be in the folder of the model
    licence = "BSD-2-Clause"        # licence of the weights; required
    name = "my-model"               # optional (default: name of this file), as are summary and source

    [input]                         # 1 x 3 x H x W, RGB
    width = 1064                    # either width and height,
    height = 616
    # longest_side = 518            # or these two: the other side is the nearest multiple that keeps the ratio
    # multiple_of = 14
    resize = "pad"                  # keep the aspect ratio, centre, pad with the mean; or "stretch"
    interpolation = "bilinear"      # optional; or "bicubic"
    range = 255                     # black is 0 and white is 1 or 255, before mean and std
    mean = [123.675, 116.28, 103.53]  # optional (default: 0), in units of range
    std = [58.395, 57.12, 57.375]     # optional (default: 1)

    [output]
    meaning = "canonical-depth"     # or depth, inverse-depth, canonical-inverse-depth; of relative networks
                                    # scale, affine-depth, affine-disparity
    focal_canonical_px = 1000       # only for canonical meanings
    scale = 1.0                     # optional: factor applied to the value first (0.001: millimetres)
    min_m = 0.1                     # optional, as is max_m: depth outside becomes NaN (no prediction)
    max_m = 300
    name = "predicted_depth"        # or index = 0; required if the model has several outputs
    at_input_size = true            # optional; false: another grid over the same field of view
    resize = "nearest"              # optional; or "bilinear", which interpolates across the edges of bars
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field, ValidationInfo, field_validator

from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.base.limits import TOML_BYTES
from rebar_depth_bench.base.reading import parse_toml, read_file
from rebar_depth_bench.base.validation import (
    Expected,
    Flag,
    StrictModel,
    Triple,
    field_error,
    number,
    one_of,
    short_repr,
    text,
    three_numbers,
    validate_table,
    whole_number,
)
from rebar_depth_bench.submission.declaration import MAX_METHOD_CHARACTERS, METRIC

MAX_SIDE_PX = 8192


@dataclass(frozen=True)
class OutputMeaning:
    """Meaning of an output value.

    Depth is the value, or one over it if ``inverse``; if ``canonical``, it is multiplied by a factor of the focal
    length. ``description`` is the text shown to users. ``prediction`` is the kind of the predictions; those that
    are not metric are the values as they are.
    """

    description: str
    inverse: bool = False
    canonical: bool = False
    prediction: str = METRIC


OUTPUT_MEANINGS: Mapping[str, OutputMeaning] = {
    "depth": OutputMeaning("planar depth, metres", False, False),
    "inverse-depth": OutputMeaning("one over planar depth, 1/metres", True, False),
    "canonical-depth": OutputMeaning("depth as a camera of the canonical focal length would see it", False, True),
    "canonical-inverse-depth": OutputMeaning("one over that depth", True, True),
    "scale": OutputMeaning("planar depth up to a scale", prediction="scale"),
    "affine-depth": OutputMeaning("planar depth up to scale and shift", prediction="affine-depth"),
    "affine-disparity": OutputMeaning("disparity up to scale and shift", prediction="affine-disparity"),
}
"""Output meanings by their name in the TOML file.

Canonical values are converted to metres by the factor fx at the model input / canonical focal length, as in
Metric3D (Yin et al., ICCV 2023, label transform). Depth Pro's canonical inverse depth is "canonical-inverse-depth"
with a canonical focal length equal to its input width: in 1/z = C W / f, W and f belong to the same image.
"""


_Side = Annotated[int, whole_number(1, MAX_SIDE_PX)]
_SIZE_KEYS = ("width", "height", "longest_side", "multiple_of")
_Positive = Annotated[float, number(0)]
_FOCAL_PX = number(1, 100_000)
_COLOUR = Expected("three numbers: red, green, blue")


class InputSpec(StrictModel):  # Order matters: validators read the fields above theirs.
    """Conversion of an image to the model input: the table ``[input]``.

    Sides are in pixels. ``range`` is the value of white before normalisation, also the unit of ``mean``
    and ``std``.
    """

    width: _Side | None = None
    height: _Side | None = None
    multiple_of: _Side | None = None
    longest_side: _Side | None = Field(default=None, validate_default=True)
    resize: Annotated[str, one_of("stretch", "pad")]
    interpolation: Annotated[str, one_of("bilinear", "bicubic")] = "bilinear"
    range: Annotated[int, one_of(1, 255)]
    mean: Annotated[Triple, _COLOUR] = (0.0, 0.0, 0.0)
    std: Annotated[Triple, _COLOUR] = (1.0, 1.0, 1.0)

    @property
    def size_px(self) -> tuple[int, int] | None:
        """Fixed size (width, height), or None if the size follows from ``longest_side`` and ``multiple_of``."""
        return None if self.width is None or self.height is None else (self.width, self.height)

    @field_validator("longest_side")
    @classmethod
    def _check_size(cls, longest_px: int | None, info: ValidationInfo) -> int | None:
        values = {**info.data, "longest_side": longest_px}
        given = [key for key in _SIZE_KEYS if values.get(key) is not None]
        all_valid = values.keys() >= set(_SIZE_KEYS)
        if all_valid and given not in (["width", "height"], ["longest_side"], ["longest_side", "multiple_of"]):
            found = f"got {' and '.join(given)}" if given else "missing"
            raise field_error(found, "width and height, or longest_side", "conflict" if given[1:] else "missing")
        if longest_px is not None and longest_px % (multiple_px := values.get("multiple_of") or 1):
            raise field_error(f"got {longest_px}", f"a multiple of multiple_of, {multiple_px}")
        return longest_px

    @field_validator("mean", "std")
    @classmethod
    def _check_colour(cls, values: Triple, info: ValidationInfo) -> Triple:
        """Check the bounds, which catch values given for the other range, a common mistake."""
        white = info.data.get("range")
        bounds = three_numbers((white or 1) / 255 if info.field_name == "std" else 0, white or 255)
        if not bounds.accept(values):
            raise field_error(f"got {short_repr(list(values))}", bounds.text)
        return values


class OutputSpec(StrictModel):  # Order matters: validators read the fields above theirs.
    """Conversion of the model output to depth: the table ``[output]``.

    ``scale`` is in metres per unit of a non-canonical output, ``min_m`` and ``max_m`` are in metres.
    """

    meaning: Annotated[str, one_of(*OUTPUT_MEANINGS)]
    focal_canonical_px: Annotated[float, _FOCAL_PX] | None = Field(default=None, validate_default=True)
    scale: _Positive = 1.0
    max_m: _Positive = math.inf
    min_m: _Positive = 0.0
    name: Annotated[str, text(500)] | None = None
    index: Annotated[int, whole_number(0, 999)] | None = None
    at_input_size: Flag = True
    resize: Annotated[str, one_of("nearest", "bilinear")] = "nearest"

    @field_validator("focal_canonical_px")
    @classmethod
    def _check_focal(cls, focal_px: float | None, info: ValidationInfo) -> float | None:
        meaning = info.data.get("meaning")
        if meaning is not None and OUTPUT_MEANINGS[meaning].canonical != (focal_px is not None):
            if focal_px is None:
                raise field_error("missing", f'{_FOCAL_PX.text} for meaning "{meaning}"', "missing")
            raise field_error(f"got {focal_px:g}", f'none: meaning "{meaning}" does not use it', "conflict")
        return focal_px

    @field_validator("min_m")
    @classmethod
    def _check_min_m(cls, min_m: float, info: ValidationInfo) -> float:
        if min_m >= (max_m := info.data.get("max_m", math.inf)):
            raise field_error(f"got {min_m:g}", f"less than max_m, {max_m:g}", "conflict")
        return min_m

    @field_validator("min_m", "max_m")
    @classmethod
    def _check_metric(cls, limit_m: float, info: ValidationInfo) -> float:
        meaning = info.data.get("meaning")
        if meaning is not None and OUTPUT_MEANINGS[meaning].prediction != METRIC:
            raise field_error(f"got {limit_m:g}", f'none: meaning "{meaning}" has no metres', "conflict")
        return limit_m

    @field_validator("index")
    @classmethod
    def _check_index(cls, index: int | None, info: ValidationInfo) -> int | None:
        if info.data.get("name") is not None:
            raise field_error("got name and index", "one of them", "conflict")
        return index


class OnnxSpec(StrictModel):
    """TOML file of an ONNX method; ``name`` is by default the file's, ``model`` the path of the ONNX file."""

    model: Annotated[str, text(1000, "the ONNX file's path, relative to this file")]
    name: Annotated[str, text(MAX_METHOD_CHARACTERS)] = ""
    summary: Annotated[str, text(500)] = ""
    source: Annotated[str, text(500)] = ""
    licence: Annotated[str, text(200, "the licence of the model's weights")]
    input: InputSpec
    output: OutputSpec

    @field_validator("model")
    @classmethod
    def _find_model(cls, name: str, info: ValidationInfo[Path]) -> str:
        """Return the path of the ONNX file; ``info.context`` is the folder of the TOML file."""
        path = info.context / name
        if not is_file(path):
            raise field_error(f"no such file: {path}", "the ONNX file", "missing")
        return str(path)


def read_onnx_toml(path: Path) -> OnnxSpec:
    """Return the parsed TOML file of an ONNX method; the module docstring shows all keys.

    Raises ``MethodError`` listing all problems if the file cannot be read or is not TOML, if keys are missing,
    unknown or invalid, or if the model file does not exist.
    """
    expected = "a TOML file that describes an ONNX model"
    values, problems = parse_toml(read_file(path, TOML_BYTES, expected, MethodError))
    spec = None if problems else validate_table(OnnxSpec, {"name": path.stem, **values}, problems, "", path.parent)
    if spec is None:
        raise MethodError.from_problems(path, problems)
    return spec


def is_file(path: Path) -> bool:
    """Return whether ``path`` is a regular file or a link to one."""
    try:
        return path.is_file()
    except OSError:  # The name is too long for the file system.
        return False
