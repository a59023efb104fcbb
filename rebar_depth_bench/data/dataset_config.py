"""Configs of a dataset as the manifest describes them: scenes, cameras, views and digests."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import cached_property
from typing import Annotated, Any, Self

from pydantic import Field, Strict, StringConstraints, ValidationInfo, field_validator

from rebar_depth_bench.data.columns import EYES
from rebar_depth_bench.data.config_tables import (
    SCENE_FILES,
    Digest,
    Imported,
    Name,
    References,
    RelativePath,
    Rig,
    Scene,
    ViewRecord,
)
from rebar_depth_bench.data.digests import views_digest
from rebar_depth_bench.data.location import Located
from rebar_depth_bench.data.trajectory import Survey, Trajectory, trajectory_of
from rebar_depth_bench.errors import DatasetError, escape_text
from rebar_depth_bench.validation import Expected, check_unique, field_error, whole_number
from rebar_depth_bench.view_ids import SPLITS, TEST_SPLIT, scene_prefix


class DatasetConfig(Located):
    """Config of a dataset, or its scenes of one split, or one scene of it.

    ``manifest_entry`` is the entry of the whole config as it was written, with all parameters of the build.
    ``has_splits`` is False for a config of one scene, whose views are all in the split ``test`` and have ids
    ``<config>/<0000>``; in other configs the ids are ``<config>/<split>-<scene>-<0000>``. ``reference`` is None in
    configs of several scenes, ``colour`` in configs without colour, whose colour columns are null in every row.
    ``imported`` is None in configs that were rendered.
    """

    name: Name
    has_splits: bool
    imported: Imported | None = None
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
    def _check_scenes(cls, scenes: tuple[Scene, ...], info: ValidationInfo) -> tuple[Scene, ...]:
        check_unique([scene.name for scene in scenes], "scene")
        check_unique([shard for scene in scenes for shard in scene.shards], "shard")
        if info.data.get("imported") is None and any(scene.mesh is None for scene in scenes):
            raise field_error("mesh is null", "the mesh of a scene that was rendered", "conflict")
        return scenes

    @field_validator("views")
    @classmethod
    def _check_views(cls, views: tuple[ViewRecord, ...], info: ValidationInfo) -> tuple[ViewRecord, ...]:
        check_unique([view.view_id for view in views], "view")
        name, rig, scenes = info.data.get("name"), info.data.get("rig"), info.data.get("scenes")
        prefixes = (
            {scene_prefix(scene.split, scene.name) for scene in scenes or ()} if info.data["has_splits"] else set()
        )
        imported: Imported | None = info.data.get("imported")
        absent = imported.absent_columns if imported is not None else ()
        for view in views:
            config, _, suffix = view.view_id.partition("/")
            if name is not None and config != name:
                raise field_error(f"got {view.view_id}", f"view ids that start with {name}/")
            if prefixes and (suffix.rstrip("0123456789") not in prefixes or not suffix[-4:].isdecimal()):
                expected = f"{name}/<split>-<scene>-<0000> with the split and name of a scene"
                raise field_error(f"got {view.view_id}", expected)
            if (view.right is None) != ("right_depth" in absent) or (view.steel_px is None) != (
                "left_mask" in absent
            ):
                raise field_error(
                    f"{view.view_id} has null values", "null where the columns are absent", "conflict"
                )
            image_px = rig.width * rig.height if rig is not None else view.scored_px
            steel_px = image_px if view.steel_px is None else view.steel_px
            if rig is not None and not view.scored_px <= steel_px <= image_px:
                raise field_error(
                    f"{view.view_id} has {view.scored_px} scored and {steel_px} steel pixels",
                    f"no more scored than steel pixels, and at most {image_px}",
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
    def scene_entry(self) -> Mapping[str, Any]:
        """Part of ``manifest_entry`` with the parameters of the only scene: all of it in a config without splits.

        Raises ``DatasetError`` as ``scene``.
        """
        if not self.has_splits:
            return self.manifest_entry
        entries: dict[str, dict[str, Any]] = {entry["name"]: entry for entry in self.manifest_entry["scenes"]}
        return entries[self.scene.name]

    @property
    def mesh(self) -> str:
        """Name of the mesh of the only scene. Raises ``DatasetError`` as ``scene``, and if there is none."""
        if self.scene.mesh is None:
            raise DatasetError(f"{self.root}: config {self.name} was imported without a mesh, expected one")
        return self.scene.mesh

    @property
    def meshes(self) -> tuple[str, ...]:
        """Names of the meshes of all scenes that have one."""
        return tuple(scene.mesh for scene in self.scenes if scene.mesh is not None)

    @property
    def shards(self) -> tuple[str, ...]:
        """Names of the shards of all scenes, in order."""
        return tuple(shard for scene in self.scenes for shard in scene.shards)

    @cached_property
    def scene_by_view(self) -> Mapping[str, str]:
        """Name of the scene of each view, by view id."""
        if not self.has_splits:
            return dict.fromkeys(self.view_ids, self.scene.name)
        names = {f"{self.name}/{scene_prefix(scene.split, scene.name)}": scene.name for scene in self.scenes}
        return {view_id: names[view_id.rstrip("0123456789")] for view_id in self.view_ids}

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
    def files(self) -> tuple[str, ...]:
        """Names of the shards, meshes and the contact sheet."""
        return (*self.shards, *self.meshes, self.sheet)

    @property
    def absent_columns(self) -> frozenset[str]:
        """Columns that are null in every row."""
        without_colour = ("left_rgb", "right_rgb") if self.colour is None else ()
        return frozenset((*without_colour, *(self.imported.absent_columns if self.imported is not None else ())))

    @property
    def truth_eyes(self) -> tuple[str, ...]:
        """Eyes with ground truth: both, or the left one."""
        return tuple(eye for eye in EYES if f"{eye}_depth" not in self.absent_columns)

    @property
    def truth_sigma_m(self) -> float | None:
        """Standard deviation of the ground truth's depth, metres, None if it is exact."""
        return None if self.imported is None else self.imported.truth_sigma_m

    @property
    def grid(self) -> tuple[int, int]:
        """Image size (height, width), pixels."""
        return self.rig.height, self.rig.width

    @property
    def view_ids(self) -> tuple[str, ...]:
        """Ids of the views, in order."""
        return tuple(view.view_id for view in self.views)
