"""Checkpoints of ``transformers`` in a local folder or on the Hugging Face Hub.

Downloads from the Hub are always announced on standard error.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rebar_depth_bench.data.files import files_digest
from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods.paper.third_party import hub_download, local_copy_hint, read_json_object, snapshot

PREFIX = "hf"
"""What the names of these methods begin with, before a colon."""
CONFIG, PREPROCESSOR = "config.json", "preprocessor_config.json"
_REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")
_WEIGHTS = ("*.safetensors", "*.bin")
"""File patterns of weights in order of preference; a checkpoint with both kinds holds the same weights twice."""


@dataclass(frozen=True)
class Checkpoint:
    """Folder with ``config.json``, and its parsed content.

    ``repository`` is the name on the Hub if the folder is a cached snapshot, else None. ``version`` is the digest
    of a local folder or the commit of a snapshot.
    """

    name: str
    folder: Path
    repository: str | None
    version: str
    config: Mapping[str, Any]


def find_checkpoint(name_or_path: str) -> Checkpoint:
    """Return the checkpoint in a local folder, or ``ORG/NAME`` on the Hub.

    At most ``config.json`` is downloaded here. The version of a local folder is the digest of its weights, that of
    a Hub checkpoint its commit.

    Raises ``MethodError`` if neither exists, or it has no readable ``config.json``.
    """
    folder = Path(name_or_path).expanduser()
    if name_or_path and folder.is_dir():
        config = read_settings(folder / CONFIG)
        return Checkpoint(folder.resolve().name, folder, None, _weights_digest(folder), config)
    if not _REPOSITORY.fullmatch(name_or_path) or Path(name_or_path).parent.is_dir():
        raise MethodError(
            f"{name_or_path}: is neither a folder nor the name of a model on the Hub, expected a folder with "
            f"{CONFIG}, or ORG/NAME where there is no folder ORG"
        )
    folder = snapshot(name_or_path, CONFIG, local_copy_hint(PREFIX, name_or_path))
    return Checkpoint(name_or_path, folder, name_or_path, f"commit {folder.name}", read_settings(folder / CONFIG))


def ensure_weights(checkpoint: Checkpoint) -> None:
    """Download weights and settings of a Hub checkpoint if they are not cached, after a notice on standard error.

    Raises ``MethodError`` if the download fails or the checkpoint has no weights.
    """
    if checkpoint.repository and not (
        _weight_files(checkpoint.folder) and (checkpoint.folder / PREPROCESSOR).is_file()
    ):
        _fetch_weights(checkpoint.repository, checkpoint.folder.name)
    if not _weight_files(checkpoint.folder):
        raise MethodError(f"{checkpoint.name}: no weights, expected {' or '.join(_WEIGHTS)} beside {CONFIG}")


def _weight_files(folder: Path) -> list[Path]:
    """Return the weight files of the first pattern that matches; empty if there are none."""
    return next((paths for pattern in _WEIGHTS if (paths := sorted(folder.glob(pattern)))), [])


def _weights_digest(folder: Path) -> str:
    """Return the digest of config, pre-processing settings and weights, which determine the predictions."""
    files = [folder / CONFIG, folder / PREPROCESSOR, *_weight_files(folder)]
    return f"sha256:{files_digest(path for path in files if path.is_file())}"


def read_settings(path: Path) -> dict[str, Any]:
    """Return the object of a JSON file of a checkpoint. Raises ``MethodError`` if it is missing or unreadable.

    There are no default values: at an input size other than that of training, a network silently performs worse.
    """
    if not path.exists():
        raise MethodError(
            f"{path.parent}: no {path.name}, expected a checkpoint folder as written by save_pretrained"
        )
    return read_json_object(path)


def _fetch_weights(repository: str, commit: str) -> None:
    """Download weights (of one kind only) and settings of a commit into the Hub cache."""
    from huggingface_hub import HfApi, snapshot_download

    with hub_download(repository, "the weights", local_copy_hint(PREFIX, repository)):
        files = HfApi().model_info(repository, revision=commit, files_metadata=True).siblings or []
        sizes = {file.rfilename: file.size or 0 for file in files if "/" not in file.rfilename}
        weight_pattern = next(
            (pattern for pattern in _WEIGHTS if any(Path(name).match(pattern) for name in sizes)), _WEIGHTS[0]
        )
        file_names = [name for name in sizes if Path(name).match(weight_pattern) or name.endswith(".json")]
        print(f"{repository}: {sum(sizes[name] for name in file_names) / 1e6:.1f} MB", file=sys.stderr, flush=True)
        snapshot_download(repository, revision=commit, allow_patterns=file_names)
