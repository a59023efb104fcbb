"""ONNX depth models as methods: placement of the image in the input, inference and sampling of the output.

A short TOML file describes the model; the docstring of ``spec`` lists its keys. Models and their external data are
not trusted: onnxruntime refuses external data outside the folder of the model and at memory addresses.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Int64
from numpy import ndarray
from PIL import Image

from rebar_depth_bench.base.errors import (
    MethodError,
    Problem,
    ProblemCode,
    format_shape,
    install_command,
    library_message,
)
from rebar_depth_bench.base.limits import ONNX_MEMORY_BYTES, DeadlineError, call_within
from rebar_depth_bench.base.system import memory_bytes, processors
from rebar_depth_bench.data.files import file_sha256
from rebar_depth_bench.methods.base import (
    VIEW_TIMEOUT_S,
    Method,
    MethodInfo,
    Predictor,
    finite_or_nan,
    import_optional,
    positive_or_nan,
)
from rebar_depth_bench.methods.onnx.spec import OUTPUT_MEANINGS, InputSpec, OnnxSpec, read_onnx_toml
from rebar_depth_bench.submission.declaration import METRIC

MIN_VERSION = (1, 28)
"""First version of onnxruntime that confines all external data; 1.27 reads memory through attributes of nodes."""
_PROVIDERS = ("CUDAExecutionProvider", "CPUExecutionProvider")
_FLOAT_DTYPES: Mapping[str, type] = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
}
_DIGEST_CHARACTERS = 16


def onnx_method(path: Path, view_timeout_s: float = VIEW_TIMEOUT_S) -> Method:
    """Return the method that a TOML file describes; onnxruntime is imported when it is loaded.

    ``info.source`` ends with the digests of the TOML file and the model, so that a resumed run does not reuse
    predictions of another model or other settings. ``view_timeout_s`` limits the inference of a view.

    Raises ``MethodError`` listing all problems of the file, or if the model cannot be read.
    """
    spec = read_onnx_toml(path)
    model, meaning = Path(spec.model), OUTPUT_MEANINGS[spec.output.meaning]
    try:
        digests = [f"{file.name} sha256:{file_sha256(file)[:_DIGEST_CHARACTERS]}" for file in (path, model)]
    except OSError as error:
        raise MethodError(f"{error.filename}: cannot be read: {error.strerror}") from None
    info = MethodInfo(
        name=spec.name,
        summary=spec.summary or f"ONNX model {model.name}; its output: {meaning.description}",
        columns=("left_rgb", "left_K") if meaning.canonical else ("left_rgb",),
        uses_intrinsics=meaning.canonical,
        source=f"{spec.source or model.name} ({', '.join(digests)})",
        licence=spec.licence,
        prediction=meaning.prediction,
    )
    return Method(info, lambda: _load(spec, view_timeout_s))


def _load(spec: OnnxSpec, timeout_s: float) -> Predictor:
    """Open a model, check that it matches the TOML file, and run it once: its output shape is only known then.

    ``timeout_s`` limits opening, where onnxruntime computes constants, and each inference. Raises ``MethodError``
    if onnxruntime is missing, too old or fails, or if the model does not match.
    """
    onnxruntime = import_optional("onnxruntime", "an ONNX model needs onnxruntime", "onnx")
    if tuple(map(int, onnxruntime.__version__.split(".")[:2])) < MIN_VERSION:
        raise MethodError(
            f"onnxruntime is {onnxruntime.__version__}, with which a model can read files outside its folder, "
            f"expected at least {'.'.join(map(str, MIN_VERSION))}: {install_command('onnx')}"
        )
    onnxruntime.set_default_logger_severity(3)  # Errors only, such as those of a GPU.
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # Nothing: errors are raised, and may hold control characters of the model.
    # Without a number, it pins threads to processors and prints an error for each that the process may not use.
    options.intra_op_num_threads = processors()
    # All sessions share a CPU memory arena that cannot grow past the limit or the machine's memory.
    max_bytes = min(ONNX_MEMORY_BYTES.value(), memory_bytes() or ONNX_MEMORY_BYTES.value())
    arena, default = onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, onnxruntime.OrtMemType.DEFAULT
    onnxruntime.create_and_register_allocator(
        onnxruntime.OrtMemoryInfo("Cpu", arena, 0, default), onnxruntime.OrtArenaCfg(max_bytes, -1, -1, -1)
    )
    options.add_session_config_entry("session.use_env_allocators", "1")
    providers = [name for name in _PROVIDERS if name in onnxruntime.get_available_providers()]
    session = _within(
        timeout_s,
        f"{spec.model}: onnxruntime cannot open this model",
        lambda: onnxruntime.InferenceSession(spec.model, options, providers=providers),
        lambda: options.set_load_cancellation_flag(True),
    )
    if problems := _mismatches(session.get_inputs(), session.get_outputs(), spec):
        raise MethodError.from_problems(spec.model, problems)
    [image_input] = session.get_inputs()
    output_name = spec.output.name or session.get_outputs()[0].name
    dtype, meaning = _FLOAT_DTYPES[image_input.type], OUTPUT_MEANINGS[spec.output.meaning]

    def predict(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
        image: tuple[int, int] = row["left_rgb"].shape[:2]
        canvas, resized = place_image(spec.input, image)
        # Pillow antialiases when shrinking, unlike the default resize functions of OpenCV and torch.
        small = Image.fromarray(row["left_rgb"]).resize(resized[::-1], Image.Resampling.BILINEAR)
        values = np.asarray(small, np.float64) * (spec.input.range / 255)
        normalised = (values - np.array(spec.input.mean)) / np.array(spec.input.std)
        tensor = np.zeros((1, 3, *canvas))  # The padding is 0, the mean.
        top, left = ((full - inner) // 2 for full, inner in zip(canvas, resized, strict=True))
        tensor[0, :, top : top + resized[0], left : left + resized[1]] = normalised.transpose(2, 0, 1)

        run_options = onnxruntime.RunOptions()
        run_options.log_severity_level = 4
        view = row.get("view_id", "the image")
        [output] = _within(
            timeout_s,
            f"{spec.model}: {view}: fails on an input of 1 x 3 x {format_shape(canvas)}",
            lambda: session.run([output_name], {image_input.name: tensor.astype(dtype)}, run_options),
            lambda: setattr(run_options, "terminate", True),  # It stops between two operators.
        )
        shape = np.shape(output)
        height, width = shape[-2:] if len(shape) > 1 else (0, 0)
        has_ratio = abs(height * canvas[1] - width * canvas[0]) < max(canvas)  # Within one row or column.
        is_line = 1 in (height, width) and 1 not in canvas
        if set(shape[:-2]) - {1} or not (height and width and has_ratio) or is_line:
            raise MethodError(
                f"{spec.model}: output {output_name!r} has the shape {shape}, expected H x W in the ratio of the "
                f"input, {format_shape(canvas)}, after optional dimensions of 1; write a Python method file that "
                "reshapes, transposes or resizes it, see examples/methods/channels_last.py"
            )
        # Each pixel takes one value: depth interpolated at the edge of a bar lies neither on it nor behind it.
        cells = map(source_cells, image, canvas, resized, (height, width))
        factor = 1.0
        if focal_px := spec.output.focal_canonical_px:
            # That of the resized image that the model receives (Yin et al., "Metric3D", ICCV 2023, section 3.2).
            factor = row["left_K"][0, 0] * (resized[1] / image[1]) / focal_px
        with np.errstate(all="ignore"):
            sampled = np.reshape(output, (height, width))[np.ix_(*cells)]
            scaled = sampled.astype(np.float64) * spec.output.scale
            depth_m = factor / scaled if meaning.inverse else factor * scaled
        if meaning.prediction != METRIC:
            return finite_or_nan(scaled)
        return positive_or_nan(depth_m)

    predict({"view_id": "a black image", "left_rgb": np.zeros((720, 1280, 3), np.uint8), "left_K": np.eye(3)})
    return predict


def place_image(spec: InputSpec, image: tuple[int, int]) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return (height, width) of the model input and of the resized image, which is placed in its middle.

    The image is stretched to the input, or keeps its aspect ratio. The sides of an input of variable size are the
    nearest multiples that keep it.
    """
    if spec.width is not None and spec.height is not None:
        canvas = (spec.height, spec.width)
    else:
        ratio, multiple_px = (spec.longest_side or 0) / max(image), spec.multiple_of or 1
        rows, columns = (max(round(side * ratio / multiple_px), 1) * multiple_px for side in image)
        canvas = (rows, columns)
    if spec.resize == "stretch":
        return canvas, canvas
    ratio = min(canvas[0] / image[0], canvas[1] / image[1])
    rows, columns = (min(max(round(side * ratio), 1), full) for side, full in zip(image, canvas, strict=True))
    return canvas, (rows, columns)


def source_cells(image_px: int, canvas_px: int, resized_px: int, cells: int) -> Int64[ndarray, " image_px"]:
    """Return, for each image pixel along an axis, the cell of the output that contains its centre.

    ``cells`` cover the whole input. The result is never a cell that overlaps the padding, except on a grid that is
    too coarse to have another: then it is the middle one.
    """
    before_px = (canvas_px - resized_px) // 2
    twice_centres = (2 * np.arange(image_px, dtype=np.int64) + 1) * resized_px + 2 * image_px * before_px
    first, last = -(-before_px * cells // canvas_px), (before_px + resized_px) * cells // canvas_px - 1
    if first > last:
        first = last = min((2 * before_px + resized_px) * cells // (2 * canvas_px), cells - 1)
    return np.clip(twice_centres * cells // (2 * image_px * canvas_px), first, last)


def _within(timeout_s: float, failure: str, call: Callable[[], Any], cancel: Callable[[], object]) -> Any:
    """Return ``call()``. Raises ``MethodError``, beginning with ``failure``, if it fails or exceeds the limit."""
    try:
        return call_within(timeout_s, call, cancel)
    except DeadlineError:
        reason = f"it takes longer than the limit of {timeout_s:g} s, which --view-timeout changes"
    except Exception as error:  # The exceptions of onnxruntime have no common base.
        is_memory = "Available memory of" in str(error)  # The arena cannot grow any further.
        reason = library_message(error) + (f"; {ONNX_MEMORY_BYTES.variable} raises the limit" if is_memory else "")
    raise MethodError(f"{failure}: {reason}")


def _mismatches(inputs: Sequence[Any], outputs: Sequence[Any], spec: OnnxSpec) -> list[Problem]:
    """Return problems of the model's input, which must be one image as configured, and of its output."""
    problems: list[Problem] = []

    def add(code: ProblemCode, where: str, found: str, expected: str, example: str = "") -> None:
        remedy = f"; for this model write a Python method file, see examples/methods/{example}.py"
        problems.append(Problem(code, where, found, f"{expected}{remedy if example else ''}"))

    floats = f"one of {', '.join(_FLOAT_DTYPES)}"
    if len(inputs) != 1:
        names = ", ".join(repr(entry.name) for entry in inputs) or "none"
        is_stereo = sum(len(entry.shape) == 4 for entry in inputs) > 1
        example = "stereo" if is_stereo else "several_inputs" if inputs else ""
        add("invalid", "input", f"the model takes {len(inputs)} ({names})", "one: the image", example)
    else:
        [image_input] = inputs
        if image_input.type not in _FLOAT_DTYPES:
            add("invalid", "input", f"{image_input.name!r} is {image_input.type}", floats, "uint8")
        # Sides that are not positive integers are dynamic. The shape is empty if even the rank is undefined.
        shape = [side if isinstance(side, int) and side > 0 else None for side in image_input.shape]
        found = f"the model takes {' x '.join(str(side or '?') for side in shape)}"
        is_channels_last = len(shape) == 4 and shape[3] == 3 != shape[1] and spec.input.width != 3
        is_image = len(shape) == 4 and shape[0] in (None, 1) and shape[1] in (None, 3)
        if is_channels_last or (shape and not is_image):
            is_pair = len(shape) == 4 and shape[1] in (2, 6)
            example = "channels_last" if is_channels_last else "hitnet" if is_pair else ""
            add("invalid", "input", found, "1 x 3 x H x W", example)
        else:
            sides = {"height": spec.input.height, "width": spec.input.width}
            for (name, got), side in zip(sides.items(), shape[2:], strict=False):
                if side not in (None, got):
                    got_text = got or "a variable size (longest_side)"
                    add("size", f"input.{name}", f"got {got_text}, {found}", str(side))
    names = ", ".join(repr(output.name) for output in outputs)
    if spec.output.name is None and len(outputs) != 1:
        add("missing", "output.name", f"the model has {len(outputs)} outputs", f"one of {names}")
    elif not (chosen := [one for one in outputs if spec.output.name in (None, one.name)]):
        add("unknown", "output.name", f"the model has no output {spec.output.name!r}", f"one of {names}")
    elif chosen[0].type not in _FLOAT_DTYPES:
        add("invalid", "output", f"{chosen[0].name!r} is {chosen[0].type}", floats)
    return problems
