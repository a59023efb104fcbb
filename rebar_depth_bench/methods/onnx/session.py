"""One ONNX model, opened and checked: a picture in, one map of numbers out. Only this module knows onnxruntime."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.errors import MethodError, problem_summary
from rebar_depth_bench.methods.onnx.spec import InputSpec, OutputSpec

PROVIDERS = ("CUDAExecutionProvider", "CPUExecutionProvider")
"""Where a model runs, the first that the installed onnxruntime offers."""
_FLOATS: Mapping[str, type] = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
}
_QUIET = 3
_SHOWN_CHARACTERS = 300


@dataclass(frozen=True)
class OnnxSession:
    """An open model whose input is one RGB picture; ``where`` names the file in problems."""

    session: Any
    where: str
    input_name: str
    input_dtype: type
    output_name: str
    at_input_size: bool

    def run(self, tensor: Float64[ndarray, "1 3 h w"]) -> Float64[ndarray, "out_h out_w"]:
        """Return the model's answer to one normalised picture.

        Raises ``MethodError`` where the model fails, or its answer is no single map, of the input's size if that
        was said.
        """
        try:
            [answer] = self.session.run([self.output_name], {self.input_name: tensor.astype(self.input_dtype)})
        except Exception as error:  # onnxruntime's own, which have no common base
            size = " x ".join(map(str, tensor.shape))
            raise MethodError(f"{self.where}: fails on an input of {size}: {_words(error)}") from None
        shape = tuple(np.shape(answer))
        name = f"{self.where}: output {self.output_name!r}"
        if len(shape) < 2 or set(shape[:-2]) - {1} or not np.size(answer):
            raise MethodError(f"{name} has the shape {shape}, expected H x W, with any ones before")
        if self.at_input_size and shape[-2:] != tensor.shape[-2:]:
            expected = " x ".join(map(str, tensor.shape[-2:]))
            raise MethodError(
                f"{name} has the shape {shape}, expected {expected} or [output] at_input_size = false"
            )
        return np.asarray(answer, np.float64).reshape(shape[-2:])


def open_session(path: Path, given: InputSpec, returned: OutputSpec) -> OnnxSession:
    """Open a model and check that its input and output are what the TOML file says.

    Raises ``MethodError`` where onnxruntime is missing or cannot open the file, or anything does not fit.
    """
    try:
        import onnxruntime
    except ImportError as error:
        raise MethodError(
            f"an ONNX model needs onnxruntime ({error}): pip install 'rebar-depth-bench[onnx]'"
        ) from None
    options = onnxruntime.SessionOptions()
    options.log_severity_level = _QUIET
    offered = onnxruntime.get_available_providers()
    try:
        session = onnxruntime.InferenceSession(
            str(path), options, providers=[name for name in PROVIDERS if name in offered]
        )
    except Exception as error:
        raise MethodError(f"{path}: onnxruntime cannot open this model: {_words(error)}") from None
    inputs, outputs = session.get_inputs(), session.get_outputs()
    problems = _input_problems(inputs, given)
    output = _chosen(outputs, returned.which, problems)
    if problems or output is None:
        raise MethodError(f"{path}: {problem_summary(problems)}")
    return OnnxSession(
        session, str(path), inputs[0].name, _FLOATS[inputs[0].type], output.name, returned.at_input_size
    )


def _input_problems(inputs: Sequence[Any], spec: InputSpec) -> list[str]:
    if len(inputs) != 1:
        names = ", ".join(repr(one.name) for one in inputs) or "none"
        return [f"the model takes {len(inputs)} inputs ({names}), expected one: the picture"]
    [only] = inputs
    problems = []
    if only.type not in _FLOATS:
        problems.append(f"input {only.name!r} is {only.type}, expected one of {', '.join(_FLOATS)}")
    if only.shape:  # onnxruntime gives an empty one where the model leaves even the rank open
        problems += [f"input {only.name!r} {problem}" for problem in _shape_problems(only.shape, spec)]
    return problems


def _shape_problems(shape: Sequence[int | str | None], spec: InputSpec) -> list[str]:
    """Return what is wrong with an input's shape, in which whatever is no positive number is open."""
    shown = " x ".join(str(side) if _is_fixed(side) else "?" for side in shape)
    if len(shape) != 4:
        return [f"has the shape {shown}, expected 1 x 3 x H x W"]
    problems = []
    batch, channels, *sides = shape
    asked = (None, None) if spec.size_px is None else spec.size_px[::-1]
    channels_last = shape[-1] == 3 != channels and asked[1] != 3
    if channels_last or (_is_fixed(batch) and batch != 1) or (_is_fixed(channels) and channels != 3):
        hint = ": channels come before height and width" if channels_last else ""
        problems.append(f"has the shape {shown}, expected 1 x 3 x H x W{hint}")
    for name, side, wanted in zip(("height", "width"), sides, asked, strict=True):
        if not problems and _is_fixed(side) and side != wanted:
            got = "an open one (longest_side)" if wanted is None else str(wanted)
            problems.append(f"has the shape {shown}: got {got}, expected [input] {name} = {side}")
    return problems


def _is_fixed(side: int | str | None) -> bool:
    return isinstance(side, int) and side > 0


def _chosen(outputs: Sequence[Any], which: str | int | None, problems: list[str]) -> Any:
    """Return the output that the TOML file asks for, or None and a problem more."""
    names = ", ".join(repr(one.name) for one in outputs)
    if which is None and len(outputs) != 1:
        problems.append(f"the model has {len(outputs)} outputs, expected [output] name to be one of {names}")
        return None
    if isinstance(which, str):
        found = [one for one in outputs if one.name == which]
    else:
        place = which or 0
        found = list(outputs[place : place + 1])
    if not found:
        problems.append(f"the model has no output {which!r}, expected one of {names}")
        return None
    if found[0].type not in _FLOATS:
        kinds = ", ".join(_FLOATS)
        problems.append(f"output {found[0].name!r} is {found[0].type}, expected one of {kinds}")
        return None
    return found[0]


def _words(error: Exception) -> str:
    words = " ".join(str(error).split())
    return words if len(words) <= _SHOWN_CHARACTERS else f"{words[:_SHOWN_CHARACTERS]} ..."
