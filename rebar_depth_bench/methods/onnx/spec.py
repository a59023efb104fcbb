"""The short TOML file that tells how an ONNX depth model is fed and what its answer means.

::

    model = "model.onnx"            # relative to this file; its external data beside it
    licence = "BSD-2-Clause"        # of the weights; required: nobody runs a model without saying it
    name = "my-model"               # optional (this file's name), as are summary and source

    [input]                         # 1 x 3 x H x W, RGB
    width = 1064                    # either both of these,
    height = 616
    # longest_side = 518            # or these: the other side is the nearest multiple that keeps the ratio
    # multiple_of = 14
    resize = "pad"                  # keep the ratio, centre, pad with the mean; or "stretch"
    interpolation = "bilinear"      # optional; or "bicubic"
    range = 255                     # black is 0 and white is 1 or 255, before mean and std
    mean = [123.675, 116.28, 103.53]  # optional (0), in units of range
    std = [58.395, 57.12, 57.375]     # optional (1)

    [output]
    meaning = "canonical-depth"     # see MEANINGS
    focal_canonical_px = 1000       # only of the canonical ones
    scale = 1.0                     # optional: the value is multiplied by it first (0.001: millimetres)
    min_m = 0.1                     # optional, as is max_m: depth outside becomes no answer
    max_m = 300
    name = "predicted_depth"        # or index = 0; needed where the model has several outputs
    at_input_size = true            # optional; false: another grid over the same field of view
    resize = "nearest"              # optional; or "bilinear", which invents depth between a bar and its background
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
    Keys,
    choice,
    number,
    text,
    three_numbers,
    whole_number,
    words,
)

MAX_SIDE_PX = 8192
MAX_BYTES = 1 << 20


@dataclass(frozen=True)
class Meaning:
    """What an output value is, in words; depth is the value or its inverse, times a factor of the focal length."""

    words: str
    inverse: bool
    canonical: bool


MEANINGS: Mapping[str, Meaning] = {
    "depth": Meaning("planar depth, metres", False, False),
    "inverse-depth": Meaning("one over planar depth, 1/metres", True, False),
    "canonical-depth": Meaning("depth as a camera of the canonical focal length would see it", False, True),
    "canonical-inverse-depth": Meaning("one over that depth", True, True),
}
"""The canonical ones are turned into metres by fx at the model's input over the canonical focal length, as in
Metric3D (Yin et al., ICCV 2023, label transform). Depth Pro's canonical inverse depth is "canonical-inverse-depth"
with a canonical focal length of its input's width: its 1/z = C W / f has W and f of one and the same picture."""


@dataclass(frozen=True)
class InputSpec:
    """How a picture becomes the model's input. ``size_px`` is (width, height), or None with ``longest_px``."""

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
    """What the answer means; ``focal_canonical_px`` is NaN where the meaning is not canonical."""

    meaning: Meaning
    focal_canonical_px: float
    scale: float
    min_m: float
    max_m: float
    which: str | int | None
    at_input_size: bool
    bilinear: bool


@dataclass(frozen=True)
class OnnxSpec:
    """An ONNX method's TOML file, read."""

    model: Path
    name: str
    summary: str
    source: str
    licence: str
    input: InputSpec
    output: OutputSpec


def read_onnx_toml(path: Path) -> OnnxSpec:
    """Return what an ONNX method's TOML file says; the module's words show every key.

    Raises ``MethodError`` with every problem at once where it is no TOML, or any key is missing, unknown or wrong,
    and where there is no such model file.
    """
    problems: list[str] = []
    keys = Keys(_parsed(path), "", problems)
    keys.only(("model", "name", "summary", "source", "licence", "input", "output"))
    file = keys.required("model", text(1000, "the ONNX file's path, relative to this file"), "")
    name = keys.optional("name", text(MAX_METHOD_CHARACTERS), path.stem)
    summary = keys.optional("summary", text(500), "")
    source = keys.optional("source", text(500), "")
    licence = keys.required("licence", text(200, "the licence of the model's weights"), "")
    model_input = _input(_section(keys, "input"))
    output = _output(_section(keys, "output"))
    model = path.parent / file
    if file and not _is_file(model):
        problems.append(f"model: no such file: {model}, expected the ONNX file")
    if problems:
        raise MethodError(f"{path}: {problem_summary(problems)}")
    return OnnxSpec(model, name, summary, source, licence, model_input, output)


def _parsed(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as stream:
            content = stream.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise MethodError(f"{path}: no such file, expected a TOML file that describes an ONNX model") from None
    except (OSError, ValueError) as error:
        raise MethodError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if len(content) > MAX_BYTES:
        raise MethodError(f"{path}: is larger than {MAX_BYTES} bytes, expected a short TOML file")
    try:
        return tomllib.loads(content.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise MethodError(f"{path}: byte {error.start} is no UTF-8 text, expected a TOML file") from None
    except (ValueError, RecursionError) as error:
        raise MethodError(f"{path}: is no TOML file: {error}") from None


def _section(keys: Keys, name: str) -> Keys:
    """Return a table of the file; one that is missing or none is one problem, not one for each of its keys."""
    found = keys.required(name, TABLE, None)
    return Keys({}, "", []) if found is None else Keys(found, f"[{name}] ", keys.problems)


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name longer than any file's
        return False


_SIDE = whole_number(1, MAX_SIDE_PX)
_SIZE_KEYS = ("width", "height")
_LONGEST_KEYS = ("longest_side", "multiple_of")


def _input(keys: Keys) -> InputSpec:
    keys.only((*_SIZE_KEYS, *_LONGEST_KEYS, "resize", "interpolation", "range", "mean", "std"))
    size_px, longest_px, multiple_px = _size(keys)
    white = keys.required("range", choice({1: "1", 255: "255"}), 0)
    # The other one's mean and std are the usual slip: far outside of what this range allows.
    mean = keys.optional("mean", three_numbers(0, white or 255), (0.0, 0.0, 0.0))
    std = keys.optional("std", three_numbers((white or 1) / 255, white or 255), (1.0, 1.0, 1.0))
    return InputSpec(
        size_px=size_px,
        longest_px=longest_px,
        multiple_px=multiple_px,
        pad=keys.required("resize", words("stretch", "pad"), "") == "pad",
        bicubic=keys.optional("interpolation", words("bilinear", "bicubic"), "bilinear") == "bicubic",
        white=white,
        mean=mean,
        std=std,
    )


def _size(keys: Keys) -> tuple[tuple[int, int] | None, int, int]:
    """Return the input's size or None, its longest side, and what its sides are multiples of; pixels."""
    fixed = [key for key in _SIZE_KEYS if key in keys.values]
    longest = [key for key in _LONGEST_KEYS if key in keys.values]
    if bool(fixed) == bool(longest):
        found = "both" if fixed else "neither"
        keys.problems.append(f"{keys.where}size: got {found}, expected width and height, or longest_side")
        return None, 1, 1
    if fixed:
        width, height = (keys.required(key, _SIDE, 1) for key in _SIZE_KEYS)
        return (width, height), max(width, height), 1
    multiple_px = keys.optional("multiple_of", _SIDE, 1)
    longest_px = keys.required("longest_side", _SIDE, multiple_px)
    if longest_px % multiple_px:
        keys.problems.append(
            f"{keys.where}longest_side: got {longest_px}, expected a multiple of multiple_of, {multiple_px}"
        )
    return None, longest_px, multiple_px


def _output(keys: Keys) -> OutputSpec:
    known = ("meaning", "focal_canonical_px", "scale", "min_m", "max_m", "name", "index")
    keys.only((*known, "at_input_size", "resize"))
    name = keys.required("meaning", words(*MEANINGS), "")
    min_m = keys.optional("min_m", POSITIVE, 0.0)
    max_m = keys.optional("max_m", POSITIVE, math.inf)
    if min_m >= max_m:
        keys.problems.append(f"{keys.where}min_m: got {min_m:g}, expected less than max_m, {max_m:g}")
    if "name" in keys.values and "index" in keys.values:
        keys.problems.append(f"{keys.where}has name and index, expected one of them")
    output_name = keys.optional("name", text(500), "")
    index = keys.optional("index", whole_number(0, 999), -1)
    return OutputSpec(
        meaning=MEANINGS.get(name, MEANINGS["depth"]),
        focal_canonical_px=_focal_canonical_px(keys, name),
        scale=keys.optional("scale", POSITIVE, 1.0),
        min_m=min_m,
        max_m=max_m,
        which=output_name or (None if index < 0 else index),
        at_input_size=keys.optional("at_input_size", FLAG, True),
        bilinear=keys.optional("resize", words("nearest", "bilinear"), "nearest") == "bilinear",
    )


def _focal_canonical_px(keys: Keys, meaning: str) -> float:
    key = "focal_canonical_px"
    if meaning not in MEANINGS:
        return math.nan
    if MEANINGS[meaning].canonical:
        return keys.required(key, number(1, 100_000), math.nan)
    if key in keys.values:
        keys.problems.append(f'{keys.where}{key}: got one with meaning "{meaning}", expected none: it is not used')
    return math.nan
