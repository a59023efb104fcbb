"""Manifest of a dataset folder or Hub repository: its configs with their scenes and views, digests and files."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import AliasPath, Field, PrivateAttr, Strict, ValidationInfo, field_validator

from rebar_depth_bench.base.errors import DatasetError, InputError, Problem, escape_text
from rebar_depth_bench.base.limits import JSON_BYTES
from rebar_depth_bench.base.names import SPLITS, TEST_SPLIT, scene_prefix
from rebar_depth_bench.base.reading import parse_json, read_file
from rebar_depth_bench.base.validation import (
    check_unique,
    field_error,
    format_location,
    one_of,
    short_repr,
    text,
    validate_table,
)
from rebar_depth_bench.data.files import (
    MANIFEST_FILE,
    Located,
    file_sha256,
    parameters_digest,
    planes_digest,
    views_digest,
)
from rebar_depth_bench.data.schema import (
    DIGEST_PATTERN,
    EYES,
    Colour,
    Digest,
    Imported,
    ManifestTable,
    Name,
    References,
    RelativePath,
    Rig,
    Scene,
    Sha256,
    Survey,
    ViewRecord,
)


class DatasetConfig(Located):
    """Config of a dataset, or its scenes of one split, or one scene of it.

    ``manifest_entry`` is the entry of the whole config as it was written, with all parameters of the build.
    ``has_splits`` is False for a config of one scene, whose views are all in the split ``test`` and have ids
    ``<config>/<0000>``; in other configs the ids are ``<config>/<split>-<scene>-<0000>``. ``references`` are the
    reference errors by split. ``colour`` is None in configs without colour, whose colour columns are null in every
    row. ``imported`` is None in configs that were rendered. ``planes_digest`` may be None if no scene has planes.
    """

    manifest_entry: dict[str, Any] = Field(repr=False)
    name: Name
    has_splits: bool
    imported: Imported | None = None
    scenes: Annotated[tuple[Scene, ...], Strict(False)]
    rig: Rig
    views: Annotated[tuple[ViewRecord, ...], Strict(False)]
    ground_truth_digest: Digest
    planes_digest: Annotated[Digest | None, Field(validate_default=True)] = None
    sheet: RelativePath
    references: dict[str, References] = Field({})
    colour: Colour | None
    _whole: Self | None = PrivateAttr(default=None)

    @classmethod
    def fields_of_entry(cls, name: str, entry: Mapping[str, Any]) -> dict[str, Any]:
        """Return the fields of a config from its entry in the manifest, ``root`` left out."""
        return {**entry, "name": name, "manifest_entry": entry}

    @field_validator("name")
    @classmethod
    def _check_name(cls, name: str, info: ValidationInfo) -> str:
        if (found := info.data["manifest_entry"].get("name", name)) != name:
            raise field_error(f"got {escape_text(str(found))}", f"{name}, the config's key", "conflict")
        return name

    @field_validator("scenes")
    @classmethod
    def _check_scenes(cls, scenes: tuple[Scene, ...], info: ValidationInfo) -> tuple[Scene, ...]:
        check_unique([scene.name for scene in scenes], "scene")
        check_unique([shard for scene in scenes for shard in scene.shards], "shard")
        if info.data.get("imported") is None:
            for scene in scenes:
                for key in ("mesh", "assembly", "protocol", "rig"):
                    if scene.entry.get(key) is None:
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
            expected_absent = "right_depth" in absent, "left_mask" in absent
            if (view.right is None, view.steel_px is None) != expected_absent:
                found = f"{view.view_id} has null values"
                raise field_error(found, "null where the columns are absent", "conflict")
            image_px = rig.width * rig.height if rig is not None else view.scored_px
            steel_px = image_px if view.steel_px is None else view.steel_px
            if rig is not None and not view.scored_px <= steel_px <= image_px:
                found = f"{view.view_id} has {view.scored_px} scored and {steel_px} steel pixels"
                raise field_error(found, f"no more scored than steel pixels, and at most {image_px}")
        return views

    @field_validator("ground_truth_digest")
    @classmethod
    def _check_digest(cls, digest: str, info: ValidationInfo) -> str:
        if "views" in info.data and digest != (expected := views_digest(info.data["views"])):
            raise field_error(f"got {digest}", f"the digest of the views, {expected}", "conflict")
        return digest

    @field_validator("planes_digest")
    @classmethod
    def _check_planes_digest(cls, digest: str | None, info: ValidationInfo) -> str | None:
        scenes: tuple[Scene, ...] | None = info.data.get("scenes")
        if scenes is not None and (digest is not None or any(scene.planes for scene in scenes)):
            expected = planes_digest(scene.entry for scene in scenes)
            if digest != expected:
                raise field_error(f"got {digest}", f"the digest of the planes of formwork, {expected}", "conflict")
        return digest

    @property
    def views_per_distance(self) -> int | None:
        """Number of views at each distance of a survey; None for other cameras, and with splits."""
        trajectory = None if self.has_splits else self.scenes[0].trajectory
        return trajectory.views_per_distance if isinstance(trajectory, Survey) else None

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
        """Name of the mesh of the only scene. Raises ``DatasetError`` for several scenes, and without a mesh."""
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
            found = f"config {self.name} has no split {escape_text(str(split))}"
            raise DatasetError(f"{self.root}: {found}, expected {' or '.join(self.splits)}")
        if len(self.splits) == 1:
            return self
        scenes = {scene.name: scene for scene in self.scenes if scene.split == split}
        views = (view for view in self.views if self.scene_by_view[view.view_id] in scenes)
        return self._restricted(scenes.values(), views)

    def by_scene(self) -> tuple[Self, ...]:
        """Return the config restricted to each of its scenes."""
        if len(self.scenes) == 1:
            return (self,)
        views: dict[str, list[ViewRecord]] = {scene.name: [] for scene in self.scenes}
        for view in self.views:
            views[self.scene_by_view[view.view_id]].append(view)
        return tuple(self._restricted((scene,), views[scene.name]) for scene in self.scenes)

    def of_views(self, view_ids: Collection[str]) -> Self:
        """Return the config restricted to some of its views."""
        restricted = self._restricted(self.scenes, (view for view in self.views if view.view_id in view_ids))
        restricted._whole = self.whole
        return restricted

    @property
    def whole(self) -> Self:
        """The config with all views of its scenes."""
        return self._whole or self

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
    def grid(self) -> tuple[int, int]:
        """Image size (height, width), pixels."""
        return self.rig.height, self.rig.width

    @property
    def view_ids(self) -> tuple[str, ...]:
        """Ids of the views, in order."""
        return tuple(view.view_id for view in self.views)


MANIFEST_FORMAT = "rebar-depth-dataset-2"


class DatasetFolder(Located):
    """Dataset with a validated manifest.

    ``files`` are the hex SHA-256 digests of its files, by path; ``crossings`` are the parameters by which the
    crossings of bars were found.
    """

    version: Annotated[str, text(100)]
    protocol: Annotated[str, one_of("rebar-2")]
    config_by_name: dict[str, DatasetConfig] = Field(alias="configs")
    digest: Digest = Field(validation_alias=AliasPath("ground_truth", "digest"))
    crossings: dict[str, Any] = Field({})
    files: dict[RelativePath, Sha256]

    @field_validator("config_by_name", mode="before")
    @classmethod
    def _add_place(cls, entries: Any, info: ValidationInfo) -> Any:
        if not isinstance(entries, dict) or not entries:
            raise field_error(f"got {short_repr(entries)}", "a table of one or more configs")
        place = {"root": info.data["root"], "commit": info.data["commit"]}
        return {
            name: {**DatasetConfig.fields_of_entry(name, entry), **place} if isinstance(entry, dict) else entry
            for name, entry in entries.items()
        }

    @property
    def configs(self) -> tuple[str, ...]:
        """Names of the configs."""
        return tuple(self.config_by_name)

    def config(self, name: str) -> DatasetConfig:
        """Return a config; raise ``DatasetError`` if there is none of that name."""
        if name not in self.config_by_name:
            hint = f"; rdb.{name} reads {name}.parquet" if f"{name}.parquet" in self.files else ""
            expected = f"one of {', '.join(self.configs)}{hint}"
            raise DatasetError(f"{self.root}: no config {name!r}, expected {expected}")
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

    def expected_views(self, split: str | None = None) -> dict[str, tuple[int, int]]:
        """Return the (height, width) of every view of every config, or of one split, keyed by view id."""
        configs: Iterable[DatasetConfig] = self.config_by_name.values()
        if split is not None:
            configs = [config.of_split(split) for config in configs if split in config.splits]
        return {view_id: config.grid for config in configs for view_id in config.view_ids}


class _Format(ManifestTable):
    format: Annotated[str, one_of(MANIFEST_FORMAT)]


def open_folder(root: str | Path, *, expect_digest: str | None = None) -> DatasetFolder:
    """Open a dataset folder or Hub dataset repository.

    Raises ``DatasetError`` if ``root`` is neither, if the manifest is invalid, with all its problems, and if the
    dataset's digest is not ``expect_digest``.
    """
    if expect_digest is not None and not re.fullmatch(DIGEST_PATTERN, expect_digest):
        raise InputError(
            f"the expected digest is {escape_text(expect_digest)}, expected sha256: and 64 hex digits"
        )
    root = str(root)
    path = Located(root=root).file(MANIFEST_FILE)
    values, problems = parse_json(read_file(path, JSON_BYTES, "the manifest of a dataset", DatasetError))
    folder = validated_folder(values, problems, root, path)
    if expect_digest not in (None, folder.digest):
        raise DatasetError(f"{root}: the dataset has the digest {folder.digest}, expected {expect_digest}")
    return folder


def validated_folder(values: Any, problems: list[Problem], root: str, path: Path) -> DatasetFolder:
    """Return the dataset in ``root`` that was read from ``path``, if there are no ``problems``.

    Raises ``DatasetError`` with ``problems`` and the problems of the values.
    """
    folder = None
    if not problems and validate_table(_Format, values, problems):  # Another format would cause many problems.
        place = {"root": root, "commit": "" if Path(root).is_dir() else path.parent.name}
        folder = validate_table(DatasetFolder, {**values, **place}, problems)
    if folder is not None:
        problems += _scene_problems(folder.config_by_name.values())
        digest = views_digest(view for config in folder.config_by_name.values() for view in config.views)
        if folder.digest != digest:
            found, expected = f"got {folder.digest}", f"the digest of all views, {digest}"
            problems.append(Problem("conflict", "ground_truth.digest", found, expected))
    if folder is None or problems:
        raise DatasetError.from_problems(path, problems)
    return folder


def _scene_problems(configs: Iterable[DatasetConfig]) -> Iterator[Problem]:
    """Yield a problem for each scene without views, or unlike one of the same name in an earlier config."""
    first: dict[str, tuple[str, tuple[object, ...]]] = {}
    for config in configs:
        with_views = set(config.scene_by_view.values())
        for scene in config.scenes:
            if scene.name not in with_views:
                where, found = format_location("configs", config.name, "views"), f"scene {scene.name} has no view"
                yield Problem("missing", where, found, "one view or more of each scene")
            shown = (scene.board, scene.appearance, scene.mesh)
            other, expected = first.setdefault(scene.name, (config.name, shown))
            if shown != expected:
                where = format_location("configs", config.name, "scenes")
                found = f"scene {scene.name} has another board, mesh or appearance than in {other}"
                yield Problem("conflict", where, found, "one scene for each name")
