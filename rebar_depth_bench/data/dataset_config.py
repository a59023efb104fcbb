"""Configs of a dataset as the manifest describes them: scenes, cameras, views and digests."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cached_property
from typing import Annotated, Any, Self

from pydantic import Field, Strict, ValidationInfo, field_validator

from rebar_depth_bench.data.columns import EYES
from rebar_depth_bench.data.config_tables import (
    Colour,
    Digest,
    Imported,
    Name,
    References,
    RelativePath,
    Rig,
    Scene,
    ViewRecord,
)
from rebar_depth_bench.data.digests import parameters_digest, views_digest
from rebar_depth_bench.data.location import Located
from rebar_depth_bench.errors import DatasetError, escape_text
from rebar_depth_bench.names import SPLITS, TEST_SPLIT, scene_prefix
from rebar_depth_bench.validation import check_unique, field_error


class DatasetConfig(Located):
    """Config of a dataset, or its scenes of one split, or one scene of it.

    ``manifest_entry`` is the entry of the whole config as it was written, with all parameters of the build.
    ``has_splits`` is False for a config of one scene, whose views are all in the split ``test`` and have ids
    ``<config>/<0000>``; in other configs the ids are ``<config>/<split>-<scene>-<0000>``. ``references`` are the
    reference errors by split. ``colour`` is None in configs without colour, whose colour columns are null in every
    row. ``imported`` is None in configs that were rendered.
    """

    name: Name
    has_splits: bool
    imported: Imported | None = None
    scenes: Annotated[tuple[Scene, ...], Strict(False)]
    rig: Rig
    views: Annotated[tuple[ViewRecord, ...], Strict(False)]
    ground_truth_digest: Digest
    sheet: RelativePath
    references: dict[str, References] = Field({})
    colour: Colour | None
    manifest_entry: dict[str, Any] = Field(repr=False)

    @classmethod
    def fields_of_entry(cls, name: str, entry: Mapping[str, Any]) -> dict[str, Any]:
        """Return the fields of a config from its entry in the manifest, ``root`` left out."""
        return {**entry, "name": name, "manifest_entry": entry}

    @field_validator("scenes")
    @classmethod
    def _check_scenes(cls, scenes: tuple[Scene, ...], info: ValidationInfo) -> tuple[Scene, ...]:
        check_unique([scene.name for scene in scenes], "scene")
        check_unique([shard for scene in scenes for shard in scene.shards], "shard")
        if info.data.get("imported") is None:
            for scene in scenes:
                for key in ("mesh", "assembly", "protocol", "rig"):
                    if getattr(scene, key) is None:
                        found = f"{key} of scene {scene.name} is null"
                        raise field_error(found, f"the {key} of a scene that was rendered", "conflict")
        if not info.data.get("has_splits", True) and [scene.split for scene in scenes] != [TEST_SPLIT]:
            raise field_error(f"got {len(scenes)} scenes", f"one scene of the split {TEST_SPLIT}", "conflict")
        return scenes

    @field_validator("views")
    @classmethod
    def _check_views(cls, views: tuple[ViewRecord, ...], info: ValidationInfo) -> tuple[ViewRecord, ...]:
        check_unique([view.view_id for view in views], "view")
        name, rig, scenes = info.data.get("name"), info.data.get("rig"), info.data.get("scenes", ())
        has_splits = info.data.get("has_splits", False)
        by_prefix = {scene_prefix(scene.split, scene.name) if has_splits else "": scene for scene in scenes}
        imported: Imported | None = info.data.get("imported")
        absent = imported.absent_columns if imported is not None else ()
        for view in views:
            config, _, suffix = view.view_id.partition("/")
            if name is not None and config != name:
                raise field_error(f"got {view.view_id}", f"view ids that start with {name}/")
            prefix = suffix.rstrip("0123456789")
            scene, number = by_prefix.get(prefix), suffix.removeprefix(prefix)
            if has_splits and (scene is None or len(number) < 4):
                expected = f"{name}/<split>-<scene>-<0000> with the split and name of a scene"
                raise field_error(f"got {view.view_id}", expected)
            if scene is not None and number and int(number) >= scene.protocol_views:
                expected = f"an index below {scene.protocol_views}, the protocol_views of scene {scene.name}"
                raise field_error(f"got {view.view_id}", expected, "conflict")
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
    def key(self) -> str:
        """Digest of all parameters of the scenes."""
        keys = [scene.key for scene in self.scenes]
        return keys[0] if len(keys) == 1 else parameters_digest(keys)

    @property
    def bytes(self) -> int:
        """Size of the shards."""
        return sum(scene.bytes for scene in self.scenes)

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
        if len(self.splits) == 1:
            return self
        scenes = {scene.name: scene for scene in self.scenes if scene.split == split}
        return self._restricted(
            scenes.values(), (view for view in self.views if self.scene_by_view[view.view_id] in scenes)
        )

    def by_scene(self) -> tuple[Self, ...]:
        """Return the config restricted to each of its scenes."""
        if len(self.scenes) == 1:
            return (self,)
        views: dict[str, list[ViewRecord]] = {scene.name: [] for scene in self.scenes}
        for view in self.views:
            views[self.scene_by_view[view.view_id]].append(view)
        return tuple(self._restricted((scene,), views[scene.name]) for scene in self.scenes)

    def _restricted(self, scenes: Iterable[Scene], views: Iterable[ViewRecord]) -> Self:
        restricted = self.model_copy(update={"scenes": tuple(scenes), "views": tuple(views)})
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
