"""A dataset folder as its manifest describes it: configs, views, digests. Local, or a Hub repository."""

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

MANIFEST = "manifest.json"
FORMAT = "rebar-depth-dataset-1"
_HUB_ID = re.compile(r"[\w.-]+/[\w.-]+")


@dataclass(frozen=True)
class ViewRecord:
    """What the manifest says of one view: its id, its eyes' digests and how many pixels are steel and scored."""

    view_id: str
    left: str
    right: str
    steel_px: int
    scored_px: int


_VIEW_KEYS = {field.name for field in fields(ViewRecord)}
_CONFIG_KEYS = {"scene", "rig", "views", "ground_truth_digest", "key", "shards", "mesh"}


@dataclass(frozen=True)
class DatasetFolder:
    """A dataset's manifest, read and checked. ``root`` is a folder's path or a Hub repository id."""

    root: str
    manifest: Mapping[str, Any]

    @property
    def local(self) -> Path | None:
        """The folder on this machine, None for a Hub repository."""
        path = Path(self.root)
        return path if path.is_dir() else None

    @property
    def digest(self) -> str:
        """The ground-truth digest, ``sha256:...``."""
        return str(self.manifest["ground_truth"]["digest"])

    @property
    def version(self) -> str:
        """The dataset's version."""
        return str(self.manifest["version"])

    @property
    def configs(self) -> tuple[str, ...]:
        """The names of the configs in the folder."""
        return tuple(self.manifest["configs"])

    def config(self, name: str) -> Mapping[str, Any]:
        """Return the manifest's entry of a config; raise ``DatasetError`` for an unknown one."""
        try:
            entry: Mapping[str, Any] = self.manifest["configs"][name]
        except KeyError:
            raise DatasetError(
                f"{self.root}: no config {name!r}, expected one of {', '.join(self.configs)}"
            ) from None
        return entry

    def views(self, config: str) -> list[ViewRecord]:
        """Return the records of a config's views, in order."""
        return [ViewRecord(**view) for view in self.config(config)["views"]]

    def grid(self, config: str) -> tuple[int, int]:
        """Return (height, width) of a config's images, pixels."""
        rig = self.config(config)["rig"]
        return int(rig["height"]), int(rig["width"])

    def file(self, name: str) -> Path:
        """Return a file of the folder on this machine, fetched first if it is a Hub repository's.

        Raises ``DatasetError`` if it is not there.
        """
        return _file(self.root, name)

    def expected_views(self) -> dict[str, tuple[int, int]]:
        """Return every view id of the folder with its (height, width)."""
        return {view.view_id: self.grid(config) for config in self.configs for view in self.views(config)}


def open_folder(root: str | Path) -> DatasetFolder:
    """Open a dataset folder or a Hub dataset repository; raise ``DatasetError`` in words if it is neither."""
    manifest = read_manifest(_manifest_path(str(root)))
    return DatasetFolder(str(root), manifest)


def read_manifest(path: Path) -> dict[str, Any]:
    """Read and check a manifest's outline."""
    try:
        manifest = json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path}: cannot be read as JSON: {error}") from None
    found = manifest.get("format") if isinstance(manifest, dict) else type(manifest).__name__
    if found != FORMAT:
        raise DatasetError(f"{path}: format is {found!r}, expected {FORMAT!r}")
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
            raise DatasetError(f"{path}: a view of config {name} has not exactly {', '.join(sorted(_VIEW_KEYS))}")


def _manifest_path(root: str) -> Path:
    folder = Path(root)
    if not folder.is_dir() and (folder.exists() or not _HUB_ID.fullmatch(root)):
        raise DatasetError(f"{root}: no such folder, expected a dataset folder or a Hub repository id")
    return _file(root, MANIFEST)


def _file(root: str, name: str) -> Path:
    if Path(root).is_dir():
        path = Path(root) / name
        if not path.is_file():
            raise DatasetError(f"{root}: has no {name}, expected a folder finished by rebar-build")
        return path
    try:
        return Path(hf_hub_download(root, name, repo_type="dataset"))
    except (EntryNotFoundError, LocalEntryNotFoundError, HfHubHTTPError, OSError) as error:
        raise DatasetError(
            f"{root}: no such folder, and as a Hub repository its {name} cannot be had: {error}"
        ) from None
