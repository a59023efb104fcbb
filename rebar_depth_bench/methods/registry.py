"""Registry of methods: built-in methods, entry points of installed packages, checkpoints and users' files.

Names are resolved as follows:

- ``hf:ORG/NAME`` or ``hf:FOLDER``: a checkpoint of ``transformers``;
- ``NAME:FOLDER``: a network of the paper with its weights, or code and weights, in a folder (``FROM_FOLDER``);
- ``my_model.py:METHOD``: a method defined in a Python file;
- ``my_model.toml``: an ONNX model described by a TOML file;
- any other name: a built-in method, or an entry point of the group ``rebar_depth_bench.methods``.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from importlib.machinery import PathFinder
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType

from rebar_depth_bench.data.files import file_sha256
from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods.base import AnyMethod, Method, MultiViewMethod
from rebar_depth_bench.methods.controls import BOARD_PLANE, CONSTANT, NOISY_TRUTH, TRUTH
from rebar_depth_bench.methods.monocular.hub import folder_method, hub_method
from rebar_depth_bench.methods.monocular.hub_networks import (
    DEPTH_ANYTHING_3,
    DEPTH_ANYTHING_3_MODEL,
    UNIDEPTH,
    UNIDEPTH_MODEL,
)
from rebar_depth_bench.methods.monocular.metric3d import METRIC3D, cached_metric3d_method, metric3d_method
from rebar_depth_bench.methods.multiview import COLMAP_ANCHORED, COLMAP_ARUCO, SWEEP_ANCHORED, SWEEP_ARUCO
from rebar_depth_bench.methods.onnx.model import onnx_method
from rebar_depth_bench.methods.onnx.session import VIEW_TIMEOUT_S
from rebar_depth_bench.methods.stereo.foundation_stereo import FOUNDATION_STEREO, foundation_stereo_method
from rebar_depth_bench.methods.stereo.sgbm import SGBM, SGBM_FILLED
from rebar_depth_bench.methods.transformers.model import DEPTH_PRO, HF_PREFIX, depth_pro_method, hf_method

ENTRY_POINT_GROUP = "rebar_depth_bench.methods"
DISTRIBUTION = "rebar-depth-bench"
_DIGEST_CHARACTERS = 16

METHODS: Mapping[str, AnyMethod] = {
    method.info.name: method
    for method in (
        *(SGBM, SGBM_FILLED, FOUNDATION_STEREO),
        *(DEPTH_PRO, METRIC3D, UNIDEPTH, DEPTH_ANYTHING_3),
        *(COLMAP_ARUCO, COLMAP_ANCHORED, SWEEP_ARUCO, SWEEP_ANCHORED),
        *(CONSTANT, BOARD_PLANE, NOISY_TRUTH, TRUTH),
    )
}
"""Built-in methods by name."""

FROM_FOLDER: Mapping[str, Callable[[Path], Method]] = {
    "depth-anything-3": partial(folder_method, DEPTH_ANYTHING_3_MODEL),
    "foundation-stereo": foundation_stereo_method,
    "metric3d": metric3d_method,
    "unidepth": partial(folder_method, UNIDEPTH_MODEL),
}
"""Constructors of methods whose weights, or code and weights, are in a folder: ``NAME:FOLDER``."""

FROM_HUB: Mapping[str, Callable[[], Method]] = {
    "depth-anything-3": partial(hub_method, DEPTH_ANYTHING_3_MODEL),
    "depth-pro": depth_pro_method,
    "metric3d": cached_metric3d_method,
    "unidepth": partial(hub_method, UNIDEPTH_MODEL),
}
"""Constructors of methods whose weights are looked up when the bare name is requested.

The commit or digest of the weights (and code) becomes part of the summary. Listing methods looks nothing up.
"""


def find_method(name: str, *, view_timeout_s: float = VIEW_TIMEOUT_S, nearest_m: float | None = None) -> AnyMethod:
    """Return the method of a name; the module docstring lists the accepted forms.

    ``view_timeout_s`` limits the inference of a view by an ONNX model. ``nearest_m`` declares the distance of the
    nearest surface, metres, to FoundationStereo.

    For ``FROM_HUB`` and ``hf:`` names, the files that identify the weights are downloaded if they are not cached.

    Raises ``MethodError`` if the name is unknown, if a file or package cannot be imported or holds no method, or
    if ``nearest_m`` is given to another method.
    """
    method_name, _, folder = name.partition(":")
    if nearest_m is not None:
        if method_name != FOUNDATION_STEREO.info.name or not folder:
            raise MethodError(f"{name}: has no nearest distance, expected {FOUNDATION_STEREO.info.name}:FOLDER")
        return foundation_stereo_method(Path(folder).expanduser(), nearest_m)
    if name.startswith(HF_PREFIX):
        return hf_method(name.removeprefix(HF_PREFIX))
    if folder and method_name in FROM_FOLDER:
        return FROM_FOLDER[method_name](Path(folder).expanduser())
    path, colon, attribute = name.rpartition(":")
    if colon and path.endswith(".py"):
        module = _import_file(Path(path))
        if not hasattr(module, attribute):
            raise MethodError(f"{path}: has no {attribute}, expected the name of a method in it")
        return _with_file_digest(Path(path), _require_method(name, getattr(module, attribute)))
    if name.endswith(".toml"):
        return onnx_method(Path(name), view_timeout_s)
    if name in FROM_HUB:
        return FROM_HUB[name]()
    if name in METHODS:
        return METHODS[name]
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
    entries = {
        name: entry
        for name, entry in _entry_point_methods().items()
        if entry.dist and entry.dist.name == DISTRIBUTION
    }
    return {**METHODS, **{name: _load_entry_point(entry) for name, entry in entries.items()}}


def _entry_point_methods() -> dict[str, EntryPoint]:
    """Return entry points by name; built-in names take precedence."""
    return {entry.name: entry for entry in entry_points(group=ENTRY_POINT_GROUP) if entry.name not in METHODS}


def _load_entry_point(entry: EntryPoint) -> AnyMethod:
    """Return the method of an entry point. Raises ``MethodError`` if it cannot be imported or is no method."""
    try:
        value = entry.load()
    except Exception as error:  # Importing third-party modules may raise anything.
        raise MethodError(f"{entry.name}: {entry.value} cannot be imported: {_error_text(error)}") from error
    return _require_method(entry.name, value)


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
        raise MethodError(f"{path}: cannot be imported: {_error_text(error)}") from error
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


def _error_text(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"
