"""Methods whose network comes from an author's package and whose weights from the Hub, or from a folder like it.

By bare name the Hub's main branch is taken, as its cache knows it: no commit is pinned, for none was tried where
this was written. The commit that is taken stands in the method's summary, and with it in a submission.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods.foreign_code import check_folder, with_weights
from rebar_depth_bench.methods.hub_folders import complete_snapshot, local_copy, snapshot
from rebar_depth_bench.methods.method import Method, MethodInfo, Predictor

CONFIG, WEIGHTS = "config.json", "model.safetensors"
FILES = (CONFIG, WEIGHTS)
"""What ``PyTorchModelHubMixin`` reads, and what a folder has to hold."""


def any_config(_: Path) -> None:
    """Take a folder with any ``config.json``."""


@dataclass(frozen=True)
class HubModel:
    """A network, and where on the Hub its weights lie.

    ``load(folder)`` makes its predictor of a folder with ``FILES``; ``check(folder)`` raises ``MethodError`` where
    the folder's ``config.json`` is that of another network.
    """

    info: MethodInfo
    repository: str
    package: str
    install: str
    load: Callable[[Path], Predictor]
    check: Callable[[Path], None] = any_config


def hub_method(model: HubModel) -> Method:
    """Return the method of the Hub's weights, fetched when it is loaded; the commit is in its summary.

    Only ``config.json`` is fetched here, where the Hub's cache has none: the commit is not to be known without it.

    Raises ``MethodError`` where it is not to be had.
    """
    _require(model)  # before anything is fetched for nothing
    instead = local_copy(model.info.name, model.repository)
    folder = snapshot(model.repository, CONFIG, instead)
    model.check(folder)

    def load() -> Predictor:
        complete_snapshot(model.repository, folder, FILES, instead)
        return model.load(folder)

    return Method(replace(model.info, summary=f"{model.info.summary}; weights commit {folder.name}"), load)


def _require(model: HubModel) -> None:
    if find_spec(model.package) is None:
        raise MethodError(f"{model.info.name} needs {model.package}, which is not installed: {model.install}")


def folder_method(model: HubModel, folder: Path) -> Method:
    """Return the method of the weights in a folder, their digest in its summary.

    Raises ``MethodError`` for a folder without them, or with those of another network.
    """
    check_folder(folder, model.info.name, FILES)
    info = with_weights(model.info, folder.resolve().name, [folder / name for name in FILES])
    model.check(folder)
    return Method(info, lambda: model.load(folder))


def listed_method(model: HubModel) -> Method:
    """Return the method as it is listed, for which nothing is looked up or fetched before it is loaded."""
    name, summary = model.info.name, model.info.summary
    info = replace(model.info, summary=f"{summary}; own weights: {name}:FOLDER")
    return Method(info, lambda: hub_method(model).load())
