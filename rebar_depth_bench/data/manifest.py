"""Manifest of a dataset folder or Hub repository: configs, views, digests and files."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from huggingface_hub import hf_hub_download
from huggingface_hub.errors import EntryNotFoundError, HfHubHTTPError, LocalEntryNotFoundError

from rebar_depth_bench.errors import DatasetError

MANIFEST_FILE = "manifest.json"
MANIFEST_FORMAT = "rebar-depth-dataset-1"
_HUB_ID = re.compile(r"[\w.-]+/[\w.-]+")


@dataclass(frozen=True)
class ViewRecord:
    """Manifest entry of one view.

    ``left`` and ``right`` are the hex SHA-256 digests of the cameras' ground truth; ``steel_px`` and ``scored_px``
    count steel and scored pixels.
    """

    view_id: str
    left: str
    right: str
    steel_px: int
    scored_px: int


_VIEW_KEYS = {field.name for field in fields(ViewRecord)}
_CONFIG_KEYS = {"scene", "rig", "views", "ground_truth_digest", "key", "shards", "mesh"}


@dataclass(frozen=True)
class DatasetFolder:
    """Dataset with a validated manifest; ``root`` is a folder path or a Hub repository id."""

    root: str
    manifest: Mapping[str, Any]

    @property
    def local(self) -> Path | None:
        """Path of a local dataset folder, or None for a Hub repository."""
        path = Path(self.root)
        return path if path.is_dir() else None

    @property
    def digest(self) -> str:
        """Ground-truth digest, ``sha256:...``."""
        return str(self.manifest["ground_truth"]["digest"])

    @property
    def version(self) -> str:
        """Version of the dataset."""
        return str(self.manifest["version"])

    @property
    def configs(self) -> tuple[str, ...]:
        """Names of the configs."""
        return tuple(self.manifest["configs"])

    def config(self, name: str) -> Mapping[str, Any]:
        """Return the manifest entry of a config; raise ``DatasetError`` if there is no such config."""
        try:
            entry: Mapping[str, Any] = self.manifest["configs"][name]
        except KeyError:
            raise DatasetError(
                f"{self.root}: no config {name!r}, expected one of {', '.join(self.configs)}"
            ) from None
        return entry

    def views(self, config: str) -> list[ViewRecord]:
        """Return the manifest entries of a config's views, in order."""
        return [ViewRecord(**view) for view in self.config(config)["views"]]

    def grid(self, config: str) -> tuple[int, int]:
        """Return the image size (height, width) of a config, pixels."""
        rig = self.config(config)["rig"]
        return int(rig["height"]), int(rig["width"])

    def file(self, name: str) -> Path:
        """Return the local path of a file of the dataset, downloaded first if the dataset is a Hub repository.

        Raises ``DatasetError`` if the file is missing or cannot be downloaded.
        """
        return _local_path(self.root, name)

    def expected_views(self) -> dict[str, tuple[int, int]]:
        """Return the (height, width) of every view of every config, keyed by view id."""
        return {view.view_id: self.grid(config) for config in self.configs for view in self.views(config)}


def open_folder(root: str | Path) -> DatasetFolder:
    """Open a dataset folder or Hub dataset repository.

    Raises ``DatasetError`` if ``root`` is neither or its manifest is invalid.
    """
    manifest = read_manifest(_manifest_path(str(root)))
    return DatasetFolder(str(root), manifest)


def read_manifest(path: Path) -> dict[str, Any]:
    """Read a manifest and check its format, its keys and its view entries.

    Raises ``DatasetError`` if it cannot be read or is invalid.
    """
    try:
        manifest = json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path}: cannot be read as JSON: {error}") from None
    format_name = manifest.get("format") if isinstance(manifest, dict) else type(manifest).__name__
    if format_name != MANIFEST_FORMAT:
        raise DatasetError(f"{path}: format is {format_name!r}, expected {MANIFEST_FORMAT!r}")
    missing = [key for key in ("version", "ground_truth", "configs", "files") if key not in manifest]
    if missing:
        raise DatasetError(f"{path}: lacks {', '.join(missing)}")
    _check_configs(path, manifest["configs"])
    return dict(manifest)


def _check_configs(path: Path, configs: object) -> None:
    if not isinstance(configs, dict):
        raise DatasetError(f"{path}: configs is a {type(configs).__name__}, expected an object")
    for name, entry in configs.items():
        keys = set(entry) if isinstance(entry, dict) else set()
        missing = sorted(_CONFIG_KEYS - keys)
        if missing:
            raise DatasetError(f"{path}: config {name} lacks {', '.join(missing)}")
        if any(not isinstance(view, dict) or set(view) != _VIEW_KEYS for view in entry["views"]):
            raise DatasetError(
                f"{path}: a view of config {name} does not have exactly the keys {', '.join(sorted(_VIEW_KEYS))}"
            )


def _manifest_path(root: str) -> Path:
    folder = Path(root)
    if not folder.is_dir() and (folder.exists() or not _HUB_ID.fullmatch(root)):
        raise DatasetError(f"{root}: no such folder, expected a dataset folder or a Hub repository id")
    return _local_path(root, MANIFEST_FILE)


def _local_path(root: str, name: str) -> Path:
    if Path(root).is_dir():
        path = Path(root) / name
        if not path.is_file():
            raise DatasetError(f"{root}: has no {name}, expected a complete dataset folder written by rebar-build")
        return path
    try:
        return Path(hf_hub_download(root, name, repo_type="dataset"))
    except (EntryNotFoundError, LocalEntryNotFoundError, HfHubHTTPError, OSError) as error:
        raise DatasetError(
            f"{root}: not a local folder, and its {name} cannot be downloaded from the Hub: {error}"
        ) from None
