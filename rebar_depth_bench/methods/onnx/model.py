"""Any ONNX depth model as a method, from a short TOML file (``onnx_toml`` shows its keys).

From a picture to a model's input and from its answer back to the picture's grid: where each pixel comes from.

Positions are continuous here: a side of n pixels runs from 0 to n, pixel i covers i to i + 1, its centre i + 0.5.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64, UInt8
from numpy import ndarray
from PIL import Image

from rebar_depth_bench.data.digests import files_digest
from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods.base import Method, MethodInfo, Predictor
from rebar_depth_bench.methods.onnx.session import OnnxSession, open_session
from rebar_depth_bench.methods.onnx.spec import InputSpec, OnnxSpec, OutputSpec, read_onnx_toml


@dataclass(frozen=True)
class Span:
    """One side, pixels: ``picture`` of them become ``resized``, ``before`` of padding, ``canvas`` in all."""

    picture: int
    resized: int
    before: int
    canvas: int

    @property
    def scale(self) -> float:
        """Input pixels per picture pixel: what the focal length on this side is multiplied by."""
        return self.resized / self.picture


@dataclass(frozen=True)
class Placement:
    """Where a picture lies in the model's input."""

    across: Span
    down: Span


def placement(spec: InputSpec, width: int, height: int) -> Placement:
    """Return where a ``width`` x ``height`` picture lies in the input: stretched, or centred."""
    canvas = spec.size_px or _canvas_px(spec, width, height)
    ratio = min(canvas[0] / width, canvas[1] / height)
    across, down = (
        _span(side, min(max(round(side * ratio), 1), room) if spec.pad else room, room)
        for side, room in zip((width, height), canvas, strict=True)
    )
    return Placement(across, down)


def _canvas_px(spec: InputSpec, width: int, height: int) -> tuple[int, int]:
    ratio = spec.longest_px / max(width, height)
    across, down = (max(round(side * ratio / spec.multiple_px), 1) * spec.multiple_px for side in (width, height))
    return across, down


def _span(picture: int, resized: int, canvas: int) -> Span:
    return Span(picture, resized, (canvas - resized) // 2, canvas)


def input_tensor(
    spec: InputSpec, place: Placement, rgb: UInt8[ndarray, "h w 3"]
) -> Float64[ndarray, "1 3 canvas_h canvas_w"]:
    """Return the picture resized, normalised and padded with the mean (0 after normalisation), NCHW, RGB.

    Pillow resizes the 8-bit picture; where it gets smaller all pixels that fall on a new one are weighed in
    (antialiased), which OpenCV's and torch's default resize are not.
    """
    size = (place.across.resized, place.down.resized)
    kernel = Image.Resampling.BICUBIC if spec.bicubic else Image.Resampling.BILINEAR
    resized = np.asarray(Image.fromarray(rgb).resize(size, kernel), np.float64)
    normalised = (resized * (spec.white / 255) - np.array(spec.mean)) / np.array(spec.std)
    tensor = np.zeros((1, 3, place.down.canvas, place.across.canvas))
    tensor[0, :, _inside(place.down), _inside(place.across)] = normalised.transpose(2, 0, 1)
    return tensor


def _inside(span: Span) -> slice:
    return slice(span.before, span.before + span.resized)


def on_picture(
    place: Placement, values: Float[ndarray, "out_h out_w"], *, bilinear: bool
) -> Float[ndarray, "h w"]:
    """Return values of a grid over the whole input at the picture's pixels; never one from the padding.

    Nearest takes the value of the cell in which the pixel's centre lies. Bilinear mixes neighbours, NaN if one
    of them is: smooth, but at a bar's edge it makes depth that lies neither on the bar nor behind it.
    """
    out_height, out_width = values.shape
    if not bilinear:
        rows, columns = _nearest(place.down, out_height), _nearest(place.across, out_width)
        return np.asarray(values[np.ix_(rows, columns)])
    top, bottom, from_top = _neighbours(place.down, out_height)
    left, right, from_left = _neighbours(place.across, out_width)
    upper, lower = (_mixed(values[rows][:, left], values[rows][:, right], from_left) for rows in (top, bottom))
    return _mixed(upper, lower, from_top[:, None])


def _mixed(
    first: Float[ndarray, "a b"], second: Float[ndarray, "a b"], share: Float64[ndarray, ...]
) -> Float[ndarray, "a b"]:
    return np.asarray(first * (1 - share) + second * share)


def _nearest(span: Span, cells: int) -> Int64[ndarray, " n"]:
    first, last = _cells_inside(span, cells)
    return np.asarray(np.clip(np.floor(_position(span, cells)).astype(np.int64), first, last))


def _neighbours(
    span: Span, cells: int
) -> tuple[Int64[ndarray, " n"], Int64[ndarray, " n"], Float64[ndarray, " n"]]:
    """Return the cells whose centres lie before and after each pixel's, and the share of the one after."""
    first, last = _cells_inside(span, cells)
    place = np.clip(_position(span, cells) - 0.5, first, last)
    before = np.floor(place).astype(np.int64)
    share = place - before
    # Where a centre is hit no second cell counts, NaN or not.
    return before, np.where(share > 0, np.minimum(before + 1, last), before), share


def _position(span: Span, cells: int) -> Float64[ndarray, " n"]:
    """Return where each picture pixel's centre lies on a grid of ``cells`` over the whole input.

    Whole numbers up to one division: a centre on a cell's edge lies there exactly, on every machine.
    """
    twice_centres = 2 * np.arange(span.picture, dtype=np.int64) + 1
    numerators = (twice_centres * span.resized + 2 * span.picture * span.before) * cells
    return np.asarray(numerators / (2 * span.picture * span.canvas))


def _cells_inside(span: Span, cells: int) -> tuple[int, int]:
    """Return the first and last cell without padding; where a coarse grid has none, the one in the middle."""
    first = -(-span.before * cells // span.canvas)
    last = (span.before + span.resized) * cells // span.canvas - 1
    if first <= last:
        return first, last
    middle = min((2 * span.before + span.resized) * cells // (2 * span.canvas), cells - 1)
    return middle, middle


TRIAL_PX = (1280, 720)
"""Width and height of the black picture that a model answers once before the first view."""
_DIGITS = 16


def onnx_method(path: Path) -> Method:
    """Return the method that a TOML file describes. onnxruntime is imported when it is loaded.

    Its source ends with a digest of the file, the model and the model's external data: predictions of another
    model or other settings are not taken for this one's when a run goes on.

    Raises ``MethodError`` with all that is wrong with the file.
    """
    spec = read_onnx_toml(path)
    canonical = spec.output.meaning.canonical
    info = MethodInfo(
        name=spec.name,
        summary=spec.summary or f"ONNX model {spec.model.name}; its output: {spec.output.meaning.words}",
        columns=("left_rgb", "left_K") if canonical else ("left_rgb",),
        uses_intrinsics=canonical,
        source=f"{spec.source or spec.model.name} (sha256:{_digest(path, spec.model)})",
        licence=spec.licence,
    )
    return Method(info, lambda: _load(spec))


def metres(
    values: Float[ndarray, "*grid"], output: OutputSpec, fx_at_input_px: float = np.nan
) -> Float32[ndarray, "*grid"]:
    """Return planar depth in metres of output values; NaN where the value or the depth is not finite and above 0,
    or the depth lies outside of ``min_m`` to ``max_m``.

    ``fx_at_input_px`` is the focal length of the picture as the model saw it, resized. Depth is v, or 1 / v, times
    fx / focal_canonical where the meaning is canonical (Yin et al., "Metric3D", ICCV 2023, section 3.2), with v
    the value times ``scale``.
    """
    factor = fx_at_input_px / output.focal_canonical_px if output.meaning.canonical else 1.0
    scaled = np.asarray(values, np.float64) * output.scale
    with np.errstate(all="ignore"):
        depth_m = np.asarray(factor / scaled if output.meaning.inverse else factor * scaled)
        single = depth_m.astype(np.float32)
    known = np.isfinite(scaled) & np.isfinite(single) & (single > 0)
    known &= (depth_m >= output.min_m) & (depth_m <= output.max_m)
    return np.where(known, single, np.float32(np.nan))


def _load(spec: OnnxSpec) -> Predictor:
    session = open_session(spec.model, spec.input, spec.output)
    width, height = TRIAL_PX
    # What a model with open sizes really returns shows only when it runs.
    session.run(
        input_tensor(
            spec.input, placement(spec.input, width, height), np.zeros((height, width, 3), dtype=np.uint8)
        )
    )
    return lambda row: _predict(spec, session, row)


def _predict(spec: OnnxSpec, session: OnnxSession, row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
    height, width, _ = row["left_rgb"].shape
    place = placement(spec.input, width, height)
    values = session.run(input_tensor(spec.input, place, row["left_rgb"]))
    fx_at_input_px = row["left_K"][0, 0] * place.across.scale if spec.output.meaning.canonical else np.nan
    # First out goes what is no answer, so that no neighbour is mixed with it.
    answered: Float64[ndarray, "out_h out_w"] = np.where(
        np.isnan(metres(values, spec.output, fx_at_input_px)), np.nan, values
    )
    return metres(on_picture(place, answered, bilinear=spec.output.bilinear), spec.output, fx_at_input_px)


def _digest(path: Path, model: Path) -> str:
    """Return a digest of the TOML file, the model and its external data: what lies beside it under its name."""
    try:
        beside = sorted(one for one in model.parent.iterdir() if one.name.startswith(model.name) and one.is_file())
        return files_digest((path, *beside))[:_DIGITS]
    except OSError as error:
        raise MethodError(f"{error.filename}: cannot be read: {error.strerror}") from None
