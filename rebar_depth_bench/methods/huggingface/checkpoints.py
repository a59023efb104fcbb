"""Checkpoints of ``transformers``: a local folder, or a model of the Hub that is never fetched silently."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rebar_depth_bench.data.digests import files_digest
from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods.monocular.hub import HUB_ACCESS, announce, local_copy, snapshot, unavailable

CONFIG, PREPROCESSOR = "config.json", "preprocessor_config.json"
_REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")
_WEIGHTS = ("*.safetensors", "*.bin")
"""The first kind that is there is taken: the other is the same weights once more."""


@dataclass(frozen=True)
class Checkpoint:
    """A folder with ``config.json``; ``repository`` is the Hub's name where it is the Hub's cached snapshot."""

    name: str
    folder: Path
    repository: str | None
    version: str
    config: Mapping[str, Any]


def find_checkpoint(name_or_path: str) -> Checkpoint:
    """Find a folder, or on the Hub ``ORG/NAME``, of which at most ``config.json`` is fetched here.

    A folder's version is the digest of its weights, the Hub's is the commit.

    Raises ``MethodError`` where there is neither, or it holds no readable ``config.json``.
    """
    folder = Path(name_or_path).expanduser()
    if name_or_path and folder.is_dir():
        config = _json(folder / CONFIG)
        return Checkpoint(folder.resolve().name, folder, None, _weights_digest(folder), config)
    if not _REPOSITORY.fullmatch(name_or_path):
        raise MethodError(
            f"{name_or_path}: no such folder, and no name of a model on the Hub, expected a folder with {CONFIG} "
            "or ORG/NAME"
        )
    folder = snapshot(name_or_path, CONFIG, _instead(name_or_path))
    return Checkpoint(name_or_path, folder, name_or_path, f"commit {folder.name}", _json(folder / CONFIG))


def complete(checkpoint: Checkpoint) -> None:
    """Fetch the weights if they are the Hub's and not in its cache; says so on standard error first.

    Raises ``MethodError`` where they are not to be had, or where no pre-processing is with them.
    """
    if checkpoint.repository and not (
        _weights(checkpoint.folder) and (checkpoint.folder / PREPROCESSOR).is_file()
    ):
        _fetch(checkpoint.repository, checkpoint.folder.name)
    if not _weights(checkpoint.folder):
        raise MethodError(f"{checkpoint.name}: no weights, expected {' or '.join(_WEIGHTS)} beside {CONFIG}")


def preprocessor(checkpoint: Checkpoint) -> dict[str, Any]:
    """Return ``preprocessor_config.json``. Raises ``MethodError`` where it is missing or unreadable.

    Nothing of it is guessed: at another size than the weights were trained for a network is silently worse.
    """
    return _json(checkpoint.folder / PREPROCESSOR)


def _weights(folder: Path) -> list[Path]:
    return next((found for pattern in _WEIGHTS if (found := sorted(folder.glob(pattern)))), [])


def _weights_digest(folder: Path) -> str:
    """Return the digest of the config, the pre-processing and the weights: what the answer depends on."""
    files = [folder / CONFIG, folder / PREPROCESSOR, *_weights(folder)]
    return f"sha256:{files_digest(path for path in files if path.is_file())}"


def _json(path: Path) -> dict[str, Any]:
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise MethodError(
            f"{path.parent}: no {path.name}, expected a checkpoint's folder as save_pretrained writes it"
        ) from None
    except (OSError, ValueError) as error:
        raise MethodError(f"{path}: cannot be read: {error}") from None
    if not isinstance(value, dict):
        raise MethodError(f"{path}: is {type(value).__name__}, expected a JSON object")
    return value


def _fetch(repository: str, commit: str) -> None:
    """Fetch a commit's weights and settings into the Hub's cache, one kind of weights only."""
    from huggingface_hub import HfApi, constants, snapshot_download

    announce(repository, "the weights", constants.ENDPOINT, _instead(repository))
    try:
        files = HfApi().model_info(repository, revision=commit, files_metadata=True).siblings or []
        sizes = {file.rfilename: file.size or 0 for file in files if "/" not in file.rfilename}
        weights = next((kind for kind in _WEIGHTS if any(Path(name).match(kind) for name in sizes)), _WEIGHTS[0])
        wanted = [name for name in sizes if Path(name).match(weights) or name.endswith(".json")]
        print(f"{repository}: {sum(sizes[name] for name in wanted) / 1e6:.1f} MB", file=sys.stderr, flush=True)
        snapshot_download(repository, revision=commit, allow_patterns=wanted)
    except Exception as error:  # the Hub's client raises its own, httpx's and the system's
        raise unavailable(repository, constants.ENDPOINT, error, _instead(repository), HUB_ACCESS) from None


def _instead(repository: str) -> str:
    return local_copy("hf", repository)
