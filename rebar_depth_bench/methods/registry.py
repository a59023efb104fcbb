"""Registry of methods: built-in methods, entry points of installed packages, checkpoints and users' files.

Names are resolved as follows:

- ``hf:ORG/NAME`` or ``hf:FOLDER``: a checkpoint of ``transformers``;
- ``NAME:FOLDER``: a network of the paper (``FROM_FOLDER``) with its weights, or code and weights, in a folder;
- ``my_model.py:METHOD``: a method defined in a Python file;
- ``my_model.toml``: an ONNX model described by a TOML file;
- any other name: a built-in method, or an entry point of the group ``rebar_depth_bench.methods``.
"""

from __future__ import annotations

import importlib.util
import sys
from collections import UserDict
from collections.abc import Mapping
from dataclasses import replace
from importlib.machinery import PathFinder
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from rebar_depth_bench.base.errors import MethodError, exception_summary
from rebar_depth_bench.data.files import file_sha256
from rebar_depth_bench.methods.base import VIEW_TIMEOUT_S, AnyMethod, Method, MultiViewMethod, WeightsMethod

ENTRY_POINT_GROUP = "rebar_depth_bench.methods"
DISTRIBUTION = "rebar-depth-bench"
_DIGEST_CHARACTERS = 16

FROM_FOLDER = ("depth-anything-3", "depth-pro", "foundation-stereo", "metric3d", "unidepth")
"""Names of the methods that take a folder, which are a ``WeightsMethod``: ``NAME:FOLDER``."""


class _BuiltIn(UserDict[str, Any]):
    """Methods by name, from module and attribute of each; a module is imported when its method is looked up."""

    def __getitem__(self, name: str) -> AnyMethod:
        method: AnyMethod = EntryPoint(name, self.data[name], ENTRY_POINT_GROUP).load()
        return method


METHODS: Mapping[str, AnyMethod] = _BuiltIn(
    {
        "sgbm": "rebar_depth_bench.methods.sgbm:SGBM",
        "sgbm-filled": "rebar_depth_bench.methods.sgbm:SGBM_FILLED",
        "foundation-stereo": "rebar_depth_bench.methods.paper.foundation_stereo:FOUNDATION_STEREO",
        "depth-pro": "rebar_depth_bench.methods.transformers:DEPTH_PRO",
        "metric3d": "rebar_depth_bench.methods.paper.monocular:METRIC3D",
        "unidepth": "rebar_depth_bench.methods.paper.monocular:UNIDEPTH",
        "depth-anything-3": "rebar_depth_bench.methods.paper.monocular:DEPTH_ANYTHING_3",
        "colmap-aruco": "rebar_depth_bench.methods.multiview:COLMAP_ARUCO",
        "colmap-anchored": "rebar_depth_bench.methods.multiview:COLMAP_ANCHORED",
        "sweep-aruco": "rebar_depth_bench.methods.multiview:SWEEP_ARUCO",
        "sweep-anchored": "rebar_depth_bench.methods.multiview:SWEEP_ANCHORED",
        "constant": "rebar_depth_bench.methods.controls:CONSTANT",
        "board-plane": "rebar_depth_bench.methods.controls:BOARD_PLANE",
        "noisy-truth": "rebar_depth_bench.methods.controls:NOISY_TRUTH",
        "truth": "rebar_depth_bench.methods.controls:TRUTH",
    }
)
"""Built-in methods by name."""


def find_method(name: str, *, view_timeout_s: float = VIEW_TIMEOUT_S, nearest_m: float | None = None) -> AnyMethod:
    """Return the method of a name; the module docstring lists the accepted forms.

    ``view_timeout_s`` limits the inference of a view by an ONNX model. ``nearest_m`` declares the distance of the
    nearest surface, metres, to FoundationStereo.

    For the bare name of a method whose weights are on the Hub, and for ``hf:`` names, the files that identify the
    weights are downloaded if they are not cached. Their commit becomes part of the summary.

    Raises ``MethodError`` if the name is unknown, if a file or package cannot be imported or holds no method, or
    if ``nearest_m`` is given to another method.
    """
    method_name, colon, folder = name.partition(":")
    if nearest_m is not None:
        if method_name != "foundation-stereo" or not folder:
            raise MethodError(f"{name}: has no nearest distance, expected foundation-stereo:FOLDER")
        from rebar_depth_bench.methods.paper.foundation_stereo import foundation_stereo_method

        return foundation_stereo_method(Path(folder).expanduser(), nearest_m)
    if method_name == "hf" and colon:
        from rebar_depth_bench.methods.transformers import hf_method

        return hf_method(folder)
    if method_name in METHODS and (folder or not colon):
        method = METHODS[method_name]
        if isinstance(method, WeightsMethod):
            return method.with_weights(Path(folder).expanduser() if folder else None)
        if not colon:
            return method
    path, colon, attribute = name.rpartition(":")
    if colon and path.endswith(".py"):
        module = _import_file(Path(path))
        if not hasattr(module, attribute):
            raise MethodError(f"{path}: has no {attribute}, expected the name of a method in it")
        return _with_file_digest(Path(path), _require_method(name, getattr(module, attribute)))
    if name.endswith(".py"):
        raise MethodError(f"{name}: names no method in the file, expected {name}:METHOD")
    if name.endswith(".toml"):
        from rebar_depth_bench.methods.onnx.model import onnx_method

        return onnx_method(Path(name), view_timeout_s)
    entries = _entry_point_methods()
    if name in entries:
        return _load_entry_point(entries[name])
    known = ", ".join((*METHODS, *entries))
    raise MethodError(
        f"unknown method {name!r}, expected one of {known}, or my_model.py:METHOD, my_model.toml, hf:ORG/NAME, "
        f"or NAME:FOLDER for one of {', '.join(FROM_FOLDER)}"
    )


def all_methods() -> dict[str, AnyMethod | MethodError]:
    """Return all built-in and entry-point methods by name; for entry points that cannot be loaded, the error."""
    methods: dict[str, AnyMethod | MethodError] = dict(METHODS)
    for name, entry in _entry_point_methods().items():
        try:
            methods[name] = _load_entry_point(entry)
        except MethodError as error:
            methods[name] = error
    return methods


def own_methods() -> dict[str, AnyMethod]:
    """Return the methods of this distribution by name: built-in ones and its own entry points."""
    own = {
        name: _load_entry_point(entry)
        for name, entry in _entry_point_methods().items()
        if entry.dist and entry.dist.name == DISTRIBUTION
    }
    return {**METHODS, **own}


def _entry_point_methods() -> dict[str, EntryPoint]:
    """Return entry points by name; built-in names take precedence."""
    return {entry.name: entry for entry in entry_points(group=ENTRY_POINT_GROUP) if entry.name not in METHODS}


def _load_entry_point(entry: EntryPoint) -> AnyMethod:
    """Return the method of an entry point. Raises ``MethodError`` if it cannot be imported or is no method."""
    try:
        value = entry.load()
    except Exception as error:  # Importing third-party modules may raise anything.
        raise _import_error(f"{entry.name}: {entry.value}", error) from error
    return _require_method(entry.name, value)


def _import_error(where: str, error: Exception) -> MethodError:
    """Return the error of an import; an error of a ``MethodInfo`` keeps its words."""
    reason = error if isinstance(error, MethodError) else f"cannot be imported: {exception_summary(error)}"
    return MethodError(f"{where}: {reason}")


def _with_file_digest(path: Path, method: AnyMethod) -> AnyMethod:
    """Return the method with the file's digest appended to ``info.source``.

    A resumed run therefore never mixes predictions of two versions of the file.
    """
    source = f"{method.info.source} ({path.name} sha256:{file_sha256(path)[:_DIGEST_CHARACTERS]})"
    return replace(method, info=replace(method.info, source=source))


def _import_file(path: Path) -> ModuleType:
    """Import a Python file as a module; its folder stays the first of ``sys.path``, as for a script.

    Files beside it can thus also be imported when the method is loaded. The process writes no bytecode from then
    on, so that no ``__pycache__`` appears beside them.

    Raises ``MethodError`` if the file is missing or cannot be imported.
    """
    if not path.is_file():
        raise MethodError(f"{path}: no such file, expected a Python file that defines a method")
    name, folder, before = _module_name(path), str(path.resolve().parent), list(sys.path)
    spec = importlib.util.spec_from_file_location(name, path.resolve())
    if spec is None or spec.loader is None:
        raise MethodError(f"{path}: is not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # Dataclasses and pickle look it up.
    sys.path[:] = [folder, *(other for other in before if other != folder)]
    sys.dont_write_bytecode = True
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        sys.path[:] = before
        raise _import_error(str(path), error) from error
    return module


def _module_name(path: Path) -> str:
    """Return the stem of a file, or a longer name if another module has that name."""
    name, file = path.stem, path.resolve()
    spec = PathFinder.find_spec(name)
    files = {spec.origin} if spec else set()
    if name in sys.modules:
        files.add(getattr(sys.modules[name], "__file__", None))
    return name if files <= {str(file)} else f"{name} in {file.parent}"


def _require_method(name: str, value: object) -> AnyMethod:
    """Return ``value`` if it is a method, else raise ``MethodError``."""
    if not isinstance(value, Method | MultiViewMethod):
        raise MethodError(f"{name}: is {type(value).__name__}, expected a rebar_depth_bench.methods.Method")
    return value
