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
    range = 255                     # black is 0 and white is 1 or 255, before mean and std
    mean = [123.675, 116.28, 103.53]  # optional (default: 0), in units of range
    std = [58.395, 57.12, 57.375]     # optional (default: 1)

    [output]                        # one map over the field of view of the input, of any size
    meaning = "canonical-depth"     # or depth, inverse-depth, canonical-inverse-depth; of relative networks
                                    # scale, affine-depth, affine-disparity
    focal_canonical_px = 1000       # only for canonical meanings
    scale = 1.0                     # optional: factor applied to the value first (0.001: millimetres)
    name = "predicted_depth"        # required if the model has several outputs
"""

from __future__ import annotations

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
    "depth": OutputMeaning("planar depth, metres"),
    "inverse-depth": OutputMeaning("one over planar depth, 1/metres", True),
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

_Side = Annotated[int, whole_number(1, 8192)]
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
    range: Annotated[int, one_of(1, 255)]
    mean: Annotated[Triple, _COLOUR] = (0.0, 0.0, 0.0)
    std: Annotated[Triple, _COLOUR] = (1.0, 1.0, 1.0)

    @field_validator("longest_side")
    @classmethod
    def _check_size(cls, longest_px: int | None, info: ValidationInfo) -> int | None:
        sides = {key: info.data.get(key) for key in ("width", "height", "multiple_of")}
        given = [key for key, value in {**sides, "longest_side": longest_px}.items() if value is not None]
        allowed = (["width", "height"], ["longest_side"], ["multiple_of", "longest_side"])
        if given not in allowed and info.data.keys() >= sides.keys():  # A side that is missing there is invalid.
            found = f"got {' and '.join(given)}" if given else "missing"
            raise field_error(found, "width and height, or longest_side", "conflict" if given[1:] else "missing")
        if longest_px is not None and longest_px % (multiple_px := sides["multiple_of"] or 1):
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

    ``scale`` is in metres per unit of an output of the meaning depth.
    """

    meaning: Annotated[str, one_of(*OUTPUT_MEANINGS)]
    focal_canonical_px: Annotated[float, _FOCAL_PX] | None = Field(default=None, validate_default=True)
    scale: Annotated[float, number(0)] = 1.0
    name: Annotated[str, text(500)] | None = None

    @field_validator("focal_canonical_px")
    @classmethod
    def _check_focal(cls, focal_px: float | None, info: ValidationInfo) -> float | None:
        meaning = info.data.get("meaning")
        if meaning is not None and OUTPUT_MEANINGS[meaning].canonical != (focal_px is not None):
            if focal_px is None:
                raise field_error("missing", f'{_FOCAL_PX.text} for meaning "{meaning}"', "missing")
            raise field_error(f"got {focal_px:g}", f'none: meaning "{meaning}" does not use it', "conflict")
        return focal_px


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
        try:
            if path.is_file():
                return str(path)
        except OSError:  # The name is too long for the file system.
            pass
        raise field_error(f"no such file: {path}", "the ONNX file", "missing")


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
