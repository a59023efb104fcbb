"""Helpers for running third-party model code: import, weight checks and error translation.

The code is executed unchanged, and so is any code in pickled checkpoints: users must trust the folders they name.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Num
from numpy import ndarray

from rebar_depth_bench.data.files import files_digest
from rebar_depth_bench.errors import MethodError, Problem
from rebar_depth_bench.limits import JSON_BYTES
from rebar_depth_bench.methods.base import MethodInfo
from rebar_depth_bench.reading import parse_json, read_file
from rebar_depth_bench.validation import short_repr

MIN_LOADED_FRACTION = 0.99
"""Smallest fraction of a network's parameters that a checkpoint must contain; an unused token may be missing."""

MAX_ERROR_CHARACTERS = 300
"""Length to which messages of third-party exceptions are truncated."""


def with_weights_digest(info: MethodInfo, label: str, files: Sequence[Path]) -> MethodInfo:
    """Return a method's description with ``label`` in the name and the digest of its weights in the summary.

    Different weights are thus a different method, and an interrupted prediction is not resumed with them.
    """
    summary = f"{info.summary}; weights sha256:{files_digest(files)}"
    return replace(info, name=f"{info.name}:{label}", summary=summary)


def check_folder(folder: Path, name: str, required_files: Sequence[str]) -> None:
    """Raise ``MethodError`` unless a folder contains these files."""
    if not folder.is_dir():
        raise MethodError(f"{name}:{folder}: no such folder, expected one with {' and '.join(required_files)}")
    for file in required_files:
        if not (folder / file).is_file():
            raise MethodError(f"{name}:{folder}: no {file} in it, expected {' and '.join(required_files)}")


def read_json_object(path: Path) -> dict[str, Any]:
    """Return the content of a model's JSON file. Raises ``MethodError`` if it cannot be read or is no object."""
    value, problems = parse_json(read_file(path, JSON_BYTES, "a JSON file", MethodError))
    if not problems and not isinstance(value, dict):
        problems = [Problem("invalid", "", f"got {short_repr(value)}", "a JSON object")]
    if problems:
        raise MethodError.from_problems(path, problems)
    return dict(value)


def import_package(module: str, method: str, install: str) -> Any:
    """Import and return a module. Raises ``MethodError`` with install instructions if it is missing."""
    try:
        with redirect_stdout(sys.stderr):
            return importlib.import_module(module)
    except ImportError as error:
        raise MethodError(f"{method} needs {module.partition('.')[0]} ({error}): {install}") from None


def import_torch(method: str) -> Any:
    """Import and return torch. Raises ``MethodError`` if it is missing."""
    return import_package("torch", method, "pip install 'rebar-depth-bench[torch]'")


@contextmanager
def translate_errors(method: str, torch: Any, doing: str) -> Iterator[None]:
    """Run third-party code with its output sent to standard error and its exceptions converted to ``MethodError``.

    ``doing`` describes the failed operation. The message states explicitly if the code requires CUDA and torch
    finds no GPU.
    """
    try:
        with redirect_stdout(sys.stderr):
            yield
    except MethodError:
        raise
    except Exception as error:  # Third-party code may raise anything.
        message = " ".join(f"{type(error).__name__}: {error}".split())[:MAX_ERROR_CHARACTERS]
        if not torch.cuda.is_available() and ("cuda" in message.lower() or "nvidia" in message.lower()):
            message = f"its code requires a CUDA GPU, and torch finds none ({message})"
        if isinstance(error, ImportError):
            message = f"{message}; install the requirements listed in its repository"
        raise MethodError(f"{method}: {doing}: {message}") from error


@contextmanager
def on_sys_path(folder: Path) -> Iterator[None]:
    """Put a folder first on ``sys.path``, as for a script in it."""
    sys.path.insert(0, str(folder.resolve()))
    try:
        yield
    finally:
        sys.path.remove(str(folder.resolve()))


def check_weights_loaded(method: str, torch: Any, network: Any, loaded_names: Iterable[str]) -> Any:
    """Return a network in evaluation mode, on the GPU if torch finds one, after checking its loaded weights.

    ``loaded_names`` are the parameter names in the checkpoint. Authors' code silently leaves missing parameters at
    random values. Raises ``MethodError`` if the checkpoint contains less than ``MIN_LOADED_FRACTION`` of the
    parameters; other missing ones are listed on standard error.
    """
    names = set(loaded_names)
    sizes = {name: values.numel() for name, values in network.named_parameters()}
    parameter_ids = {name: id(values) for name, values in network.named_parameters(remove_duplicate=False)}
    loaded_ids = {parameter_ids[name] for name in names if name in parameter_ids}
    missing = [name for name in sizes if parameter_ids[name] not in loaded_ids]
    fraction = 1 - sum(sizes[name] for name in missing) / max(sum(sizes.values()), 1)
    message = f"{method}: the weights cover {fraction:.2%} of the network, {len(missing)} tensors are missing"
    if missing and fraction < MIN_LOADED_FRACTION:
        raise MethodError(f"{message}, first {missing[0]}, expected the weights of this network")
    if missing:
        print(f"{message}: {', '.join(missing)}", file=sys.stderr, flush=True)
    return network.to(torch_device(torch)).eval()


def image_tensor(torch: Any, rgb: Num[ndarray, "h w 3"]) -> Any:
    """Return an image as a 1 x 3 x h x w float32 tensor with the same values."""
    return torch.from_numpy(rgb.transpose(2, 0, 1).astype(np.float32))[None]


def shape_error(method: str, shape: Sequence[int], expected: str) -> MethodError:
    """Return the error of a network whose depth has another shape than ``expected``."""
    return MethodError(f"{method}: the network returned depth of shape {tuple(shape)}, expected {expected}")


def load_checkpoint(method: str, torch: Any, network: Any, path: Path, key: str, *, strict: bool = True) -> Any:
    """Return a network with the weights under ``key`` of a pickled checkpoint; see ``check_weights_loaded``."""
    weights = torch.load(path, map_location="cpu", weights_only=False)[key]
    network.load_state_dict(weights, strict=strict)
    return check_weights_loaded(method, torch, network, weights)


def torch_device(torch: Any) -> str:
    """Return the name of the torch device to use."""
    return "cuda" if torch.cuda.is_available() else "cpu"


def safetensors_names(path: Path) -> list[str]:
    """Return the tensor names in a safetensors file. Raises ``MethodError`` if the file is damaged."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as tensors:
            return list(tensors.keys())
    except (SafetensorError, OSError) as error:
        raise MethodError(f"{path}: cannot be read: {error}") from None
