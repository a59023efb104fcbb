"""Manifest of a dataset folder or Hub repository: configs, views, digests and files."""

from __future__ import annotations

import json
import re
from collections import Counter
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field, Strict, StringConstraints, ValidationInfo, field_validator

from rebar_depth_bench.errors import DatasetError, Problem
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.paths import NAME_PATTERN, PATH_PATTERN, path_below
from rebar_depth_bench.validation import (
    Expected,
    StrictModel,
    field_error,
    format_location,
    number,
    one_of,
    validate_table,
    whole_number,
)

MANIFEST_FILE = "manifest.json"
MANIFEST_FORMAT = "rebar-depth-dataset-1"
_HUB_ID = re.compile(r"[\w.-]+/[\w.-]+")
_LETTERS = 'letters, digits, "_", "." and "-", not starting with a dot'
_Name = Annotated[str, StringConstraints(pattern=f"^{NAME_PATTERN}$"), Expected(f"a name of {_LETTERS}")]
_Path = Annotated[
    str,
    StringConstraints(pattern=f"^{PATH_PATTERN}$"),
    Expected(f"a path in the folder, whose parts are {_LETTERS}"),
]
_ViewId = Annotated[str, StringConstraints(pattern=f"^{NAME_PATTERN}/{NAME_PATTERN}$")]
_Sha256 = Annotated[str, StringConstraints(pattern="^[0-9a-f]{64}$")]
_Digest = Annotated[str, StringConstraints(pattern="^sha256:[0-9a-f]{64}$")]
_Side = Annotated[int, whole_number(1, 16384)]
_Length = Annotated[float, number(0, 10)]


class ViewRecord(StrictModel):
    """Manifest entry of one view.

    ``left`` and ``right`` are the hex SHA-256 digests of the cameras' ground truth; ``steel_px`` and ``scored_px``
    count steel and scored pixels.
    """

    view_id: _ViewId
    left: _Sha256
    right: _Sha256
    steel_px: Annotated[int, Field(ge=0)]
    scored_px: Annotated[int, Field(ge=0)]


class _ManifestTable(StrictModel):
    """Base class of the objects that may contain further keys, which are ignored."""

    model_config = ConfigDict(extra="ignore")


class Appearance(_ManifestTable):
    """Names of the appearance variants of a scene."""

    variants: Annotated[tuple[_Name, ...], Strict(False)] = ()


class _BoardTable(StrictModel):
    width_m: _Length
    height_m: _Length
    markers: Annotated[int, one_of(6, 12)]
    marker_side_m: _Length
    dictionary: _Name


class Scene(_ManifestTable):
    """Scene of a config; ``board`` is the ArUco board under the assembly, or None."""

    name: _Name
    board: BoardSpec | None
    appearance: Appearance = Appearance()

    @field_validator("board", mode="before")
    @classmethod
    def _make_board(cls, fields: Any) -> BoardSpec | None:
        return None if fields is None else BoardSpec(**_BoardTable.model_validate(fields).model_dump())


class Rig(_ManifestTable):
    """Image size of a stereo rig, pixels."""

    width: _Side
    height: _Side


class _Located(_ManifestTable):
    """Dataset, or part of one; ``root`` is a folder path or a Hub repository id."""

    root: str

    @property
    def local(self) -> Path | None:
        """Path of a local dataset folder, or None for a Hub repository."""
        path = Path(self.root)
        return path if path.is_dir() else None

    def file(self, name: str) -> Path:
        """Return the local path of a file of the dataset, downloaded first if the dataset is a Hub repository.

        Raises ``DatasetError`` if the file is missing or cannot be downloaded.
        """
        return _local_path(self.root, name)


class DatasetConfig(_Located):
    """Config of a dataset; ``manifest_entry`` is its entry as it was written, with all parameters of the build."""

    name: _Name
    scene: Scene
    rig: Rig
    views: Annotated[tuple[ViewRecord, ...], Strict(False)]
    ground_truth_digest: _Digest
    key: str
    shards: Annotated[tuple[_Path, ...], Strict(False)]
    mesh: _Path
    sheet: _Path
    manifest_entry: dict[str, Any] = Field(repr=False)

    @field_validator("views")
    @classmethod
    def _check_views(cls, views: tuple[ViewRecord, ...], info: ValidationInfo) -> tuple[ViewRecord, ...]:
        view_ids = [view.view_id for view in views]
        prefix = f"{info.data.get('name', '')}/"
        foreign = [view_id for view_id in view_ids if not view_id.startswith(prefix)]
        if foreign and "name" in info.data:
            raise field_error(f"got {foreign[0]}", f"view ids that start with {prefix}")
        repeated = [view_id for view_id, number_of_views in Counter(view_ids).items() if number_of_views > 1]
        if repeated:
            raise field_error(f"{repeated[0]} occurs more than once", "each view once", "duplicate")
        return views

    @property
    def grid(self) -> tuple[int, int]:
        """Image size (height, width), pixels."""
        return self.rig.height, self.rig.width

    @property
    def view_ids(self) -> tuple[str, ...]:
        """Ids of the views, in order."""
        return tuple(view.view_id for view in self.views)


class DatasetFolder(_Located):
    """Dataset with a validated manifest; ``files`` are the hex SHA-256 digests of its files, by path."""

    version: str
    digest: str
    files: dict[str, str]
    config_by_name: dict[str, DatasetConfig]

    @property
    def configs(self) -> tuple[str, ...]:
        """Names of the configs."""
        return tuple(self.config_by_name)

    def config(self, name: str) -> DatasetConfig:
        """Return a config; raise ``DatasetError`` if there is none of that name."""
        if name not in self.config_by_name:
            raise DatasetError(f"{self.root}: no config {name!r}, expected one of {', '.join(self.configs)}")
        return self.config_by_name[name]

    def expected_views(self) -> dict[str, tuple[int, int]]:
        """Return the (height, width) of every view of every config, keyed by view id."""
        return {view_id: config.grid for config in self.config_by_name.values() for view_id in config.view_ids}


class _GroundTruth(_ManifestTable):
    digest: _Digest


class _Format(_ManifestTable):
    format: Annotated[str, one_of(MANIFEST_FORMAT)]


class _Manifest(_ManifestTable):
    """Manifest of the supported format; its configs are validated one by one."""

    version: str
    ground_truth: _GroundTruth
    configs: dict[str, dict[str, Any]]
    files: dict[_Path, _Sha256]


def open_folder(root: str | Path) -> DatasetFolder:
    """Open a dataset folder or Hub dataset repository.

    Raises ``DatasetError`` if ``root`` is neither, or with all problems of its manifest if that is invalid.
    """
    root = str(root)
    path = _manifest_path(root)
    try:
        values = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        problem = Problem("syntax", "", f"cannot be read as JSON: {error}")
        raise DatasetError.from_problems(path, [problem]) from None
    problems: list[Problem] = []
    supported = validate_table(_Format, values, problems)  # Another format would cause many other problems.
    head = validate_table(_Manifest, values, problems) if supported else None
    configs = {}
    for name, entry in head.configs.items() if head else ():
        fields = {**entry, "root": root, "name": name, "manifest_entry": entry}
        if config := validate_table(DatasetConfig, fields, problems, format_location("configs", name)):
            configs[name] = config
    if head is None or problems:
        raise DatasetError.from_problems(path, problems)
    return DatasetFolder(
        root=root, version=head.version, digest=head.ground_truth.digest, files=head.files, config_by_name=configs
    )


def _manifest_path(root: str) -> Path:
    folder = Path(root)
    if not folder.is_dir() and (folder.exists() or not _HUB_ID.fullmatch(root)):
        raise DatasetError(f"{root}: no such folder, expected a dataset folder or a Hub repository id")
    return _local_path(root, MANIFEST_FILE)


def _local_path(root: str, name: str) -> Path:
    if Path(root).is_dir():
        path = path_below(Path(root), name)
        if not path.is_file():
            raise DatasetError(f"{root}: has no {name}, expected a complete dataset folder written by rebar-build")
        return path
    # Imported on use: it takes a fifth of a second, which local folders do not need.
    from huggingface_hub import hf_hub_download
    from huggingface_hub.errors import EntryNotFoundError, HfHubHTTPError, LocalEntryNotFoundError

    try:
        return Path(hf_hub_download(root, name, repo_type="dataset"))
    except (EntryNotFoundError, LocalEntryNotFoundError, HfHubHTTPError, OSError) as error:
        raise DatasetError(
            f"{root}: not a local folder, and its {name} cannot be downloaded from the Hub: {error}"
        ) from None
