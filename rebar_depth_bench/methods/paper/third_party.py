"""Networks that run with their authors' code: imports, weights, downloads, and translated errors.

The code is executed unchanged, and so is any code in pickled checkpoints: users must trust the folders they name.

A bare method name refers to the main branch of a repository on the Hub, as its cache knows it. No commit is pinned
because none was tested. The commit in use is part of the method's summary and thus of a submission.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Num, UInt8
from numpy import ndarray

from rebar_depth_bench.base.errors import MethodError, Problem, exception_summary, library_message
from rebar_depth_bench.base.limits import JSON_BYTES
from rebar_depth_bench.base.reading import parse_json, read_file
from rebar_depth_bench.base.validation import short_repr
from rebar_depth_bench.methods.base import Method, MethodInfo, WeightsMethod

if TYPE_CHECKING:
    from torch import Tensor

MIN_LOADED_FRACTION = 0.99
"""Smallest fraction of a network's parameters that a checkpoint must contain; an unused token may be missing."""
CONFIG, WEIGHTS = "config.json", "model.safetensors"
"""Files that ``PyTorchModelHubMixin`` reads and that a folder must hold."""


@dataclass(frozen=True)
class Network:
    """Network with its authors' code. ``install`` is the advice on how to install what the code imports."""

    info: MethodInfo
    install: str

    def listed(self, method: Callable[[Path | None], Method], addition: str) -> WeightsMethod:
        """Return the method for listings, with ``addition`` to its summary; nothing is looked up for it."""
        info = replace(self.info, summary=f"{self.info.summary}; {addition}")
        return WeightsMethod(info, lambda: method(None).load(), with_weights=method)

    def check_folder(self, folder: Path, *required_files: str) -> None:
        """Raise ``MethodError`` unless a folder contains these files."""
        if missing := [file for file in required_files if not (folder / file).is_file()]:
            found = f"no {missing[0]} in it" if folder.is_dir() else "no such folder"
            raise MethodError(f"{self.info.name}:{folder}: {found}, expected {' and '.join(required_files)}")

    def find_weights(
        self, folder: Path | None, repository: str, package: str, keys: Sequence[str], variant: str
    ) -> tuple[MethodInfo, Path]:
        """Return the description with the given weights, and the folder of their ``config.json``.

        It is that of the user, or for None a snapshot of a repository of the Hub with at least this file.
        ``variant`` is the value that it must have under ``keys``, which are nested: the paper's network. Raises
        ``MethodError`` if files are missing or belong to another network, if the download fails, or for None, if
        the package is missing.
        """
        if folder is None:
            if find_spec(package) is None:  # Nothing is downloaded in vain.
                raise MethodError(f"{self.info.name} needs {package}, which is not installed: {self.install}")
            found = snapshot(repository, CONFIG, local_copy_hint(self.info.name, repository))
            info = replace(self.info, summary=f"{self.info.summary}; weights commit {found.name}")
        else:
            found = folder
            self.check_folder(folder, CONFIG, WEIGHTS)
            info = replace(self.info, name=f"{self.info.name}:{folder.resolve().name}")
        value: Any = read_json_object(found / CONFIG)
        for key in keys:
            value = value.get(key) if isinstance(value, dict) else None
        if value != variant:
            wrong = f"{'.'.join(keys)} in {CONFIG} is {short_repr(value)}"
            raise MethodError(f"{self.info.name}:{found}: {wrong}, expected {variant!r}, the paper's network")
        return info, found

    def load_pretrained(self, network_class: Any, folder: Path, repository: str) -> Any:
        """Return the model of a class with the weights in a folder; a snapshot without them is completed."""
        from safetensors import safe_open

        if not (folder / WEIGHTS).is_file():
            snapshot(repository, WEIGHTS, local_copy_hint(self.info.name, repository), revision=folder.name)
        with self.errors(f"{folder.name} cannot be loaded"):
            model = network_class.from_pretrained(str(folder), local_files_only=True)
            with safe_open(folder / WEIGHTS, framework="pt") as tensors:
                return self.with_loaded_weights(model, tensors.keys())

    def import_package(self, module: str, install: str) -> Any:
        """Import and return a module.

        Raises ``MethodError`` with install instructions if its package is missing, and with the cause if the
        package is present but cannot be imported, for example because a package that it imports is missing.
        """
        package = module.partition(".")[0]
        try:
            with redirect_stdout(sys.stderr):
                return importlib.import_module(module)
        except Exception as error:  # Third-party code may raise anything.
            if isinstance(error, ModuleNotFoundError) and str(error.name).partition(".")[0] == package:
                raise MethodError(f"{self.info.name} needs {package} ({error}): {install}") from None
            found = f"{package} is installed but cannot be imported: {_describe(error, install)}"
            raise MethodError(f"{self.info.name}: {found}") from error

    @contextmanager
    def errors(self, doing: str) -> Iterator[None]:
        """Run third-party code with its output sent to standard error and its exceptions as ``MethodError``.

        ``doing`` describes the failed operation. The message states explicitly if the code requires CUDA and
        torch finds no GPU.
        """
        try:
            with redirect_stdout(sys.stderr):
                yield
        except MethodError:
            raise
        except Exception as error:
            raise MethodError(f"{self.info.name}: {doing}: {_describe(error, self.install)}") from error

    def with_loaded_weights(self, model: Any, loaded_names: Iterable[str]) -> Any:
        """Return a model in evaluation mode, on the GPU if torch finds one, after checking its loaded weights.

        ``loaded_names`` are the parameter names in the checkpoint. Authors' code silently leaves missing
        parameters at random values. Raises ``MethodError`` if the checkpoint contains less than
        ``MIN_LOADED_FRACTION`` of the parameters; other missing ones are listed on standard error.
        """
        names, sizes = set(loaded_names), {name: values.numel() for name, values in model.named_parameters()}
        loaded = {id(values) for name, values in model.named_parameters(remove_duplicate=False) if name in names}
        missing = [name for name, values in model.named_parameters() if id(values) not in loaded]
        fraction = 1 - sum(sizes[name] for name in missing) / max(sum(sizes.values()), 1)
        covered = f"the weights cover {fraction:.2%} of the network, {len(missing)} tensors are missing"
        message = f"{self.info.name}: {covered}"
        if missing and fraction < MIN_LOADED_FRACTION:
            raise MethodError(f"{message}, first {missing[0]}, expected the weights of this network")
        if missing:
            print(f"{message}: {', '.join(missing)}", file=sys.stderr, flush=True)
        return model.to(torch_device()).eval()

    def load_checkpoint(self, model: Any, path: Path, key: str, *, strict: bool = True) -> Any:
        """Return a model with the weights under ``key`` of a pickled checkpoint; see ``with_loaded_weights``."""
        import torch

        weights = torch.load(path, map_location="cpu", weights_only=False)[key]
        model.load_state_dict(weights, strict=strict)
        return self.with_loaded_weights(model, weights)

    def check_shape(self, shape: Sequence[int], expected: Sequence[int]) -> None:
        """Raise ``MethodError`` unless the network's depth has the shape ``expected``."""
        if tuple(shape) != tuple(expected):
            found = f"the network returned depth of shape {tuple(shape)}"
            raise MethodError(f"{self.info.name}: {found}, expected {tuple(expected)}")


def _describe(error: Exception, install: str) -> str:
    """Return the message of a third-party exception, with advice for well-known causes."""
    message = f"{type(error).__name__}: {library_message(error)}"
    if isinstance(error, ImportError):
        return f"{message}; to install what its code imports: {install}"
    if "torchvision::" in message:  # Raised by the import of a torchvision that does not fit torch.
        return f"{message}; install torch and torchvision of one release, both for the CPU or for the same CUDA"
    is_cuda = "cuda" in message.lower() or "nvidia" in message.lower()
    if is_cuda and torch_device() == "cpu":
        return f"its code requires a CUDA GPU, and torch finds none ({message})"
    return message


@contextmanager
def on_sys_path(folder: Path) -> Iterator[None]:
    """Put a folder first on ``sys.path``, as for a script in it."""
    sys.path.insert(0, str(folder.resolve()))
    try:
        yield
    finally:
        sys.path.remove(str(folder.resolve()))


def torch_device() -> str:
    """Return the name of the torch device to use."""
    import torch

    return "cuda" if torch.cuda.is_available() else "cpu"


def image_tensor(rgb: Num[ndarray, "h w 3"]) -> Float[Tensor, "1 3 h w"]:
    """Return an image as a float32 tensor with the same values. Needs torch."""
    import torch

    return torch.from_numpy(rgb.transpose(2, 0, 1).astype(np.float32))[None]


def scaled_image(rgb: UInt8[ndarray, "h w 3"], scale: float) -> UInt8[ndarray, "hs ws 3"]:
    """Return an image resized by ``scale`` with OpenCV, bilinear; sides are rounded down."""
    import cv2

    height, width = (max(1, int(side * scale)) for side in rgb.shape[:2])
    return np.asarray(cv2.resize(rgb, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)


def read_json_object(path: Path, expected: str = "a JSON file") -> dict[str, Any]:
    """Return the content of a model's JSON file. Raises ``MethodError`` if it cannot be read or is no object."""
    value, problems = parse_json(read_file(path, JSON_BYTES, expected, MethodError))
    if not problems and not isinstance(value, dict):
        problems = [Problem("invalid", "", f"got {short_repr(value)}", "a JSON object")]
    if problems:
        raise MethodError.from_problems(path, problems)
    return dict(value)


def snapshot(repository: str, file: str, local_hint: str, revision: str | None = None) -> Path:
    """Return the cached snapshot of a model with at least ``file``; the folder name is the commit.

    The snapshot is that of the main branch, as the cache knows it, or of the commit ``revision``. ``file`` is
    downloaded, after a notice, only if it is not cached. ``local_hint`` is the advice in error messages on how to
    use a local copy (``local_copy_hint``).

    Raises ``MethodError`` if the download fails.
    """
    from huggingface_hub import get_hf_file_metadata, hf_hub_download, hf_hub_url
    from huggingface_hub.errors import LocalEntryNotFoundError

    try:
        return Path(hf_hub_download(repository, file, revision=revision, local_files_only=True)).parent
    except LocalEntryNotFoundError:
        pass
    with hub_download(repository, file, local_hint):
        # Without an answer, the download would try six times.
        get_hf_file_metadata(hf_hub_url(repository, file, revision=revision))
        return Path(hf_hub_download(repository, file, revision=revision)).parent


@contextmanager
def hub_download(name: str, what: str, local_hint: str, url: str = "") -> Iterator[None]:
    """Announce a download on standard error, and convert all of its errors into ``MethodError``.

    ``url`` is the source, by default the Hub. Raises ``MethodError`` if ``HF_HUB_OFFLINE`` is set.
    """
    from huggingface_hub import constants

    source = url or constants.ENDPOINT
    if constants.HF_HUB_OFFLINE:
        raise MethodError(
            f"{name}: {what} must be downloaded, but HF_HUB_OFFLINE is set: unset it, or download the files on "
            f"another machine and pass their folder: {local_hint}"
        )
    print(f"{name}: downloading {what} from {source}", file=sys.stderr, flush=True)
    try:
        yield
    except MethodError:
        raise
    except Exception as error:  # huggingface_hub raises its own, httpx and OS errors.
        raise MethodError(
            f"{name}: {what} cannot be downloaded from {source}: {exception_summary(error)}; expected a "
            f"network connection (and HF_TOKEN if the model is not public), or a local copy: {local_hint}"
        ) from None


def local_copy_hint(prefix: str, repository: str) -> str:
    """Return the advice on how to make and name a local copy, for a method that takes ``PREFIX:FOLDER``."""
    return f"{prefix}:FOLDER (hf download {repository} --local-dir FOLDER)"
