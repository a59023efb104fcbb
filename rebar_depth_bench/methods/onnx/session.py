"""ONNX inference sessions for models with one image input and one map output.

This is the only module that imports onnxruntime.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.errors import MethodError, Problem
from rebar_depth_bench.limits import ONNX_MEMORY_BYTES, DeadlineError, call_within
from rebar_depth_bench.methods.onnx.spec import InputSpec, OutputSpec

PROVIDERS = ("CUDAExecutionProvider", "CPUExecutionProvider")
"""Execution providers in order of preference; those that onnxruntime does not offer are skipped."""
_FLOAT_DTYPES: Mapping[str, type] = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
}
_LOG_ERRORS_ONLY, _LOG_NOTHING = 3, 4
_MAX_ERROR_CHARACTERS = 300
_OUT_OF_MEMORY = "Available memory of"
"""Part of onnxruntime's message if its memory arena cannot grow any further."""


@dataclass(frozen=True)
class OnnxSession:
    """Open model with one RGB image as input; ``where`` is the file name for error messages.

    ``at_input_size`` is True if the output must have the size of the input. ``timeout_s`` limits each inference.
    """

    session: Any
    where: str
    output_name: str
    at_input_size: bool
    timeout_s: float

    def run(self, tensor: Float64[ndarray, "1 3 h w"], view: str) -> Float64[ndarray, "out_h out_w"]:
        """Return the output map for one normalised image; ``view`` names it in error messages.

        Raises ``MethodError`` if the model fails or exceeds the time limit, or if the output is not a single map
        or, with ``at_input_size``, not of the input's size.
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
            raise MethodError(f"{self.where}: {view}: {_exceeded(self.timeout_s)}") from None
        except Exception as error:  # The exceptions of onnxruntime have no common base.
            size = " x ".join(map(str, tensor.shape))
            raise MethodError(f"{self.where}: fails on an input of {size}: {_error_text(error)}") from None
        shape = tuple(np.shape(output))
        name = f"{self.where}: output {self.output_name!r}"
        if len(shape) < 2 or set(shape[:-2]) - {1} or not np.size(output):
            raise MethodError(
                f"{name} has the shape {shape}, expected H x W, with optional leading dimensions of 1"
            )
        if self.at_input_size and shape[-2:] != tensor.shape[-2:]:
            expected = " x ".join(map(str, tensor.shape[-2:]))
            raise MethodError(
                f"{name} has the shape {shape}, expected {expected} or [output] at_input_size = false"
            )
        return np.asarray(output, np.float64).reshape(shape[-2:])


def open_session(path: Path, input_spec: InputSpec, output_spec: OutputSpec, timeout_s: float) -> OnnxSession:
    """Open a model and check that its input and output match the TOML file.

    ``timeout_s`` limits opening, where onnxruntime computes constants, and each inference. Raises ``MethodError``
    if onnxruntime is missing or cannot open the file, or if input or output do not match.
    """
    try:
        import onnxruntime
    except ImportError as error:
        raise MethodError(
            f"an ONNX model needs onnxruntime ({error}): pip install 'rebar-depth-bench[onnx]'"
        ) from None
    onnxruntime.set_default_logger_severity(_LOG_ERRORS_ONLY)
    options = onnxruntime.SessionOptions()
    options.log_severity_level = _LOG_ERRORS_ONLY
    # Without a number, it pins threads to processors and prints an error for each that the process may not use.
    options.intra_op_num_threads = len(os.sched_getaffinity(0))
    _limit_memory(onnxruntime, options)
    available = onnxruntime.get_available_providers()
    providers = [name for name in PROVIDERS if name in available]
    try:
        session = call_within(
            timeout_s,
            lambda: onnxruntime.InferenceSession(str(path), options, providers=providers),
            # Versions before 1.21 do not have it.
            lambda: getattr(options, "set_load_cancellation_flag", bool)(True),
        )
    except DeadlineError:
        raise MethodError(f"{path}: opening the model {_exceeded(timeout_s)}") from None
    except Exception as error:
        raise MethodError(f"{path}: onnxruntime cannot open this model: {_error_text(error)}") from None
    inputs, outputs = session.get_inputs(), session.get_outputs()
    problems = _input_problems(inputs, input_spec)
    output = _select_output(outputs, output_spec.name_or_index, problems)
    if problems or output is None:
        raise MethodError.from_problems(path, problems)
    return OnnxSession(session, str(path), output.name, output_spec.at_input_size, timeout_s)


def _limit_memory(onnxruntime: Any, options: Any) -> None:
    """Give sessions a common CPU memory arena that cannot grow past the limit or the machine's memory."""
    max_bytes = min(ONNX_MEMORY_BYTES.value(), os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
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
        return [Problem("invalid", "input", f"the model takes {len(inputs)} ({names})", "one: the image")]
    [image_input] = inputs
    # The shape is empty if the model leaves even the rank undefined.
    shape_problems = _shape_problems(image_input.shape, spec) if image_input.shape else []
    return [*_dtype_problems("input", image_input), *shape_problems]


def _dtype_problems(where: str, entry: Any) -> list[Problem]:
    """Return the problem of an input or output that is not floating point."""
    found, expected = f"{entry.name!r} is {entry.type}", f"one of {', '.join(_FLOAT_DTYPES)}"
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
        hint = ": channels come before height and width" if channels_last else ""
        return [Problem("invalid", "input", found, f"1 x 3 x H x W{hint}")]
    return [
        Problem("size", f"input.{name}", f"got {got or 'a variable size (longest_side)'}, {found}", str(side))
        for name, side, got in zip(("height", "width"), sides, configured, strict=True)
        if _is_fixed(side) and side != got
    ]


def _is_fixed(side: int | str | None) -> bool:
    return isinstance(side, int) and side > 0


def _select_output(outputs: Sequence[Any], name_or_index: str | int | None, problems: list[Problem]) -> Any:
    """Return the output that the TOML file selects; if it does not exist, append to ``problems``, return None."""
    expected = f"one of {', '.join(repr(output.name) for output in outputs)}"
    if name_or_index is None and len(outputs) != 1:
        problems.append(Problem("missing", "output.name", f"the model has {len(outputs)} outputs", expected))
        return None
    if isinstance(name_or_index, str):
        where, matches = "output.name", [output for output in outputs if output.name == name_or_index]
    else:
        where, matches = "output.index", list(outputs[name_or_index or 0 :][:1])
    if not matches:
        problems.append(Problem("unknown", where, f"the model has no output {name_or_index!r}", expected))
        return None
    problems += _dtype_problems("output", matches[0])
    return matches[0]


def _error_text(error: Exception) -> str:
    """Return the message of an exception on one line, truncated."""
    message = " ".join(str(error).split())
    hint = f"; {ONNX_MEMORY_BYTES.variable} raises the limit" if _OUT_OF_MEMORY in message else ""
    return f"{message[:_MAX_ERROR_CHARACTERS]}{' ...' if len(message) > _MAX_ERROR_CHARACTERS else ''}{hint}"
