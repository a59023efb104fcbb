"""Models of the Hub as local folders, never fetched silently; the folder's name is the commit.

Methods whose network comes from an author's package and whose weights from the Hub, or from a folder like it.

By bare name the Hub's main branch is taken, as its cache knows it: no commit is pinned, for none was tried where
this was written. The commit that is taken stands in the method's summary, and with it in a submission.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods.base import Method, MethodInfo, Predictor
from rebar_depth_bench.methods.monocular.third_party import check_folder, with_weights

HUB_ACCESS = "a connection, HF_TOKEN for a model that is not public"


def snapshot(repository: str, file: str, instead: str) -> Path:
    """Return the Hub's cached snapshot of a model's main branch, with at least ``file``; its name is the commit.

    Only where the cache has none is ``file`` fetched, and said first. ``instead`` is what to name where the model
    is in a folder of one's own (``local_copy``).

    Raises ``MethodError`` where it is not to be had.
    """
    from huggingface_hub import constants, hf_hub_download
    from huggingface_hub.errors import LocalEntryNotFoundError

    try:
        return Path(hf_hub_download(repository, file, local_files_only=True)).parent
    except LocalEntryNotFoundError:
        pass
    announce(repository, file, constants.ENDPOINT, instead)
    try:
        return Path(hf_hub_download(repository, file)).parent
    except Exception as error:  # the Hub's client raises its own, httpx's and the system's
        raise unavailable(repository, constants.ENDPOINT, error, instead, HUB_ACCESS) from None


def complete_snapshot(repository: str, folder: Path, files: Sequence[str], instead: str) -> None:
    """Fetch what a snapshot lacks of ``files``, at its own commit, whatever the main branch is by now.

    Raises ``MethodError`` where they are not to be had.
    """
    from huggingface_hub import constants, snapshot_download

    lacking = [name for name in files if not (folder / name).is_file()]
    if not lacking:
        return
    announce(repository, " and ".join(lacking), constants.ENDPOINT, instead)
    try:
        snapshot_download(repository, revision=folder.name, allow_patterns=lacking)
    except Exception as error:
        raise unavailable(repository, constants.ENDPOINT, error, instead, HUB_ACCESS) from None
    for name in lacking:  # a file that the Hub does not list is passed over without a word
        if not (folder / name).is_file():
            raise MethodError(f"{repository}: no {name} at commit {folder.name}, expected {' and '.join(files)}")


def local_copy(prefix: str, repository: str) -> str:
    """Return how a copy of a model is made and named, for a method that takes ``PREFIX:FOLDER``."""
    return f"{prefix}:FOLDER (hf download {repository} --local-dir FOLDER)"


def announce(name: str, what: str, where: str, instead: str) -> None:
    """Say what is fetched from where. Raises ``MethodError`` where ``HF_HUB_OFFLINE`` forbids it."""
    from huggingface_hub import constants

    if constants.HF_HUB_OFFLINE:
        raise MethodError(
            f"{name}: {what} not on this machine, and HF_HUB_OFFLINE is set: unset it, or fetch them elsewhere "
            f"and name their folder: {instead}"
        )
    print(f"{name}: fetching {what} from {where}", file=sys.stderr, flush=True)


def unavailable(
    name: str, where: str, error: Exception, instead: str, access: str = "a connection"
) -> MethodError:
    """Return what to raise where something could not be fetched; ``access`` is what that takes."""
    first = (str(error).strip().splitlines() or [""])[0]
    return MethodError(
        f"{name}: cannot be fetched from {where}: {type(error).__name__}: {first}; expected {access}, or a local "
        f"copy: {instead}"
    )


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
