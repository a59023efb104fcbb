"""ONNX depth models as methods: placement of the image in the input, inference and resampling of the output.

A short TOML file describes the model; the docstring of ``spec`` lists its keys.

Pixel positions are continuous in this module: a side of n pixels extends from 0 to n, and pixel i covers
i to i + 1 with its centre at i + 0.5.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8
from numpy import ndarray
from PIL import Image

from rebar_depth_bench.base.errors import MethodError, Problem, library_message
from rebar_depth_bench.base.limits import ONNX_MEMORY_BYTES, DeadlineError, call_within
from rebar_depth_bench.base.system import memory_bytes, processors
from rebar_depth_bench.base.terminal import print_notice
from rebar_depth_bench.methods.base import (
    VIEW_TIMEOUT_S,
    Method,
    MethodInfo,
    Predictor,
    finite_or_nan,
    import_optional,
    positive_or_nan,
)
from rebar_depth_bench.methods.onnx.external_data import model_digest
from rebar_depth_bench.methods.onnx.spec import OUTPUT_MEANINGS, InputSpec, OnnxSpec, OutputSpec, read_onnx_toml
from rebar_depth_bench.submission.declaration import METRIC


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


Placement = tuple[AxisPlacement, AxisPlacement]
"""Placement of an image in the model input, along the x axis (across) and along the y axis (down)."""


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

    def along(side: int, canvas_side: int) -> AxisPlacement:
        fitted = min(max(round(side * ratio), 1), canvas_side)
        return AxisPlacement(side, fitted if spec.resize == "pad" else canvas_side, canvas_side)

    return along(width, canvas[0]), along(height, canvas[1])


def input_tensor(
    spec: InputSpec, placement: Placement, rgb: UInt8[ndarray, "h w 3"]
) -> Float64[ndarray, "1 3 canvas_h canvas_w"]:
    """Return the image resized, normalised and padded with the mean (0 after normalisation), NCHW, RGB.

    The 8-bit image is resized with Pillow, which antialiases when shrinking, unlike the default resize functions
    of OpenCV and torch.
    """
    across, down = placement
    size = (across.resized_px, down.resized_px)
    kernel = Image.Resampling.BICUBIC if spec.interpolation == "bicubic" else Image.Resampling.BILINEAR
    resized = np.asarray(Image.fromarray(rgb).resize(size, kernel), np.float64)
    normalised = (resized * (spec.range / 255) - np.array(spec.mean)) / np.array(spec.std)
    tensor = np.zeros((1, 3, down.canvas_px, across.canvas_px))
    tensor[0, :, down.image_slice, across.image_slice] = normalised.transpose(2, 0, 1)
    return tensor


def sample_at_image_pixels(
    placement: Placement, values: Float[ndarray, "out_h out_w"], *, bilinear: bool
) -> Float[ndarray, "h w"]:
    """Return values of a grid over the whole input, sampled at the image pixels and never in the padding.

    Nearest neighbour takes the cell that contains the pixel centre. Bilinear interpolation gives NaN if a
    neighbour is NaN; it is smooth, but at the edge of a bar it produces depth that lies neither on the bar nor
    behind it.
    """
    across, down = placement
    return _sample_axis(down, _sample_axis(across, values, 1, bilinear), 0, bilinear)


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
        source=f"{spec.source or model.name} (sha256:{model_digest(path, model)})",
        licence=spec.licence,
        prediction=meaning.prediction,
    )
    return Method(info, lambda: _load(spec, view_timeout_s))


def output_to_depth_m(
    values: Float[ndarray, "*grid"], output: OutputSpec, factor: float = 1.0
) -> Float32[ndarray, "*grid"]:
    """Return planar depth in metres of output values; of relative networks the finite values times ``scale``.

    Depth is v or 1 / v, where v is the value times ``scale``, multiplied by ``factor``. It is NaN where the value
    is not finite, or the depth is not finite and above 0 or lies outside ``min_m`` to ``max_m``.
    """
    scaled = np.asarray(values, np.float64) * output.scale
    if OUTPUT_MEANINGS[output.meaning].prediction != METRIC:
        return finite_or_nan(scaled)
    with np.errstate(all="ignore"):
        depth_m = np.asarray(factor / scaled if OUTPUT_MEANINGS[output.meaning].inverse else factor * scaled)
    valid = np.isfinite(scaled) & (depth_m >= output.min_m) & (depth_m <= output.max_m)
    return positive_or_nan(np.where(valid, depth_m, np.nan))


def _load(spec: OnnxSpec, view_timeout_s: float) -> Predictor:
    session = open_session(spec, view_timeout_s)
    # The output shape of a model with dynamic sizes is only known after a run.
    placement, black = place_image(spec.input, *TRIAL_SIZE_PX), np.zeros((*TRIAL_SIZE_PX[::-1], 3), np.uint8)
    trial = input_tensor(spec.input, placement, black)
    session.run(trial, "a black trial image", trial.shape[-2:])
    noted: set[str] = set()

    def predict(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
        height, width, _ = row["left_rgb"].shape
        placement = place_image(spec.input, width, height)
        tensor = input_tensor(spec.input, placement, row["left_rgb"])
        values = session.run(tensor, row.get("view_id", "the image"), (height, width))
        if not _has_ratio(values.shape, tensor.shape[-2:]) and not _has_ratio(values.shape, (height, width)):
            sides = " x ".join(map(str, values.shape))
            note = (
                f"{spec.model}: the output, {sides}, is scaled to the picture along each axis: its ratio is "
                f"neither that of the input nor that of the picture, {height} x {width}"
            )
            if note not in noted:  # Once for each size of the pictures.
                noted.add(note)
                print_notice(note)
        factor = 1.0
        if focal_px := spec.output.focal_canonical_px:
            # That of the resized image that the model receives (Yin et al., "Metric3D", ICCV 2023, section 3.2).
            factor = row["left_K"][0, 0] * (placement[0].resized_px / width) / focal_px
        # Invalid values become NaN before resampling, so that they are not interpolated with neighbours.
        is_invalid = np.isnan(output_to_depth_m(values, spec.output, factor))
        valid = np.where(is_invalid, np.nan, values)
        sampled = sample_at_image_pixels(placement, valid, bilinear=spec.output.resize == "bilinear")
        return output_to_depth_m(sampled, spec.output, factor)

    return predict


# Inference sessions for models with one image input and one map output.

PROVIDERS = ("CUDAExecutionProvider", "CPUExecutionProvider")
"""Execution providers in order of preference; those that onnxruntime does not offer are skipped."""
_FLOAT_DTYPES: Mapping[str, type] = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
}
_LOG_ERRORS_ONLY, _LOG_NOTHING = 3, 4
_OUT_OF_MEMORY = "Available memory of"
"""Part of onnxruntime's message if its memory arena cannot grow any further."""


@dataclass(frozen=True)
class OnnxSession:
    """Open model with one RGB image as input; ``timeout_s`` limits each inference."""

    session: Any
    spec: OnnxSpec
    output_name: str
    timeout_s: float

    def run(
        self, tensor: Float64[ndarray, "1 3 h w"], view: str, picture: Sequence[int]
    ) -> Float64[ndarray, "out_h out_w"]:
        """Return the output map for one normalised image; ``view`` names it in error messages.

        ``picture`` are height and width of the image, for a trial those of the input.

        Raises ``MethodError`` if the model fails or exceeds the time limit, or if the output is not a single map,
        is a single row or column, has the ratio of the input or the picture transposed or, with ``at_input_size``,
        is not of the input's size.
        """
        import onnxruntime

        [image_input] = self.session.get_inputs()
        inputs: dict[str, ndarray] = {image_input.name: tensor.astype(_FLOAT_DTYPES[image_input.type])}
        options = onnxruntime.RunOptions()
        options.log_severity_level = _LOG_NOTHING
        try:
            [output] = call_within(
                self.timeout_s,
                lambda: self.session.run([self.output_name], inputs, options),
                lambda: setattr(options, "terminate", True),  # It stops between two operators.
            )
        except DeadlineError:
            raise MethodError(f"{self.spec.model}: {view}: {_exceeded(self.timeout_s)}") from None
        except Exception as error:  # The exceptions of onnxruntime have no common base.
            size = " x ".join(map(str, tensor.shape))
            raise MethodError(f"{self.spec.model}: fails on an input of {size}: {_error_text(error)}") from None
        shape = tuple(np.shape(output))
        name = f"{self.spec.model}: output {self.output_name!r}"
        if len(shape) < 2 or set(shape[:-2]) - {1} or not np.size(output):
            raise MethodError(
                f"{name} has the shape {shape}, expected H x W, with optional leading dimensions of 1"
            )
        grid, canvas = shape[-2:], tensor.shape[-2:]
        expected = " x ".join(map(str, canvas))
        is_line = 1 in grid and 1 not in canvas
        is_turned = any(_has_ratio(grid, sides[::-1]) for sides in (canvas, picture))
        if is_line or (is_turned and not any(_has_ratio(grid, sides) for sides in (canvas, picture))):
            found = "a single row or column" if is_line else "the width before the height"
            raise MethodError(
                f"{name} has the shape {shape}, {found}, expected rows and columns as the input, {expected}; "
                "write a Python method file that reshapes or transposes it, see examples/methods/channels_last.py"
            )
        if self.spec.output.at_input_size and grid != canvas:
            raise MethodError(
                f"{name} has the shape {shape}, expected {expected} or [output] at_input_size = false"
            )
        return np.asarray(output, np.float64).reshape(shape[-2:])


def _has_ratio(grid: Sequence[int], sides: Sequence[int]) -> bool:
    """Return whether the rows and columns of a grid have the ratio of ``sides`` within one row or column."""
    (rows, columns), (height, width) = grid, sides
    return abs(rows * width - columns * height) < max(height, width)


def open_session(spec: OnnxSpec, timeout_s: float) -> OnnxSession:
    """Open a model and check that its input and output match the TOML file.

    ``timeout_s`` limits opening, where onnxruntime computes constants, and each inference. Raises ``MethodError``
    if onnxruntime is missing or cannot open the file, or if input or output do not match.
    """
    onnxruntime = import_optional("onnxruntime", "an ONNX model needs onnxruntime", "onnx")
    onnxruntime.set_default_logger_severity(_LOG_ERRORS_ONLY)
    options = onnxruntime.SessionOptions()
    options.log_severity_level = _LOG_ERRORS_ONLY
    # Without a number, it pins threads to processors and prints an error for each that the process may not use.
    options.intra_op_num_threads = processors()
    _limit_memory(onnxruntime, options)
    available = onnxruntime.get_available_providers()
    providers = [name for name in PROVIDERS if name in available]
    try:
        session = call_within(
            timeout_s,
            lambda: onnxruntime.InferenceSession(spec.model, options, providers=providers),
            # Versions before 1.21 do not have it.
            lambda: getattr(options, "set_load_cancellation_flag", bool)(True),
        )
    except DeadlineError:
        raise MethodError(f"{spec.model}: opening the model {_exceeded(timeout_s)}") from None
    except Exception as error:
        raise MethodError(f"{spec.model}: onnxruntime cannot open this model: {_error_text(error)}") from None
    inputs, outputs = session.get_inputs(), session.get_outputs()
    problems = _input_problems(inputs, spec.input)
    output = _select_output(outputs, spec.output, problems)
    if problems or output is None:
        raise MethodError.from_problems(spec.model, problems)
    return OnnxSession(session, spec, output.name, timeout_s)


def _limit_memory(onnxruntime: Any, options: Any) -> None:
    """Give sessions a common CPU memory arena that cannot grow past the limit or the machine's memory."""
    max_bytes = min(ONNX_MEMORY_BYTES.value(), memory_bytes() or ONNX_MEMORY_BYTES.value())
    arena, default = onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, onnxruntime.OrtMemType.DEFAULT
    onnxruntime.create_and_register_allocator(
        onnxruntime.OrtMemoryInfo("Cpu", arena, 0, default), onnxruntime.OrtArenaCfg(max_bytes, -1, -1, -1)
    )
    options.add_session_config_entry("session.use_env_allocators", "1")


def _exceeded(timeout_s: float) -> str:
    return f"takes longer than the limit of {timeout_s:g} s, which --view-timeout changes"


def _input_problems(inputs: Sequence[Any], spec: InputSpec) -> list[Problem]:
    """Return problems of the model's inputs: exactly one, floating point, of the expected shape."""
    if len(inputs) != 1:
        names = ", ".join(repr(entry.name) for entry in inputs) or "none"
        images = [entry for entry in inputs if len(entry.shape) == 4]
        example = "stereo" if len(images) > 1 else "several_inputs" if inputs else None
        expected = f"one: the image{_python_method(example)}"
        return [Problem("invalid", "input", f"the model takes {len(inputs)} ({names})", expected)]
    [image_input] = inputs  # Its shape is empty if the model leaves even the rank undefined.
    shape_problems = _shape_problems(image_input.shape, spec) if image_input.shape else []
    return [*_dtype_problems("input", image_input, _python_method("uint8")), *shape_problems]


def _python_method(example: str | None) -> str:
    """Return the remedy for a model like an example, as the end of what was expected; empty for None."""
    return f"; for this model write a Python method file, see examples/methods/{example}.py" if example else ""


def _dtype_problems(where: str, entry: Any, remedy: str = "") -> list[Problem]:
    """Return the problem of an input or output that is not floating point."""
    found, expected = f"{entry.name!r} is {entry.type}", f"one of {', '.join(_FLOAT_DTYPES)}{remedy}"
    return [] if entry.type in _FLOAT_DTYPES else [Problem("invalid", where, found, expected)]


def _shape_problems(shape: Sequence[int | str | None], spec: InputSpec) -> list[Problem]:
    """Return problems of an input shape; sides that are not positive integers are dynamic."""
    found = f"the model takes {' x '.join(str(side) if _is_fixed(side) else '?' for side in shape)}"
    if len(shape) != 4:
        return [Problem("invalid", "input", found, "1 x 3 x H x W")]
    batch, channels, *sides = shape
    configured = (None, None) if spec.size_px is None else spec.size_px[::-1]
    channels_last = shape[-1] == 3 != channels and configured[1] != 3
    if channels_last or (_is_fixed(batch) and batch != 1) or (_is_fixed(channels) and channels != 3):
        # 2 or 6 channels are a stereo pair.
        example = "channels_last" if channels_last else "hitnet" if channels in (2, 6) else None
        return [Problem("invalid", "input", found, f"1 x 3 x H x W{_python_method(example)}")]
    return [
        Problem("size", f"input.{name}", f"got {got or 'a variable size (longest_side)'}, {found}", str(side))
        for name, side, got in zip(("height", "width"), sides, configured, strict=True)
        if _is_fixed(side) and side != got
    ]


def _is_fixed(side: int | str | None) -> bool:
    return isinstance(side, int) and side > 0


def _select_output(outputs: Sequence[Any], spec: OutputSpec, problems: list[Problem]) -> Any:
    """Return the output that the TOML file selects; if it does not exist, append to ``problems``, return None."""
    expected = f"one of {', '.join(repr(output.name) for output in outputs)}"
    if spec.name is None and spec.index is None and len(outputs) != 1:
        problems.append(Problem("missing", "output.name", f"the model has {len(outputs)} outputs", expected))
        return None
    if spec.name is not None:
        matches = [output for output in outputs if output.name == spec.name]
        missing = Problem("unknown", "output.name", f"the model has no output {spec.name!r}", expected)
    else:
        matches = list(outputs[spec.index or 0 :][:1])
        missing = Problem("unknown", "output.index", f"the model has no output {spec.index}", expected)
    if not matches:
        problems.append(missing)
        return None
    problems += _dtype_problems("output", matches[0])
    return matches[0]


def _error_text(error: Exception) -> str:
    """Return the message of an exception of onnxruntime, with the remedy if the memory was too small."""
    hint = f"; {ONNX_MEMORY_BYTES.variable} raises the limit" if _OUT_OF_MEMORY in str(error) else ""
    return f"{library_message(error)}{hint}"
