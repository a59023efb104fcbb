"""Networks that run with their authors' code: imports, weights, downloads, and translated errors.

The code is executed unchanged, and so is any code in pickled checkpoints: users must trust the folders they name.

A bare method name refers to the main branch of a repository on the Hub, as its cache knows it. No commit is pinned
because none was tested. The commit in use is part of the method's summary and thus of a submission.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Float32, Num, UInt8
from numpy import ndarray

from rebar_depth_bench.base.errors import MethodError, Problem, exception_summary, install_command, library_message
from rebar_depth_bench.base.limits import JSON_BYTES
from rebar_depth_bench.base.reading import parse_json, read_file
from rebar_depth_bench.base.validation import short_repr
from rebar_depth_bench.methods.base import Method, MethodInfo, Predictor, WeightsMethod, files_digest

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

    def described(self, addition: str) -> MethodInfo:
        """Return the description with an addition to its summary."""
        return replace(self.info, summary=f"{self.info.summary}; {addition}")

    def listed(self, with_weights: Callable[[Path | None], Method], addition: str) -> WeightsMethod:
        """Return the method for listings, with ``addition`` to its summary; nothing is looked up for it."""
        return WeightsMethod(
            self.described(addition), lambda: with_weights(None).load(), with_weights=with_weights
        )

    def with_digest(self, label: str, files: Sequence[Path]) -> MethodInfo:
        """Return the description with ``label`` in the name and the digest of the weights in the summary.

        Different weights are thus a different method, and an interrupted prediction is not resumed with them.
        Raises ``MethodError`` if a file cannot be read.
        """
        info = self.described(f"weights sha256:{files_digest(files)}")
        return replace(info, name=f"{info.name}:{label}")

    def check_folder(self, folder: Path, *required_files: str) -> None:
        """Raise ``MethodError`` unless a folder contains these files."""
        expected = " and ".join(required_files)
        if not folder.is_dir():
            raise MethodError(f"{self.info.name}:{folder}: no such folder, expected one with {expected}")
        for file in required_files:
            if not (folder / file).is_file():
                raise MethodError(f"{self.info.name}:{folder}: no {file} in it, expected {expected}")

    def import_torch(self) -> Any:
        """Import and return torch. Raises ``MethodError`` if it is missing."""
        return self.import_package("torch", install_command("torch"))

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

    def predictor(self, infer: Callable[[Mapping[str, Any]], Float32[ndarray, "h w"]]) -> Predictor:
        """Return ``infer``, which runs the network on a row, without gradients and with translated errors."""
        import torch

        def predict(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
            with self.errors("inference failed"), torch.inference_mode():
                return infer(row)

        return predict

    def check_shape(self, shape: Sequence[int], expected: Sequence[int]) -> None:
        """Raise ``MethodError`` unless the network's depth has the shape ``expected``."""
        if tuple(shape) != tuple(expected):
            found = f"the network returned depth of shape {tuple(shape)}"
            raise MethodError(f"{self.info.name}: {found}, expected {tuple(expected)}")


@dataclass(frozen=True)
class HubNetwork(Network):
    """Network whose class (``class_name`` in ``module`` of an installed package) loads weights from the Hub.

    ``variant`` is the value that ``config.json`` must have under ``variant_keys``, which are nested: the paper's
    network. ``infer(model, row)`` returns its depth.
    """

    repository: str
    module: str
    class_name: str
    variant_keys: tuple[str, ...]
    variant: str
    infer: Callable[[Any, Mapping[str, Any]], Float32[ndarray, "h w"]]

    def with_weights(self, folder: Path | None) -> Method:
        """Return the method with weights from a folder, whose digest is in its summary; None: from the Hub.

        Weights from the Hub are downloaded when the method is loaded; only ``config.json`` is downloaded here, if
        it is not cached, because it is needed to determine the commit, which is in the summary.

        Raises ``MethodError`` if files or the package are missing, if the weights belong to another network, or
        if the download fails.
        """
        name, package = self.info.name, self.module.partition(".")[0]
        if folder is not None:
            self.check_folder(folder, CONFIG, WEIGHTS)
            self._check_variant(folder)
            info = self.with_digest(folder.resolve().name, [folder / CONFIG, folder / WEIGHTS])
            return Method(info, lambda: self._load(folder))
        if find_spec(package) is None:  # Checked first, so that nothing is downloaded in vain.
            raise MethodError(f"{name} needs {package}, which is not installed: {self.install}")
        local_hint = local_copy_hint(name, self.repository)
        cached = snapshot(self.repository, CONFIG, local_hint)
        self._check_variant(cached)
        info = self.described(f"weights commit {cached.name}")
        return Method(info, lambda: self._load(snapshot(self.repository, WEIGHTS, local_hint, cached.name)))

    def _load(self, folder: Path) -> Predictor:
        """Return the predictor with the weights of a folder.

        Raises ``MethodError`` if torch or the package is missing, or if the weights are incomplete.
        """
        from safetensors import safe_open

        self.import_torch()
        package = self.import_package(self.module, self.install)
        with self.errors(f"{folder.name} cannot be loaded"):
            model = getattr(package, self.class_name).from_pretrained(str(folder), local_files_only=True)
            with safe_open(folder / WEIGHTS, framework="pt") as tensors:
                model = self.with_loaded_weights(model, tensors.keys())
        return self.predictor(lambda row: self.infer(model, row))

    def _check_variant(self, folder: Path) -> None:
        """Raise ``MethodError`` if ``config.json`` in a folder belongs to another network."""
        value: Any = read_json_object(folder / CONFIG)
        for key in self.variant_keys:
            value = value.get(key) if isinstance(value, dict) else None
        if value != self.variant:
            found = f"{'.'.join(self.variant_keys)} in {CONFIG} is {short_repr(value)}"
            raise MethodError(
                f"{self.info.name}:{folder}: {found}, expected {self.variant!r}, the paper's network"
            )


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


def resampled(values: Float[Tensor, "h w"], grid: tuple[int, int], mode: str) -> Float[Tensor, "H W"]:
    """Return values resampled to another grid over the same field of view (``align_corners=False``).

    ``mode`` is the interpolation mode of torch.
    """
    from torch.nn import functional

    return functional.interpolate(values[None, None], size=grid, mode=mode, align_corners=False)[0, 0]


def read_json_object(path: Path) -> dict[str, Any]:
    """Return the content of a model's JSON file. Raises ``MethodError`` if it cannot be read or is no object."""
    value, problems = parse_json(read_file(path, JSON_BYTES, "a JSON file", MethodError))
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
