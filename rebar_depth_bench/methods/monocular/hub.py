"""Hugging Face Hub downloads, and methods whose weights are on the Hub and whose code is in an author's package.

Cached snapshots are local folders named after their commit; downloads are announced on standard error.

A bare method name refers to the main branch of the repository, as the cache knows it. No commit is pinned because
none was tested. The commit in use is part of the method's summary and thus of a submission.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rebar_depth_bench.errors import MethodError, exception_summary
from rebar_depth_bench.methods.base import Method, MethodInfo, Predictor
from rebar_depth_bench.methods.monocular.third_party import (
    check_folder,
    check_weights_loaded,
    import_package,
    import_torch,
    safetensors_names,
    translate_errors,
    with_weights_digest,
)


def snapshot(repository: str, file: str, local_hint: str) -> Path:
    """Return the cached snapshot of a model's main branch with at least ``file``; the folder name is the commit.

    ``file`` is downloaded, after a notice, only if no snapshot is cached. ``local_hint`` is the advice in error
    messages on how to use a local copy (``local_copy_hint``).

    Raises ``MethodError`` if the download fails.
    """
    from huggingface_hub import get_hf_file_metadata, hf_hub_download, hf_hub_url
    from huggingface_hub.errors import LocalEntryNotFoundError

    try:
        return Path(hf_hub_download(repository, file, local_files_only=True)).parent
    except LocalEntryNotFoundError:
        pass
    with hub_download(repository, file, local_hint):
        get_hf_file_metadata(hf_hub_url(repository, file))  # Without an answer, the download would try six times.
        return Path(hf_hub_download(repository, file)).parent


def complete_snapshot(repository: str, folder: Path, files: Sequence[str], local_hint: str) -> None:
    """Download those of ``files`` that are missing in a snapshot, at its commit even if the main branch has moved.

    Raises ``MethodError`` if the download fails.
    """
    from huggingface_hub import snapshot_download

    missing = [name for name in files if not (folder / name).is_file()]
    if not missing:
        return
    with hub_download(repository, " and ".join(missing), local_hint):
        snapshot_download(repository, revision=folder.name, allow_patterns=missing)
    for name in missing:  # snapshot_download ignores files that the Hub does not list.
        if not (folder / name).is_file():
            raise MethodError(f"{repository}: no {name} at commit {folder.name}, expected {' and '.join(files)}")


@contextmanager
def hub_download(repository: str, what: str, local_hint: str) -> Iterator[None]:
    """Announce a download from the Hub, and convert all of its errors into ``MethodError``."""
    from huggingface_hub import constants

    announce_download(repository, what, constants.ENDPOINT, local_hint)
    try:
        yield
    except Exception as error:  # huggingface_hub raises its own, httpx and OS errors.
        access = "a network connection (and HF_TOKEN if the model is not public)"
        raise download_error(repository, constants.ENDPOINT, error, local_hint, access) from None


def local_copy_hint(prefix: str, repository: str) -> str:
    """Return the advice on how to make and name a local copy, for a method that takes ``PREFIX:FOLDER``."""
    return f"{prefix}:FOLDER (hf download {repository} --local-dir FOLDER)"


def announce_download(name: str, what: str, url: str, local_hint: str) -> None:
    """Print a download notice to standard error. Raises ``MethodError`` if ``HF_HUB_OFFLINE`` is set."""
    from huggingface_hub import constants

    if constants.HF_HUB_OFFLINE:
        raise MethodError(
            f"{name}: {what} must be downloaded, but HF_HUB_OFFLINE is set: unset it, or download the files on "
            f"another machine and pass their folder: {local_hint}"
        )
    print(f"{name}: downloading {what} from {url}", file=sys.stderr, flush=True)


def download_error(
    name: str, url: str, error: Exception, local_hint: str, access: str = "a network connection"
) -> MethodError:
    """Return the error of a failed download; ``access`` describes the requirements."""
    return MethodError(
        f"{name}: cannot be downloaded from {url}: {exception_summary(error)}; expected {access}, or a local "
        f"copy: {local_hint}"
    )


CONFIG, WEIGHTS = "config.json", "model.safetensors"
REQUIRED_FILES = (CONFIG, WEIGHTS)
"""Files that ``PyTorchModelHubMixin`` reads and that a folder must hold."""


def accept_any_config(_: Path) -> None:
    """Accept a folder with any ``config.json``."""


@dataclass(frozen=True)
class HubModel:
    """Network with weights on the Hub.

    ``load(folder)`` returns the predictor of a folder with ``REQUIRED_FILES``; ``check(folder)`` raises
    ``MethodError`` if ``config.json`` in the folder belongs to another network.
    """

    info: MethodInfo
    repository: str
    package: str
    install: str
    load: Callable[[Path], Predictor]
    check: Callable[[Path], None] = accept_any_config


def load_network(name: str, module: str, network: str, install: str, folder: Path) -> tuple[Any, Any]:
    """Return torch, and the class ``network`` of a package's module with the weights of a folder.

    The network runs on the GPU if torch finds one. Raises ``MethodError`` if torch or the package is missing, or
    if the weights are incomplete.
    """
    torch = import_torch(name)
    package = import_package(module, name, install)
    with translate_errors(name, torch, f"{folder.name} cannot be loaded"):
        model = getattr(package, network).from_pretrained(str(folder), local_files_only=True)
        return torch, check_weights_loaded(name, torch, model, safetensors_names(folder / WEIGHTS))


def hub_method(model: HubModel) -> Method:
    """Return the method with weights from the Hub, downloaded when it is loaded; the commit is in its summary.

    Only ``config.json`` is downloaded here, if it is not cached, because it is needed to determine the commit.

    Raises ``MethodError`` if the package is not installed or the download fails.
    """
    _require_package(model)  # Checked first, so that nothing is downloaded in vain.
    local_hint = local_copy_hint(model.info.name, model.repository)
    folder = snapshot(model.repository, CONFIG, local_hint)
    model.check(folder)

    def load() -> Predictor:
        complete_snapshot(model.repository, folder, REQUIRED_FILES, local_hint)
        return model.load(folder)

    return Method(replace(model.info, summary=f"{model.info.summary}; weights commit {folder.name}"), load)


def _require_package(model: HubModel) -> None:
    """Raise ``MethodError`` if the network's package is not installed."""
    if find_spec(model.package) is None:
        raise MethodError(f"{model.info.name} needs {model.package}, which is not installed: {model.install}")


def folder_method(model: HubModel, folder: Path) -> Method:
    """Return the method with weights from a folder; their digest is in its summary.

    Raises ``MethodError`` if files are missing or belong to another network.
    """
    check_folder(folder, model.info.name, REQUIRED_FILES)
    info = with_weights_digest(model.info, folder.resolve().name, [folder / name for name in REQUIRED_FILES])
    model.check(folder)
    return Method(info, lambda: model.load(folder))


def lazy_hub_method(model: HubModel) -> Method:
    """Return the method for listings; nothing is looked up or downloaded before it is loaded."""
    name, summary = model.info.name, model.info.summary
    info = replace(model.info, summary=f"{summary}; own weights: {name}:FOLDER")
    return Method(info, lambda: hub_method(model).load())
