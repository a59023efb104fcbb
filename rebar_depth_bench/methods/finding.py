"""Where methods come from: the bench, an installed package's entry point, a checkpoint, or a file of the user's.

A package offers its methods as entry points of the group ``rebar_depth_bench.methods``; a Python file is named
with the method in it, ``my_model.py:METHOD``; a TOML file describes an ONNX model; ``hf:`` names a checkpoint of
``transformers``.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Mapping
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType

from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods.constant import CONSTANT
from rebar_depth_bench.methods.method import Method
from rebar_depth_bench.methods.onnx_model import onnx_method
from rebar_depth_bench.methods.sgbm import SGBM, SGBM_FILLED
from rebar_depth_bench.methods.transformers_depth import DEPTH_PRO, PREFIX, hf_method
from rebar_depth_bench.methods.truth import NOISY_TRUTH, TRUTH

GROUP = "rebar_depth_bench.methods"

METHODS: Mapping[str, Method] = {
    method.info.name: method for method in (SGBM, SGBM_FILLED, DEPTH_PRO, CONSTANT, NOISY_TRUTH, TRUTH)
}
"""Those that come with the bench."""


def find_method(name: str) -> Method:
    """Return a method by its name, from a file by ``path.py:NAME`` or ``path.toml``, or by ``hf:ORG/NAME``.

    Raises ``MethodError`` for an unknown one, and where a file or package cannot be imported or holds none.
    """
    if name.startswith(PREFIX):
        return hf_method(name.removeprefix(PREFIX))
    path, colon, attribute = name.rpartition(":")
    if colon and path.endswith(".py"):
        return _checked(name, getattr(_module(Path(path)), attribute, None))
    if name.endswith(".toml"):
        return onnx_method(Path(name))
    if name in METHODS:
        return METHODS[name]
    offered = _offered()
    if name in offered:
        return _loaded(offered[name])
    known = ", ".join((*METHODS, *offered))
    raise MethodError(
        f"no method {name!r}, expected one of {known}, or a file's like my_model.py:METHOD or "
        "my_model.toml, or hf:ORG/NAME"
    )


def all_methods() -> dict[str, Method | MethodError]:
    """Return every method by name; of a package whose method cannot be loaded, why."""
    found: dict[str, Method | MethodError] = dict(METHODS)
    for name, entry in _offered().items():
        try:
            found[name] = _loaded(entry)
        except MethodError as error:
            found[name] = error
    return found


def _offered() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=GROUP) if entry.name not in METHODS}


def _loaded(entry: EntryPoint) -> Method:
    try:
        value = entry.load()
    except Exception as error:  # whatever a stranger's module raises when it is imported
        raise MethodError(f"{entry.name}: {entry.value} cannot be imported: {_words(error)}") from error
    return _checked(entry.name, value)


def _module(path: Path) -> ModuleType:
    if not path.is_file():
        raise MethodError(f"{path}: no such file, expected a Python file that holds a method")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None:
        raise MethodError(f"{path}: is no Python file")
    module = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(path.resolve().parent))  # its neighbours may be imported, as from a script
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise MethodError(f"{path}: cannot be imported: {_words(error)}") from error
    finally:
        sys.path.pop(0)
    return module


def _checked(name: str, value: object) -> Method:
    if not isinstance(value, Method):
        raise MethodError(f"{name}: is {type(value).__name__}, expected a rebar_depth_bench.methods.Method")
    return value


def _words(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"
