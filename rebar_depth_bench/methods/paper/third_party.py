"""Helpers for running third-party model code: import, weight checks and error translation.

The code is executed unchanged, and so is any code in pickled checkpoints: users must trust the folders they name.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Num
from numpy import ndarray

from rebar_depth_bench.data.files import files_digest
from rebar_depth_bench.errors import MethodError, Problem, exception_summary
from rebar_depth_bench.limits import JSON_BYTES
from rebar_depth_bench.methods.base import Method, MethodInfo, Predictor
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


# Hugging Face Hub downloads, and methods whose weights are on the Hub and whose code is in an author's package.
#
# Cached snapshots are local folders named after their commit; downloads are announced on standard error.
#
# A bare method name refers to the main branch of the repository, as the cache knows it. No commit is pinned
# because none was tested. The commit in use is part of the method's summary and thus of a submission.


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
