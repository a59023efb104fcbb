"""Networks whose code comes from their authors: imported, loaded and run so that what goes wrong is said in words.

That code is run as it is; so is what a checkpoint of pickled Python may hold. Who names a folder trusts it.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import Any

from rebar_depth_bench.data.digests import files_digest
from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods.base import MethodInfo

MIN_FILLED = 0.99
"""Of a network's numbers, the share that a checkpoint must fill: a token that is never used may lack."""

LONGEST_WORDS = 300


def with_weights(info: MethodInfo, label: str, files: Sequence[Path]) -> MethodInfo:
    """Return a method's description with its weights in it: ``label`` in the name, their digest in the summary.

    So other weights are another method, and a stopped prediction is not continued with them.
    """
    summary = f"{info.summary}; weights sha256:{files_digest(files)}"
    return replace(info, name=f"{info.name}:{label}", summary=summary)


def check_folder(folder: Path, name: str, holds: Sequence[str]) -> None:
    """Raise ``MethodError`` unless a folder holds these files."""
    if not folder.is_dir():
        raise MethodError(f"{name}:{folder}: no such folder, expected one with {' and '.join(holds)}")
    for file in holds:
        if not (folder / file).is_file():
            raise MethodError(f"{name}:{folder}: no {file} in it, expected {' and '.join(holds)}")


def package(module: str, method: str, install: str) -> Any:
    """Return an imported module, untyped. Raises ``MethodError`` that says how to install what is missing."""
    try:
        with redirect_stdout(sys.stderr):
            return importlib.import_module(module)
    except ImportError as error:
        raise MethodError(f"{method} needs {module.partition('.')[0]} ({error}): {install}") from None


def torch_for(method: str) -> Any:
    """Return torch, untyped. Raises ``MethodError`` where it is missing."""
    return package("torch", method, "pip install 'rebar-depth-bench[torch]'")


@contextmanager
def error_words(method: str, torch: Any, doing: str) -> Iterator[None]:
    """Run an author's code: what it prints goes to standard error, what it raises becomes a ``MethodError``.

    Where torch sees no GPU and the code asks for CUDA, that is said.
    """
    try:
        with redirect_stdout(sys.stderr):
            yield
    except MethodError:
        raise
    except Exception as error:  # whatever a stranger's code raises
        words = " ".join(f"{type(error).__name__}: {error}".split())[:LONGEST_WORDS]
        if not torch.cuda.is_available() and ("cuda" in words.lower() or "nvidia" in words.lower()):
            words = f"its own code asks for a CUDA GPU, and torch sees none here ({words})"
        if isinstance(error, ImportError):
            words = f"{words}; install what its repository's requirements name"
        raise MethodError(f"{method}: {doing}: {words}") from error


@contextmanager
def importable(folder: Path) -> Iterator[None]:
    """Let a folder's packages be imported first, as from a script in it."""
    sys.path.insert(0, str(folder.resolve()))
    try:
        yield
    finally:
        sys.path.remove(str(folder.resolve()))


def filled(method: str, torch: Any, network: Any, given: Iterable[str]) -> Any:
    """Return a network in evaluation, on the GPU if torch sees one, whose weights ``given`` names.

    Authors' code leaves what a checkpoint lacks at random numbers, and says nothing. Raises ``MethodError`` where
    it fills less than ``MIN_FILLED`` of the network's numbers; what lacks otherwise is said on standard error.
    """
    names = set(given)
    wanted = {name: values.numel() for name, values in network.named_parameters()}
    shared = {name: id(values) for name, values in network.named_parameters(remove_duplicate=False)}
    there = {shared[name] for name in names if name in shared}
    missing = [name for name in wanted if shared[name] not in there]
    share = 1 - sum(wanted[name] for name in missing) / max(sum(wanted.values()), 1)
    words = f"{method}: the weights fill {share:.2%} of the network, lacking {len(missing)} tensors"
    if missing and share < MIN_FILLED:
        raise MethodError(f"{words}, first {missing[0]}, expected those of this network")
    if missing:
        print(f"{words}: {', '.join(missing)}", file=sys.stderr, flush=True)
    return network.to(device(torch)).eval()


def device(torch: Any) -> str:
    """Return the name of torch's device to run on."""
    return "cuda" if torch.cuda.is_available() else "cpu"


def safetensors_names(path: Path) -> list[str]:
    """Return the names of a safetensors file's tensors. Raises ``MethodError`` for a damaged one."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as tensors:
            return list(tensors.keys())
    except (SafetensorError, OSError) as error:
        raise MethodError(f"{path}: cannot be read: {error}") from None
