"""Manifest of a dataset folder or Hub repository: configs, views, digests and files."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field, Strict, StringConstraints, ValidationInfo, field_validator

from rebar_depth_bench.data.digests import file_sha256, views_digest
from rebar_depth_bench.data.location import Located, local_path
from rebar_depth_bench.errors import DatasetError, InputError, Problem, escape_text
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.limits import JSON_BYTES
from rebar_depth_bench.paths import NAME_LETTERS, NAME_PATTERN, PATH_PATTERN, VIEW_ID_PATTERN
from rebar_depth_bench.reading import parse_json, read_file
from rebar_depth_bench.validation import (
    Expected,
    StrictModel,
    field_error,
    format_location,
    number,
    one_of,
    text,
    validate_table,
    whole_number,
)

MANIFEST_FILE = "manifest.json"
MANIFEST_FORMAT = "rebar-depth-dataset-1"
CENTRE, NEAREST_STEEL = "centre", "nearest steel"
"""Values of ``Trajectory.distance_to``."""
_DIGEST_PATTERN = "sha256:[0-9a-f]{64}"
_Name = Annotated[str, StringConstraints(pattern=f"^{NAME_PATTERN}$"), Expected(f"a name of {NAME_LETTERS}")]
_Path = Annotated[
    str,
    StringConstraints(pattern=f"^{PATH_PATTERN}$"),
    Expected(f"a path in the folder, whose parts are {NAME_LETTERS}"),
]
_ViewId = Annotated[str, StringConstraints(pattern=f"^{VIEW_ID_PATTERN}$")]
# Views have no ``Expected``, which is called from pydantic: a folder has thousands.
_Sha256 = Annotated[str, StringConstraints(pattern="^[0-9a-f]{64}$")]
_Digest = Annotated[str, StringConstraints(pattern=f"^{_DIGEST_PATTERN}$"), Expected("sha256: and 64 hex digits")]
_Side = Annotated[int, whole_number(1, 16384)]
_Length = Annotated[float, number(0, 10)]
_Distance = Annotated[float, number(0)]


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


class Trajectory(_ManifestTable):
    """Cameras of a config: shells, rings of a shell, and azimuths of a ring.

    ``radii_m`` are distances from the left camera to ``distance_to``: the centre of the assembly, as in all
    folders without this key, or the nearest point of any bar's surface.
    """

    radii_m: Annotated[tuple[_Distance, ...], Strict(False), Field(min_length=1)] = (1.0,)
    elevations_deg: Annotated[tuple[float, ...], Strict(False), Field(min_length=1)] = (0.0,)
    azimuths: Annotated[int, whole_number(1, 1_000_000)]
    distance_to: Annotated[str, one_of(CENTRE, NEAREST_STEEL)] = CENTRE

    @property
    def views(self) -> int:
        """Number of views of the full trajectory."""
        return len(self.radii_m) * len(self.elevations_deg) * self.azimuths


class ReferenceRecord(_ManifestTable):
    """AbsRel and RMSE (cm) of a reference, means over the views; None where undefined."""

    abs_rel: _Distance | None
    rmse_cm: _Distance | None


class References(_ManifestTable):
    """Reference errors of a config, as in the tables of results."""

    constant: ReferenceRecord
    one_pixel: ReferenceRecord


class DatasetConfig(Located):
    """Config of a dataset; ``manifest_entry`` is its entry as it was written, with all parameters of the build.

    ``reference`` is None in folders of earlier versions.
    """

    name: _Name
    scene: Scene
    rig: Rig
    views: Annotated[tuple[ViewRecord, ...], Strict(False)]
    ground_truth_digest: _Digest
    protocol: Trajectory | None = None
    protocol_views: Annotated[int, whole_number(1, 1_000_000)] = 0
    key: Annotated[str, StringConstraints(max_length=200)]
    shards: Annotated[tuple[_Path, ...], Strict(False)]
    mesh: _Path
    sheet: _Path
    reference: References | None = None
    manifest_entry: dict[str, Any] = Field(repr=False)

    @field_validator("views")
    @classmethod
    def _check_views(cls, views: tuple[ViewRecord, ...], info: ValidationInfo) -> tuple[ViewRecord, ...]:
        _check_unique([view.view_id for view in views], "view")
        name, rig = info.data.get("name"), info.data.get("rig")
        for view in views:
            if name is not None and not view.view_id.startswith(f"{name}/"):
                raise field_error(f"got {view.view_id}", f"view ids that start with {name}/")
            if rig is not None and not view.scored_px <= view.steel_px <= rig.width * rig.height:
                raise field_error(
                    f"{view.view_id} has {view.scored_px} scored and {view.steel_px} steel pixels",
                    f"no more scored than steel pixels, and at most {rig.width * rig.height}",
                )
        return views

    @field_validator("ground_truth_digest")
    @classmethod
    def _check_digest(cls, digest: str, info: ValidationInfo) -> str:
        if "views" in info.data and digest != (expected := views_digest(info.data["views"])):
            raise field_error(f"got {digest}", f"the digest of the views, {expected}", "conflict")
        return digest

    @field_validator("protocol_views")
    @classmethod
    def _check_protocol_views(cls, protocol_views: int, info: ValidationInfo) -> int:
        view_ids = [view.view_id for view in info.data.get("views", ())]
        indices = [int(index) for view_id in view_ids if (index := view_id.rpartition("/")[2]).isdecimal()]
        least = max(len(view_ids), 1 + max(indices, default=-1))
        if protocol_views < least:
            raise field_error(
                f"got {protocol_views}", f"at least {least}: views and their largest index", "conflict"
            )
        trajectory = info.data.get("protocol")
        if trajectory is not None and protocol_views != trajectory.views:
            raise field_error(f"got {protocol_views}", f"the trajectory's {trajectory.views} views", "conflict")
        return protocol_views

    @field_validator("shards")
    @classmethod
    def _check_shards(cls, shards: tuple[str, ...]) -> tuple[str, ...]:
        _check_unique(shards, "shard")
        return shards

    @property
    def grid(self) -> tuple[int, int]:
        """Image size (height, width), pixels."""
        return self.rig.height, self.rig.width

    @property
    def view_ids(self) -> tuple[str, ...]:
        """Ids of the views, in order."""
        return tuple(view.view_id for view in self.views)


class DatasetFolder(Located):
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

    def verified_file(self, name: str) -> Path:
        """Return the local path of a file after comparing its SHA-256 with the manifest.

        Raises ``DatasetError`` if the file cannot be read or differs.
        """
        path = self.file(name)
        found, expected = file_sha256(path), self.files.get(name)
        if found != expected:
            raise DatasetError(
                f"{path}: the SHA-256 is {found[:16]}, expected {(expected or 'one')[:16]} as in the manifest; "
                f"rebar-bench verify {self.root} lists damaged files"
            )
        return path

    def expected_views(self) -> dict[str, tuple[int, int]]:
        """Return the (height, width) of every view of every config, keyed by view id."""
        return {view_id: config.grid for config in self.config_by_name.values() for view_id in config.view_ids}


class _GroundTruth(_ManifestTable):
    digest: _Digest


class _Format(_ManifestTable):
    format: Annotated[str, one_of(MANIFEST_FORMAT)]


class _Manifest(_ManifestTable):
    """Manifest of the supported format; its configs are validated one by one."""

    version: Annotated[str, text(100)]
    protocol: Annotated[str, one_of("rebar-1", "rebar-2")] = "rebar-1"
    ground_truth: _GroundTruth
    configs: Annotated[dict[str, dict[str, Any]], Expected("a table of one or more configs", bool)]
    files: dict[_Path, _Sha256]


def open_folder(root: str | Path, *, expect_digest: str | None = None) -> DatasetFolder:
    """Open a dataset folder or Hub dataset repository.

    Raises ``DatasetError`` if ``root`` is neither, or with all problems of its manifest if that is invalid, and if
    the dataset's digest is not ``expect_digest``.
    """
    if expect_digest is not None and not re.fullmatch(_DIGEST_PATTERN, expect_digest):
        raise InputError(
            f"the expected digest is {escape_text(expect_digest)}, expected sha256: and 64 hex digits"
        )
    root = str(root)
    path = local_path(root, MANIFEST_FILE)
    values, problems = parse_json(read_file(path, JSON_BYTES, "the manifest of a dataset", DatasetError))
    # Another format would cause many other problems.
    supported = not problems and validate_table(_Format, values, problems)
    head = validate_table(_Manifest, values, problems) if supported else None
    place = {"root": root, "commit": "" if Path(root).is_dir() else path.parent.name}
    configs = _read_configs(values.get("configs"), place, problems) if supported else {}
    if head is not None and not problems:
        digest = views_digest(view for config in configs.values() for view in config.views)
        if head.ground_truth.digest != digest:
            found, expected = f"got {head.ground_truth.digest}", f"the digest of all views, {digest}"
            problems.append(Problem("conflict", "ground_truth.digest", found, expected))
    if head is None or problems:
        raise DatasetError.from_problems(path, problems)
    digest = head.ground_truth.digest
    if expect_digest not in (None, digest):
        raise DatasetError(f"{root}: the dataset has the digest {digest}, expected {expect_digest}")
    return DatasetFolder(**place, version=head.version, digest=digest, files=head.files, config_by_name=configs)


def _read_configs(entries: object, place: dict[str, str], problems: list[Problem]) -> dict[str, DatasetConfig]:
    """Return the valid configs of a manifest, and append the problems of the others."""
    configs: dict[str, DatasetConfig] = {}
    for name, entry in entries.items() if isinstance(entries, dict) else ():
        if not isinstance(entry, dict):  # A problem of the whole manifest.
            continue
        where = format_location("configs", name)
        if entry.get("name", name) != name:
            found, expected = f"got {escape_text(str(entry['name']))}", f"{escape_text(name)}, the config's key"
            problems.append(Problem("conflict", format_location(where, "name"), found, expected))
        fields = {**entry, **place, "name": name, "manifest_entry": entry}
        if config := validate_table(DatasetConfig, fields, problems, where):
            configs[name] = config
    problems += _scene_problems(configs.values())
    return configs


def _scene_problems(configs: Iterable[DatasetConfig]) -> Iterator[Problem]:
    """Yield a problem for each config whose scene differs from an earlier one of the same name."""
    first: dict[str, DatasetConfig] = {}
    for config in configs:
        other = first.setdefault(config.scene.name, config)
        if (config.scene, config.mesh) != (other.scene, other.mesh):
            where = format_location("configs", config.name, "scene")
            found = f"scene {config.scene.name} has another board, mesh or appearance than in {other.name}"
            yield Problem("conflict", where, found, "one scene for each name")


def _check_unique(names: Sequence[str], what: str) -> None:
    """Raise the error of a field unless it has one or more names, each once."""
    if not names:
        raise field_error("got none", f"one {what} or more")
    name, occurrences = Counter(names).most_common(1)[0]
    if occurrences > 1:
        raise field_error(f"{name} occurs more than once", f"each {what} once", "duplicate")
