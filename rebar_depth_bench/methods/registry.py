"""Where methods come from: the bench, an installed package's entry point, a checkpoint, or a file of the user's.

A package offers its methods as entry points of the group ``rebar_depth_bench.methods``; a Python file is named
with the method in it, ``my_model.py:METHOD``; a TOML file describes an ONNX model; ``hf:`` names a checkpoint of
``transformers``, ``NAME:FOLDER`` a folder with the weights of one of the paper's other networks (``LOCATED``).
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType

from rebar_depth_bench.data.digests import file_sha256
from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods.base import AnyMethod, Method, MultiViewMethod
from rebar_depth_bench.methods.controls import BOARD_PLANE, CONSTANT, NOISY_TRUTH, TRUTH
from rebar_depth_bench.methods.huggingface.model import DEPTH_PRO, PREFIX, depth_pro_method, hf_method
from rebar_depth_bench.methods.monocular.depth_anything_3 import DEPTH_ANYTHING_3, DEPTH_ANYTHING_3_MODEL
from rebar_depth_bench.methods.monocular.hub import folder_method, hub_method
from rebar_depth_bench.methods.monocular.metric3d import METRIC3D, cached_metric3d_method, metric3d_method
from rebar_depth_bench.methods.monocular.unidepth import UNIDEPTH, UNIDEPTH_MODEL
from rebar_depth_bench.methods.multiview import COLMAP_ANCHORED, COLMAP_ARUCO, SWEEP_ANCHORED, SWEEP_ARUCO
from rebar_depth_bench.methods.onnx.model import onnx_method
from rebar_depth_bench.methods.stereo.foundation_stereo import FOUNDATION_STEREO, foundation_stereo_method
from rebar_depth_bench.methods.stereo.sgbm import SGBM, SGBM_FILLED

GROUP = "rebar_depth_bench.methods"
DISTRIBUTION = "rebar-depth-bench"
_DIGITS = 16

METHODS: Mapping[str, AnyMethod] = {
    method.info.name: method
    for method in (
        *(SGBM, SGBM_FILLED, FOUNDATION_STEREO),
        *(DEPTH_PRO, METRIC3D, UNIDEPTH, DEPTH_ANYTHING_3),
        *(COLMAP_ARUCO, COLMAP_ANCHORED, SWEEP_ARUCO, SWEEP_ANCHORED),
        *(CONSTANT, BOARD_PLANE, NOISY_TRUTH, TRUTH),
    )
}
"""Those that come with the bench."""

LOCATED: Mapping[str, Callable[[Path], Method]] = {
    "depth-anything-3": partial(folder_method, DEPTH_ANYTHING_3_MODEL),
    "foundation-stereo": foundation_stereo_method,
    "metric3d": metric3d_method,
    "unidepth": partial(folder_method, UNIDEPTH_MODEL),
}
"""Those that take their weights, or code and weights, from a folder: ``NAME:FOLDER``."""

RESOLVED: Mapping[str, Callable[[], Method]] = {
    "depth-anything-3": partial(hub_method, DEPTH_ANYTHING_3_MODEL),
    "depth-pro": depth_pro_method,
    "metric3d": cached_metric3d_method,
    "unidepth": partial(hub_method, UNIDEPTH_MODEL),
}
"""Those whose weights are looked up when they are asked for by their bare name: the commit or digest of what is
run goes into their summary. Listing them looks nothing up."""


def find_method(name: str) -> AnyMethod:
    """Return a method by its name, from a file by ``path.py:NAME`` or ``path.toml``, from a folder by
    ``NAME:FOLDER`` (``LOCATED``), or by ``hf:ORG/NAME``.

    What says which weights these are may be fetched here, where no cache has it (``RESOLVED``, ``hf:``).

    Raises ``MethodError`` for an unknown one, and where a file or package cannot be imported or holds none.
    """
    if name.startswith(PREFIX):
        return hf_method(name.removeprefix(PREFIX))
    known_as, _, place = name.partition(":")
    if place and known_as in LOCATED:
        return LOCATED[known_as](Path(place).expanduser())
    path, colon, attribute = name.rpartition(":")
    if colon and path.endswith(".py"):
        module = _module(Path(path))
        if not hasattr(module, attribute):
            raise MethodError(f"{path}: has no {attribute}, expected the name of a method in it")
        return _of_file(Path(path), _checked(name, getattr(module, attribute)))
    if name.endswith(".toml"):
        return onnx_method(Path(name))
    if name in RESOLVED:
        return RESOLVED[name]()
    if name in METHODS:
        return METHODS[name]
    offered = _offered()
    if name in offered:
        return _loaded(offered[name])
    known = ", ".join((*METHODS, *offered))
    raise MethodError(
        f"no method {name!r}, expected one of {known}, or a file's like my_model.py:METHOD or "
        f"my_model.toml, or hf:ORG/NAME, or a folder for one of {', '.join(LOCATED)}: NAME:FOLDER"
    )


def all_methods() -> dict[str, AnyMethod | MethodError]:
    """Return every method by name; of a package whose method cannot be loaded, why."""
    found: dict[str, AnyMethod | MethodError] = dict(METHODS)
    for name, entry in _offered().items():
        try:
            found[name] = _loaded(entry)
        except MethodError as error:
            found[name] = error
    return found


def own_methods() -> dict[str, AnyMethod]:
    """Return the methods of this distribution by name: the bench's, and those its other packages offer."""
    offered = {name: entry for name, entry in _offered().items() if entry.dist and entry.dist.name == DISTRIBUTION}
    return {**METHODS, **{name: _loaded(entry) for name, entry in offered.items()}}


def _offered() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=GROUP) if entry.name not in METHODS}


def _loaded(entry: EntryPoint) -> AnyMethod:
    try:
        value = entry.load()
    except Exception as error:  # whatever a stranger's module raises when it is imported
        raise MethodError(f"{entry.name}: {entry.value} cannot be imported: {_words(error)}") from error
    return _checked(entry.name, value)


def _of_file(path: Path, method: AnyMethod) -> AnyMethod:
    """Name the file's digest in the source: a run that goes on does not mix what two versions answered."""
    source = f"{method.info.source} ({path.name} sha256:{file_sha256(path)[:_DIGITS]})"
    return replace(method, info=replace(method.info, source=source))


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


def _checked(name: str, value: object) -> AnyMethod:
    if not isinstance(value, Method | MultiViewMethod):
        raise MethodError(f"{name}: is {type(value).__name__}, expected a rebar_depth_bench.methods.Method")
    return value


def _words(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"
