"""ONNX depth models as methods: placement of the image in the input, inference and resampling of the output.

A short TOML file describes the model; the docstring of ``spec`` lists its keys.

Pixel positions are continuous in this module: a side of n pixels extends from 0 to n, and pixel i covers
i to i + 1 with its centre at i + 0.5.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8
from numpy import ndarray
from PIL import Image

from rebar_depth_bench.data.files import files_digest
from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods.base import VIEW_TIMEOUT_S, Method, MethodInfo, Predictor
from rebar_depth_bench.methods.onnx.external_data import external_files
from rebar_depth_bench.methods.onnx.session import open_session
from rebar_depth_bench.methods.onnx.spec import OUTPUT_MEANINGS, InputSpec, OnnxSpec, OutputSpec, read_onnx_toml


@dataclass(frozen=True)
class AxisPlacement:
    """Placement along one axis, pixels.

    ``image_px`` pixels of the image are resized to ``resized_px`` and placed in the middle of an input of
    ``canvas_px``.
    """

    image_px: int
    resized_px: int
    canvas_px: int

    @property
    def pad_before_px(self) -> int:
        """Padding before the image; with an odd number of pixels, the one after it is larger by one."""
        return (self.canvas_px - self.resized_px) // 2

    @property
    def image_slice(self) -> slice:
        """Input pixels covered by the image."""
        return slice(self.pad_before_px, self.pad_before_px + self.resized_px)


@dataclass(frozen=True)
class Placement:
    """Placement of an image in the model input: ``across`` is the x axis, ``down`` the y axis."""

    across: AxisPlacement
    down: AxisPlacement


def place_image(spec: InputSpec, width: int, height: int) -> Placement:
    """Return the placement of a ``width`` x ``height`` image: stretched, or centred with its aspect ratio kept.

    The sides of an input of variable size are the nearest multiples that keep the aspect ratio.
    """
    if spec.size_px is not None:
        canvas = spec.size_px
    else:
        ratio, multiple_px = (spec.longest_side or 0) / max(width, height), spec.multiple_of or 1
        across, down = (max(round(side * ratio / multiple_px), 1) * multiple_px for side in (width, height))
        canvas = (across, down)
    ratio = min(canvas[0] / width, canvas[1] / height)
    axes = []
    for side, canvas_side in zip((width, height), canvas, strict=True):
        fitted = min(max(round(side * ratio), 1), canvas_side)
        axes.append(AxisPlacement(side, fitted if spec.resize == "pad" else canvas_side, canvas_side))
    return Placement(*axes)


def input_tensor(
    spec: InputSpec, placement: Placement, rgb: UInt8[ndarray, "h w 3"]
) -> Float64[ndarray, "1 3 canvas_h canvas_w"]:
    """Return the image resized, normalised and padded with the mean (0 after normalisation), NCHW, RGB.

    The 8-bit image is resized with Pillow, which antialiases when shrinking, unlike the default resize functions
    of OpenCV and torch.
    """
    size = (placement.across.resized_px, placement.down.resized_px)
    kernel = Image.Resampling.BICUBIC if spec.interpolation == "bicubic" else Image.Resampling.BILINEAR
    resized = np.asarray(Image.fromarray(rgb).resize(size, kernel), np.float64)
    normalised = (resized * (spec.range / 255) - np.array(spec.mean)) / np.array(spec.std)
    tensor = np.zeros((1, 3, placement.down.canvas_px, placement.across.canvas_px))
    tensor[0, :, placement.down.image_slice, placement.across.image_slice] = normalised.transpose(2, 0, 1)
    return tensor


def sample_at_image_pixels(
    placement: Placement, values: Float[ndarray, "out_h out_w"], *, bilinear: bool
) -> Float[ndarray, "h w"]:
    """Return values of a grid over the whole input, sampled at the image pixels and never in the padding.

    Nearest neighbour takes the cell that contains the pixel centre. Bilinear interpolation gives NaN if a
    neighbour is NaN; it is smooth, but at the edge of a bar it produces depth that lies neither on the bar nor
    behind it.
    """
    columns_sampled = _sample_axis(placement.across, values, 1, bilinear)
    return _sample_axis(placement.down, columns_sampled, 0, bilinear)


def _sample_axis(
    span: AxisPlacement, values: Float[ndarray, "a b"], axis: int, bilinear: bool
) -> Float[ndarray, "c d"]:
    cells = values.shape[axis]
    first, last = _unpadded_cells(span, cells)
    centres = _centres_on_grid(span, cells)
    if not bilinear:
        return np.asarray(values.take(np.clip(np.floor(centres).astype(np.int64), first, last), axis))
    position = np.clip(centres - 0.5, first, last)
    before = np.floor(position).astype(np.int64)
    weight = position - before
    # At a cell centre the second cell has no weight; it must not contribute NaN either.
    after = np.where(weight > 0, np.minimum(before + 1, last), before)
    weight = np.expand_dims(weight, 1 - axis)
    return np.asarray(values.take(before, axis) * (1 - weight) + values.take(after, axis) * weight)


def _centres_on_grid(span: AxisPlacement, cells: int) -> Float64[ndarray, " n"]:
    """Return the positions of the image pixel centres on a grid of ``cells`` over the whole input.

    Integer arithmetic up to one division: a centre on a cell edge is represented exactly on every machine.
    """
    twice_centres = 2 * np.arange(span.image_px, dtype=np.int64) + 1
    numerators = (twice_centres * span.resized_px + 2 * span.image_px * span.pad_before_px) * cells
    return np.asarray(numerators / (2 * span.image_px * span.canvas_px))


def _unpadded_cells(span: AxisPlacement, cells: int) -> tuple[int, int]:
    """Return the first and last cell without padding; on a grid too coarse to have one, the middle cell twice."""
    first = -(-span.pad_before_px * cells // span.canvas_px)
    last = (span.pad_before_px + span.resized_px) * cells // span.canvas_px - 1
    if first <= last:
        return first, last
    middle = min((2 * span.pad_before_px + span.resized_px) * cells // (2 * span.canvas_px), cells - 1)
    return middle, middle


TRIAL_SIZE_PX = (1280, 720)
"""Width and height, pixels, of the black image on which a model is run once when it is loaded."""
_DIGEST_CHARACTERS = 16


def onnx_method(path: Path, view_timeout_s: float = VIEW_TIMEOUT_S) -> Method:
    """Return the method that a TOML file describes; onnxruntime is imported when it is loaded.

    ``info.source`` ends with a digest of the TOML file, the model and the model's external data, so that a resumed
    run does not reuse predictions of another model or other settings. ``view_timeout_s`` limits the inference of a
    view.

    Raises ``MethodError`` listing all problems of the file, or those of the model's external data.
    """
    spec = read_onnx_toml(path)
    model, meaning = Path(spec.model), OUTPUT_MEANINGS[spec.output.meaning]
    info = MethodInfo(
        name=spec.name,
        summary=spec.summary or f"ONNX model {model.name}; its output: {meaning.description}",
        columns=("left_rgb", "left_K") if meaning.canonical else ("left_rgb",),
        uses_intrinsics=meaning.canonical,
        source=f"{spec.source or model.name} (sha256:{_model_digest(path, model)})",
        licence=spec.licence,
    )
    return Method(info, lambda: _load(spec, view_timeout_s))


def output_to_depth_m(
    values: Float[ndarray, "*grid"], output: OutputSpec, fx_at_input_px: float = np.nan
) -> Float32[ndarray, "*grid"]:
    """Return planar depth in metres of output values.

    Depth is v or 1 / v, where v is the value times ``scale``; for canonical meanings it is multiplied by fx /
    focal_canonical (Yin et al., "Metric3D", ICCV 2023, section 3.2). ``fx_at_input_px`` is the focal length of the
    resized image that the model receives. Depth is NaN where the value is not finite, or the depth is not finite
    and above 0 or lies outside ``min_m`` to ``max_m``.
    """
    meaning = OUTPUT_MEANINGS[output.meaning]
    factor = fx_at_input_px / (output.focal_canonical_px or np.nan) if meaning.canonical else 1.0
    scaled = np.asarray(values, np.float64) * output.scale
    with np.errstate(all="ignore"):
        depth_m = np.asarray(factor / scaled if meaning.inverse else factor * scaled)
        single = depth_m.astype(np.float32)
    valid = np.isfinite(scaled) & np.isfinite(single) & (single > 0)
    valid &= (depth_m >= output.min_m) & (depth_m <= output.max_m)
    return np.where(valid, single, np.float32(np.nan))


def _load(spec: OnnxSpec, view_timeout_s: float) -> Predictor:
    session = open_session(Path(spec.model), spec.input, spec.output, view_timeout_s)
    width, height = TRIAL_SIZE_PX
    # The output shape of a model with dynamic sizes is only known after a run.
    black = np.zeros((height, width, 3), dtype=np.uint8)
    session.run(input_tensor(spec.input, place_image(spec.input, width, height), black), "a black trial image")

    def predict(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
        height, width, _ = row["left_rgb"].shape
        placement = place_image(spec.input, width, height)
        tensor = input_tensor(spec.input, placement, row["left_rgb"])
        values = session.run(tensor, row.get("view_id", "the image"))
        fx_at_input_px = np.nan
        if OUTPUT_MEANINGS[spec.output.meaning].canonical:
            fx_at_input_px = row["left_K"][0, 0] * (placement.across.resized_px / width)
        # Invalid values become NaN before resampling, so that they are not interpolated with neighbours.
        is_invalid = np.isnan(output_to_depth_m(values, spec.output, fx_at_input_px))
        valid = np.where(is_invalid, np.nan, values)
        sampled = sample_at_image_pixels(placement, valid, bilinear=spec.output.resize == "bilinear")
        return output_to_depth_m(sampled, spec.output, fx_at_input_px)

    return predict


def _model_digest(path: Path, model: Path) -> str:
    """Return the digest of the TOML file, the model and its external data."""
    files = (path, model, *external_files(model))
    try:
        return files_digest(files)[:_DIGEST_CHARACTERS]
    except OSError as error:
        raise MethodError(f"{error.filename}: cannot be read: {error.strerror}") from None
