"""Configs of a dataset as the manifest describes them: scenes, cameras, views and digests."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import cached_property
from typing import Annotated, Any, Self

from pydantic import Field, Strict, StringConstraints, ValidationInfo, field_validator

from rebar_depth_bench.data.digests import views_digest
from rebar_depth_bench.data.location import Located
from rebar_depth_bench.data.manifest_table import ManifestTable
from rebar_depth_bench.data.trajectory import Survey, Trajectory, trajectory_of
from rebar_depth_bench.errors import DatasetError, escape_text
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.paths import NAME_LETTERS, NAME_PATTERN, PATH_PATTERN, VIEW_ID_PATTERN
from rebar_depth_bench.validation import (
    Expected,
    StrictModel,
    check_unique,
    field_error,
    number,
    one_of,
    whole_number,
)
from rebar_depth_bench.view_ids import SPLITS, TEST_SPLIT

SCENE_FILES = ("mesh", "shards")
"""Keys of a scene that the entry of a config of one scene has beside the scene."""
DIGEST_PATTERN = "sha256:[0-9a-f]{64}"
_Name = Annotated[str, StringConstraints(pattern=f"^{NAME_PATTERN}$"), Expected(f"a name of {NAME_LETTERS}")]
RelativePath = Annotated[
    str,
    StringConstraints(pattern=f"^{PATH_PATTERN}$"),
    Expected(f"a path in the folder, whose parts are {NAME_LETTERS}"),
]
_ViewId = Annotated[str, StringConstraints(pattern=f"^{VIEW_ID_PATTERN}$")]
# Views have no ``Expected``, which is called from pydantic: a folder has thousands.
Sha256 = Annotated[str, StringConstraints(pattern="^[0-9a-f]{64}$")]
Digest = Annotated[str, StringConstraints(pattern=f"^{DIGEST_PATTERN}$"), Expected("sha256: and 64 hex digits")]
_Side = Annotated[int, whole_number(1, 16384)]
_Length = Annotated[float, number(0, 10)]
_Distance = Annotated[float, number(0)]


class ViewRecord(StrictModel):
    """Manifest entry of one view.

    ``left`` and ``right`` are the hex SHA-256 digests of the cameras' ground truth; ``steel_px`` and ``scored_px``
    count steel and scored pixels.
    """

    view_id: _ViewId
    left: Sha256
    right: Sha256
    steel_px: Annotated[int, Field(ge=0)]
    scored_px: Annotated[int, Field(ge=0)]


class Appearance(ManifestTable):
    """Names of the appearance variants of a scene."""

    variants: Annotated[tuple[_Name, ...], Strict(False)] = ()


class _BoardTable(StrictModel):
    width_m: _Length
    height_m: _Length
    markers: Annotated[int, one_of(6, 12)]
    marker_side_m: _Length
    dictionary: _Name


class Scene(ManifestTable):
    """Scene of a config, with its mesh and its shards, which hold the rows of no other scene.

    ``board`` is the ArUco board under the assembly, or None.
    """

    name: _Name
    split: Annotated[str, one_of(*SPLITS)] = TEST_SPLIT
    board: BoardSpec | None
    appearance: Appearance = Appearance()
    mesh: RelativePath
    shards: Annotated[tuple[RelativePath, ...], Strict(False)]

    @field_validator("board", mode="before")
    @classmethod
    def _make_board(cls, fields: Any) -> BoardSpec | None:
        return None if fields is None else BoardSpec(**_BoardTable.model_validate(fields).model_dump())

    @field_validator("shards")
    @classmethod
    def _check_shards(cls, shards: tuple[str, ...]) -> tuple[str, ...]:
        check_unique(shards, "shard")
        return shards


class Rig(ManifestTable):
    """Image size of a stereo rig, pixels."""

    width: _Side
    height: _Side


class ReferenceRecord(ManifestTable):
    """AbsRel and RMSE (cm) of a reference, means over the views; None where undefined."""

    abs_rel: _Distance | None
    rmse_cm: _Distance | None


class References(ManifestTable):
    """Reference errors of a config, as in the tables of results."""

    constant: ReferenceRecord
    one_pixel: ReferenceRecord


class DatasetConfig(Located):
    """Config of a dataset, or its scenes of one split, or one scene of it.

    ``manifest_entry`` is the entry of the whole config as it was written, with all parameters of the build.
    ``has_splits`` is False for a config of one scene, whose views are all in the split ``test`` and have ids
    ``<config>/<0000>``; in other configs the ids are ``<config>/<split>-<scene>-<0000>``. ``reference`` is None in
    folders of earlier versions, ``colour`` in configs without colour, whose colour columns are null in every row.
    """

    name: _Name
    has_splits: bool
    scenes: Annotated[tuple[Scene, ...], Strict(False)]
    rig: Rig
    views: Annotated[tuple[ViewRecord, ...], Strict(False)]
    ground_truth_digest: Digest
    protocol: Trajectory | Survey | None = None
    protocol_views: Annotated[int, whole_number(1, 1_000_000)] = 0
    key: Annotated[str, StringConstraints(max_length=200)]
    sheet: RelativePath
    reference: References | None = None
    colour: Annotated[dict[str, Any] | None, Expected("parameters of colour, or null")] = Field({}, repr=False)
    manifest_entry: dict[str, Any] = Field(repr=False)

    @classmethod
    def fields_of_entry(cls, name: str, entry: Mapping[str, Any]) -> dict[str, Any]:
        """Return the fields of a config from its entry in the manifest, ``root`` left out.

        An entry of one scene has ``scene``, ``mesh`` and ``shards``; another has ``scenes``, each with its own.
        """
        fields = {**entry, "name": name, "manifest_entry": entry, "has_splits": "scenes" in entry}
        if "scenes" not in entry and isinstance(entry.get("scene"), dict):
            files = {key: entry[key] for key in SCENE_FILES if key in entry}
            fields["scenes"] = [{**entry["scene"], "split": TEST_SPLIT, **files}]
        return fields

    @field_validator("protocol", mode="before")
    @classmethod
    def _make_protocol(cls, fields: Any) -> Trajectory | Survey | None:
        return None if fields is None else trajectory_of(fields)

    @field_validator("scenes")
    @classmethod
    def _check_scenes(cls, scenes: tuple[Scene, ...]) -> tuple[Scene, ...]:
        check_unique([scene.name for scene in scenes], "scene")
        check_unique([shard for scene in scenes for shard in scene.shards], "shard")
        return scenes

    @field_validator("views")
    @classmethod
    def _check_views(cls, views: tuple[ViewRecord, ...], info: ValidationInfo) -> tuple[ViewRecord, ...]:
        check_unique([view.view_id for view in views], "view")
        name, rig, scenes = info.data.get("name"), info.data.get("rig"), info.data.get("scenes")
        prefixes = {f"{scene.split}-{scene.name}-" for scene in scenes or ()} if info.data["has_splits"] else set()
        for view in views:
            config, _, suffix = view.view_id.partition("/")
            if name is not None and config != name:
                raise field_error(f"got {view.view_id}", f"view ids that start with {name}/")
            if prefixes and (suffix.rstrip("0123456789") not in prefixes or not suffix[-4:].isdecimal()):
                expected = f"{name}/<split>-<scene>-<0000> with the split and name of a scene"
                raise field_error(f"got {view.view_id}", expected)
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

    @property
    def splits(self) -> tuple[str, ...]:
        """Splits that have scenes."""
        return tuple(split for split in SPLITS if any(scene.split == split for scene in self.scenes))

    @property
    def scene(self) -> Scene:
        """The only scene. Raises ``DatasetError`` for several."""
        if len(self.scenes) > 1:
            found = f"config {self.name} has {len(self.scenes)} scenes"
            raise DatasetError(f"{self.root}: {found}, expected one; this works on one scene at a time")
        return self.scenes[0]

    @property
    def mesh(self) -> str:
        """Name of the mesh of the only scene. Raises ``DatasetError`` as ``scene``."""
        return self.scene.mesh

    @property
    def meshes(self) -> tuple[str, ...]:
        """Names of the meshes of all scenes."""
        return tuple(scene.mesh for scene in self.scenes)

    @property
    def shards(self) -> tuple[str, ...]:
        """Names of the shards of all scenes, in order."""
        return tuple(shard for scene in self.scenes for shard in scene.shards)

    @cached_property
    def scene_by_view(self) -> Mapping[str, str]:
        """Name of the scene of each view, by view id."""
        if not self.has_splits:
            return dict.fromkeys(self.view_ids, self.scene.name)
        names = {f"{self.name}/{scene.split}-{scene.name}": scene.name for scene in self.scenes}
        return {view_id: names[view_id.rpartition("-")[0]] for view_id in self.view_ids}

    def of_split(self, split: str) -> Self:
        """Return the scenes of a split. Raises ``DatasetError`` if there are none."""
        if split not in self.splits:
            found = f"config {self.name} has no split {escape_text(split)}"
            raise DatasetError(f"{self.root}: {found}, expected {' or '.join(self.splits)}")
        return self._of_scenes([scene for scene in self.scenes if scene.split == split])

    def by_scene(self) -> tuple[Self, ...]:
        """Return the config restricted to each of its scenes."""
        return tuple(self._of_scenes([scene]) for scene in self.scenes)

    def _of_scenes(self, scenes: Collection[Scene]) -> Self:
        if len(scenes) == len(self.scenes):
            return self
        names = {scene.name for scene in scenes}
        views = tuple(view for view in self.views if self.scene_by_view[view.view_id] in names)
        restricted = self.model_copy(update={"scenes": tuple(scenes), "views": views})
        restricted.__dict__.pop("scene_by_view", None)  # The copy has the cached value of the whole config.
        return restricted

    @property
    def label(self) -> str:
        """Name of the config, with its split and its scene if it has splits and is restricted to one of them."""
        split = f".{self.splits[0]}" if self.has_splits and len(self.splits) == 1 else ""
        return f"{self.name}{split}-{self.scene.name}" if split and len(self.scenes) == 1 else self.name + split

    @property
    def grid(self) -> tuple[int, int]:
        """Image size (height, width), pixels."""
        return self.rig.height, self.rig.width

    @property
    def view_ids(self) -> tuple[str, ...]:
        """Ids of the views, in order."""
        return tuple(view.view_id for view in self.views)
