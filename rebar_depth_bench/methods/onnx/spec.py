"""TOML description of an ONNX depth model: its input pre-processing and the meaning of its output.

::

    model = "model.onnx"            # relative to this file; external data must be beside the model
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
    meaning = "canonical-depth"     # see OUTPUT_MEANINGS
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
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rebar_depth_bench.errors import MethodError, problem_summary
from rebar_depth_bench.submission.metadata import MAX_METHOD_CHARACTERS
from rebar_depth_bench.validation import (
    FLAG,
    POSITIVE,
    TABLE,
    TableReader,
    choice,
    number,
    one_of,
    text,
    three_numbers,
    whole_number,
)

MAX_SIDE_PX = 8192
MAX_TOML_BYTES = 1 << 20


@dataclass(frozen=True)
class OutputMeaning:
    """Meaning of an output value.

    Depth is the value, or one over it if ``inverse``; if ``canonical``, it is multiplied by a factor of the focal
    length. ``description`` is the text shown to users.
    """

    description: str
    inverse: bool
    canonical: bool


OUTPUT_MEANINGS: Mapping[str, OutputMeaning] = {
    "depth": OutputMeaning("planar depth, metres", False, False),
    "inverse-depth": OutputMeaning("one over planar depth, 1/metres", True, False),
    "canonical-depth": OutputMeaning("depth as a camera of the canonical focal length would see it", False, True),
    "canonical-inverse-depth": OutputMeaning("one over that depth", True, True),
}
"""Output meanings by their name in the TOML file.

Canonical values are converted to metres by the factor fx at the model input / canonical focal length, as in
Metric3D (Yin et al., ICCV 2023, label transform). Depth Pro's canonical inverse depth is "canonical-inverse-depth"
with a canonical focal length equal to its input width: in 1/z = C W / f, W and f belong to the same image.
"""


@dataclass(frozen=True)
class InputSpec:
    """Conversion of an image to the model input.

    ``size_px`` is (width, height), or None if the size follows from ``longest_px`` and ``multiple_px``. ``white``
    is the value of white before normalisation (1 or 255); ``mean`` and ``std`` are in the same unit.
    """

    size_px: tuple[int, int] | None
    longest_px: int
    multiple_px: int
    pad: bool
    bicubic: bool
    white: int
    mean: tuple[float, float, float]
    std: tuple[float, float, float]


@dataclass(frozen=True)
class OutputSpec:
    """Conversion of the model output to depth; ``focal_canonical_px`` is NaN if the meaning is not canonical.

    ``name_or_index`` selects the output; None: the only one.
    """

    meaning: OutputMeaning
    focal_canonical_px: float
    scale: float
    min_m: float
    max_m: float
    name_or_index: str | int | None
    at_input_size: bool
    bilinear: bool


@dataclass(frozen=True)
class OnnxSpec:
    """Parsed TOML file of an ONNX method."""

    model: Path
    name: str
    summary: str
    source: str
    licence: str
    input: InputSpec
    output: OutputSpec


def read_onnx_toml(path: Path) -> OnnxSpec:
    """Return the parsed TOML file of an ONNX method; the module docstring shows all keys.

    Raises ``MethodError`` listing all problems if the file is not TOML, if keys are missing, unknown or invalid,
    or if the model file does not exist.
    """
    problems: list[str] = []
    reader = TableReader(_parse_toml(path), "", problems)
    reader.reject_unknown(("model", "name", "summary", "source", "licence", "input", "output"))
    file = reader.required("model", text(1000, "the ONNX file's path, relative to this file"), "")
    name = reader.optional("name", text(MAX_METHOD_CHARACTERS), path.stem)
    summary = reader.optional("summary", text(500), "")
    source = reader.optional("source", text(500), "")
    licence = reader.required("licence", text(200, "the licence of the model's weights"), "")
    model_input = _read_input(_read_table(reader, "input"))
    output = _read_output(_read_table(reader, "output"))
    model = path.parent / file
    if file and not _is_file(model):
        problems.append(f"model: no such file: {model}, expected the ONNX file")
    if problems:
        raise MethodError(f"{path}: {problem_summary(problems)}")
    return OnnxSpec(model, name, summary, source, licence, model_input, output)


def _parse_toml(path: Path) -> dict[str, Any]:
    """Return the content of a TOML file. Raises ``MethodError`` if it cannot be read or parsed."""
    try:
        with path.open("rb") as stream:
            content = stream.read(MAX_TOML_BYTES + 1)
    except FileNotFoundError:
        raise MethodError(f"{path}: no such file, expected a TOML file that describes an ONNX model") from None
    except (OSError, ValueError) as error:
        raise MethodError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if len(content) > MAX_TOML_BYTES:
        raise MethodError(f"{path}: is larger than {MAX_TOML_BYTES} bytes, expected a smaller TOML file")
    try:
        return tomllib.loads(content.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise MethodError(f"{path}: byte {error.start} is not UTF-8 text, expected a TOML file") from None
    except (ValueError, RecursionError) as error:
        raise MethodError(f"{path}: is not a valid TOML file: {error}") from None


def _read_table(reader: TableReader, name: str) -> TableReader:
    """Return a table of the file; a missing or invalid table is one problem, not one for each of its keys."""
    table = reader.required(name, TABLE, None)
    return TableReader({}, "", []) if table is None else TableReader(table, f"[{name}] ", reader.problems)


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # The name is too long for the file system.
        return False


_SIDE_PX = whole_number(1, MAX_SIDE_PX)
_SIZE_KEYS = ("width", "height")
_LONGEST_KEYS = ("longest_side", "multiple_of")


def _read_input(reader: TableReader) -> InputSpec:
    reader.reject_unknown((*_SIZE_KEYS, *_LONGEST_KEYS, "resize", "interpolation", "range", "mean", "std"))
    size_px, longest_px, multiple_px = _read_size(reader)
    white = reader.required("range", choice({1: "1", 255: "255"}), 0)
    # The bounds catch mean and std given for the other range, a common mistake.
    mean = reader.optional("mean", three_numbers(0, white or 255), (0.0, 0.0, 0.0))
    std = reader.optional("std", three_numbers((white or 1) / 255, white or 255), (1.0, 1.0, 1.0))
    return InputSpec(
        size_px=size_px,
        longest_px=longest_px,
        multiple_px=multiple_px,
        pad=reader.required("resize", one_of("stretch", "pad"), "") == "pad",
        bicubic=reader.optional("interpolation", one_of("bilinear", "bicubic"), "bilinear") == "bicubic",
        white=white,
        mean=mean,
        std=std,
    )


def _read_size(reader: TableReader) -> tuple[tuple[int, int] | None, int, int]:
    """Return the fixed size (width, height) or None, the longest side, and the multiple of the sides; pixels."""
    fixed = [key for key in _SIZE_KEYS if key in reader.values]
    longest = [key for key in _LONGEST_KEYS if key in reader.values]
    if bool(fixed) == bool(longest):
        got = "both" if fixed else "neither"
        reader.problems.append(f"{reader.where}size: got {got}, expected width and height, or longest_side")
        return None, 1, 1
    if fixed:
        width, height = (reader.required(key, _SIDE_PX, 1) for key in _SIZE_KEYS)
        return (width, height), max(width, height), 1
    multiple_px = reader.optional("multiple_of", _SIDE_PX, 1)
    longest_px = reader.required("longest_side", _SIDE_PX, multiple_px)
    if longest_px % multiple_px:
        reader.problems.append(
            f"{reader.where}longest_side: got {longest_px}, expected a multiple of multiple_of, {multiple_px}"
        )
    return None, longest_px, multiple_px


def _read_output(reader: TableReader) -> OutputSpec:
    known = ("meaning", "focal_canonical_px", "scale", "min_m", "max_m", "name", "index")
    reader.reject_unknown((*known, "at_input_size", "resize"))
    name = reader.required("meaning", one_of(*OUTPUT_MEANINGS), "")
    min_m = reader.optional("min_m", POSITIVE, 0.0)
    max_m = reader.optional("max_m", POSITIVE, math.inf)
    if min_m >= max_m:
        reader.problems.append(f"{reader.where}min_m: got {min_m:g}, expected less than max_m, {max_m:g}")
    if "name" in reader.values and "index" in reader.values:
        reader.problems.append(f"{reader.where}has name and index, expected one of them")
    output_name = reader.optional("name", text(500), "")
    index = reader.optional("index", whole_number(0, 999), -1)
    return OutputSpec(
        meaning=OUTPUT_MEANINGS.get(name, OUTPUT_MEANINGS["depth"]),
        focal_canonical_px=_read_focal_canonical_px(reader, name),
        scale=reader.optional("scale", POSITIVE, 1.0),
        min_m=min_m,
        max_m=max_m,
        name_or_index=output_name or (None if index < 0 else index),
        at_input_size=reader.optional("at_input_size", FLAG, True),
        bilinear=reader.optional("resize", one_of("nearest", "bilinear"), "nearest") == "bilinear",
    )


def _read_focal_canonical_px(reader: TableReader, meaning: str) -> float:
    key = "focal_canonical_px"
    if meaning not in OUTPUT_MEANINGS:
        return math.nan
    if OUTPUT_MEANINGS[meaning].canonical:
        return reader.required(key, number(1, 100_000), math.nan)
    if key in reader.values:
        reader.problems.append(
            f'{reader.where}{key}: got a value, expected none: meaning "{meaning}" does not use it'
        )
    return math.nan
