"""Configs that a dataset folder has already: what a build keeps of them, and what it may not replace.

A finished config is never replaced unless its name is given. It may grow: with the same parameters and more views
or scenes, the finished views among the new ones are kept. All of this is checked before anything is rendered.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

from dataset_builder.pipeline.folder import MESHES, PICTURES, SHARD_NAME, file_matches, stored_bars_path
from dataset_builder.pipeline.plan import ConfigPlan, by_config, config_parameters, generator_versions
from dataset_builder.pipeline.shards import VIEWS_PER_SHARD, stage_published_rows
from dataset_builder.pipeline.work_units import stage_mesh_digest
from dataset_builder.scene.model import Note
from dataset_builder.specs.config_specs import SceneConfigSpec
from dataset_builder.specs.manifest_specs import cage_spec
from rebar_depth_bench.base.errors import DatasetError, InputError, Problem
from rebar_depth_bench.base.names import TEST_SPLIT
from rebar_depth_bench.base.validation import format_location, short_repr
from rebar_depth_bench.base.writing import write_bytes
from rebar_depth_bench.data.files import MANIFEST_FILE, file_sha256
from rebar_depth_bench.data.manifest import DatasetConfig, DatasetFolder, open_folder
from rebar_depth_bench.data.schema import RANDOM_VIEWS, ViewRecord

_SHOWN_DIFFERENCES = 5
_NO_FORMS: Mapping[str, Any] = {"forms": []}
"""What the parameters of a scene without forms leave out."""


class Finished:
    """What a dataset folder has when a build of it begins; ``folder`` is None if it has no manifest yet.

    The manifest is read once, and a file is hashed once, when it is first asked for.
    """

    def __init__(self, out: Path) -> None:
        self._manifest = out / MANIFEST_FILE
        self._manifest_sha256 = self._current_sha256()
        self.folder = open_folder(out) if self._manifest_sha256 is not None else None
        self._scenes = {
            (config.name, scene.scene.name): scene
            for config in self.configs.values()
            for scene in config.by_scene()
        }
        self._match: dict[str, bool] = {}

    def _current_sha256(self) -> str | None:
        return file_sha256(self._manifest) if self._manifest.is_file() else None

    @property
    def is_outdated(self) -> bool:
        """Whether the manifest has been replaced since it was read."""
        return self._current_sha256() != self._manifest_sha256

    @property
    def configs(self) -> Mapping[str, DatasetConfig]:
        """Configs of the folder by name."""
        return {} if self.folder is None else self.folder.config_by_name

    def scene(self, plan: ConfigPlan) -> DatasetConfig | None:
        """Return the config of a plan, restricted to its scene; None if there is none of these names."""
        return self._scenes.get((plan.spec.name, plan.spec.scene.name))

    def has(self, plan: ConfigPlan) -> bool:
        """Return whether the folder has exactly the views of a plan, and files that match their digests."""
        scene = self.scene(plan)
        if scene is None or scene.view_ids != tuple(plan.view_ids) or differences(scene, plan):
            return False
        return all(map(self.matches, (*scene.shards, *scene.meshes)))

    def matches(self, name: str) -> bool:
        """Return whether a file exists with the digest that the manifest has for it."""
        if name not in self._match:
            self._match[name] = self.folder is not None and file_matches(self.folder, name)
        return self._match[name]

    def notes(self, plans: Sequence[ConfigPlan]) -> list[Note]:
        """Return a note for each finished scene of which some views are not among those that are planned."""
        found = [(plan, scene) for plan in plans if (scene := self.scene(plan)) is not None]
        lost = [(plan, scene, len(set(scene.view_ids) - plan.view_ids.keys())) for plan, scene in found]
        return [
            Note(
                f"config {scene.label}",
                "views",
                f"{count} of {len(scene.views)} finished views are not among the {len(plan.indices)} requested, "
                "and are removed when these are finished",
            )
            for plan, scene, count in lost
            if count
        ]

    def kept_views(self, plan: ConfigPlan) -> list[ViewRecord]:
        """Return the finished views that a plan has as well and that are not staged, if all parameters are equal.

        Those whose shards do not match their digests are left out.
        """
        scene = self.scene(plan)
        if scene is None or self.folder is None or differences(scene, plan) or scene.mesh not in self.folder.files:
            return []
        views, rows = iter(scene.views), plan.view_ids
        by_shard = {shard: list(islice(views, VIEWS_PER_SHARD)) for shard in scene.scene.shards}
        return [
            view
            for shard, of_shard in by_shard.items()
            for view in of_shard
            if view.view_id in rows and not plan.staging.row(rows[view.view_id]).is_file() and self.matches(shard)
        ]

    def stage_views(self, plan: ConfigPlan) -> None:
        """Stage the ``kept_views`` of a plan, and the mesh of their scene."""
        records = {view.view_id: view for view in self.kept_views(plan)}
        scene = self.scene(plan)
        if not records or scene is None or self.folder is None:
            return
        root = Path(self.folder.root)
        stage_mesh_digest(plan.staging, self.folder.files[scene.mesh])
        if self.matches(scene.mesh) and not plan.staging.mesh.is_file():
            write_bytes(plan.staging.mesh, (root / scene.mesh).read_bytes())
        targets = {view_id: plan.staging.row(index) for view_id, index in plan.view_ids.items()}
        for shard in filter(self.matches, scene.shards):
            stage_published_rows(root / shard, targets, records)


def differences(scene: DatasetConfig, plan: ConfigPlan) -> list[str]:
    """Return how the parameters of a finished scene differ from those of a plan, its number of views left out."""
    if scene.imported is not None:
        return ["it was imported"]
    if scene.has_splits != isinstance(plan.spec, SceneConfigSpec):
        return ["its views have other ids"]
    entry, parameters = {**_NO_FORMS, **scene.scene.entry}, config_parameters(plan.spec)
    of_config = {key: parameters[key] for key in ("protocol", "rig", "colour")}
    planned = {**_NO_FORMS, **parameters["scene"], **of_config, "generator": dict(generator_versions())}
    found = {**{key: entry.get(key) for key in planned}, "colour": scene.manifest_entry.get("colour")}
    if planned["protocol"]["kind"] == RANDOM_VIEWS:
        found["protocol"], planned["protocol"] = _shared_views(found["protocol"], planned["protocol"])
    return [
        f"{key} is {short_repr(value)}, {short_repr(requested)} is requested"
        for key, value, requested in _different_values("", found, planned)
    ]


def _shared_views(found: Any, planned: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
    """Return two trajectories of random views, each with the stations that both have and without their numbers.

    The views of a longer list begin with those of a shorter one; those of a plan may not be placed yet.
    """
    if not isinstance(found, dict) or not isinstance(found.get("stations"), list):
        return found, planned
    shared = min(len(found["stations"]), len(planned["stations"]))
    first, second = ({**views, "views": 0, "stations": views["stations"][:shared]} for views in (found, planned))
    return first, second


def _different_values(key: str, found: Any, planned: Any) -> Iterator[tuple[str, Any, Any]]:
    """Yield the keys, joined by dots, at which two JSON values differ, with both values there."""
    if isinstance(found, dict) and isinstance(planned, dict):
        for name in dict.fromkeys((*planned, *found)):
            yield from _different_values(format_location(key, name), found.get(name), planned.get(name))
    elif found != planned:
        yield key, found, planned


def check_retained(out: Path, finished: Finished, plans: Sequence[ConfigPlan], overwrite: Collection[str]) -> None:
    """Raise ``InputError`` if the folder cannot keep its other configs, or a config would lose finished views.

    A config may lose them if its name is among ``overwrite``. The entries of all other configs have to be valid,
    and the shards and meshes of scenes that are not planned to exist, in the size of the manifest.
    """
    if finished.folder is None:
        return
    by_name = by_config(plans)
    kept = [config for name, config in finished.configs.items() if name not in overwrite]
    # Of a config that is overwritten, other scenes may be kept.
    checked = [config for config in finished.configs.values() if config.name not in overwrite or config.has_splits]
    if problems := [problem for config in checked for problem in _entry_problems(finished.folder, config)]:
        raise DatasetError.from_problems(out / MANIFEST_FILE, problems)
    planned = [config for config in kept if config.name in by_name]
    if problems := [one for config in planned for one in _loss_problems(finished, config, by_name[config.name])]:
        raise InputError.from_problems(out, problems)
    scenes = {plan.spec.scene.name for plan in plans}
    if any(scene.name not in scenes for config in kept for scene in config.scenes):
        stored_bars_path(out, finished.folder)
    for config in kept:
        _check_scene(out, config, plans)
        _check_files(out, config, by_name.get(config.name, ()))


def kept_scenes(config: DatasetConfig | None, plans: Sequence[ConfigPlan]) -> list[DatasetConfig]:
    """Return the scenes of a config that are not planned and fit to those that are, each with its views.

    All scenes of a config have the same image size, colour, seed and version of the generator.
    """
    if config is None or not config.has_splits or not isinstance(plans[0].spec, SceneConfigSpec):
        return []
    spec, parameters = plans[0].spec, config_parameters(plans[0].spec)
    shown = ((spec.rig.height, spec.rig.width), parameters["colour"])
    if (config.grid, config.manifest_entry["colour"]) != shown:
        return []
    names = {plan.spec.scene.name for plan in plans}
    return [
        scene
        for scene in config.by_scene()
        if scene.scene.name not in names
        and _generator(scene.scene.entry["assembly"]) == _generator(parameters["scene"]["assembly"])
    ]


def _generator(assembly: Mapping[str, Any]) -> tuple[Any, Any]:
    return assembly.get("seed"), assembly.get("version")


def _entry_problems(folder: DatasetFolder, config: DatasetConfig) -> Iterator[Problem]:
    """Yield the problems of a config whose files have other names than a build gives them, or no digest."""
    where = format_location("configs", config.name)
    if not config.views:
        yield Problem("missing", f"{where}.views", "no views", "at least one view")
    names = [(f"{where}.sheet", config.sheet, f"{PICTURES}/{config.name}.webp")]
    for number, scene in enumerate(config.scenes):
        place = format_location(where, "scenes", number)
        if config.imported is None:
            names.append((f"{place}: mesh", str(scene.mesh), f"{MESHES}/{scene.name}.ply"))
        for shard in scene.shards:
            path, _, name = shard.partition("/")
            if path != config.name or not SHARD_NAME.fullmatch(name):
                split = "SPLIT-SCENE" if config.has_splits else TEST_SPLIT
                expected = f"{config.name}/{split}-NNNNN-of-NNNNN-DIGEST.parquet"
                yield Problem("name", f"{place}: shards", f"got {shard}", expected)
    for place, found, expected in names:
        if found != expected:
            yield Problem("name", place, f"got {found}", expected)
    for of_scene in config.by_scene() if config.has_splits else ():
        try:
            cage_spec(of_scene)
        except DatasetError as error:
            yield from error.problems
    for name in config.files:
        if name not in folder.files:
            yield Problem("missing", "files", f"no digest of {name} of config {config.name}", "one of each file")


def _loss_problems(finished: Finished, config: DatasetConfig, plans: Sequence[ConfigPlan]) -> Iterator[Problem]:
    """Yield a problem if a finished config would lose views other than by growing, with all that differs."""
    reasons: dict[str, None] = {}
    lost = 0
    may_grow = config.has_splits and isinstance(plans[0].spec, SceneConfigSpec)
    version = config_parameters(plans[0].spec)["scene"]["assembly"].get("version")
    versions = {scene.entry["assembly"].get("version", 0) for scene in config.scenes} if may_grow else set()
    if earlier := versions - {version}:
        reasons[f"they are of version {min(earlier)} of the generator of cages, this is version {version}"] = None
    for plan in plans:
        scene = finished.scene(plan)
        if scene is None and may_grow:  # A further scene.
            continue
        scene = scene or config.by_scene()[0]
        found, planned = differences(scene, plan), plan.view_ids
        if not found and len(planned) <= len(scene.views) and planned.keys() != set(scene.view_ids):
            found = [f"it has {len(scene.views)} views, {len(planned)} are requested"]
        if found:
            reasons |= dict.fromkeys(found)
            lost += len(scene.views)
    if may_grow:
        others = len(config.scenes) - len(kept_scenes(config, plans))
        others -= sum(finished.scene(plan) is not None for plan in plans)
        if others:
            reasons[f"{others} other scenes have another image size, colour, seed or version"] = None
    if reasons:
        more = [f"{len(reasons) - _SHOWN_DIFFERENCES} more"] if len(reasons) > _SHOWN_DIFFERENCES else []
        shown = "; ".join([*list(reasons)[:_SHOWN_DIFFERENCES], *more])
        yield Problem(
            "conflict",
            f"config {config.name}",
            f"{lost or len(config.views)} finished views would be lost: {shown}",
            f"more views or scenes with the same parameters, or another folder (--out); --overwrite {config.name} "
            "replaces the config",
        )


def _check_scene(out: Path, config: DatasetConfig, plans: Sequence[ConfigPlan]) -> None:
    """Raise ``InputError`` if a scene of a config that is not planned is being changed."""
    scenes = {scene.name: {**_NO_FORMS, **scene.entry} for scene in config.scenes}
    for plan in plans:
        name = plan.spec.scene.name
        if plan.spec.name == config.name or name not in scenes:
            continue
        planned = {**_NO_FORMS, **config_parameters(plan.spec)["scene"]}
        if any(scenes[name].get(key) != value for key, value in planned.items()):
            raise InputError(
                f"{out}: config {config.name} was built with other parameters of scene {name!r}; rebuild it too "
                f"(--config {config.name} {plan.spec.name} --overwrite {config.name} {plan.spec.name}) or choose "
                "another folder"
            )


def _check_files(out: Path, config: DatasetConfig, plans: Sequence[ConfigPlan]) -> None:
    """Raise ``InputError`` if a file of a scene that is not planned is missing or has lost bytes."""
    planned = {plan.spec.scene.name for plan in plans}
    for scene in config.scenes:
        if scene.name in planned:
            continue
        files = [file for file in (*scene.shards, scene.mesh) if file is not None]
        missing = [file for file in files if not (out / file).is_file()]
        size = sum((out / shard).stat().st_size for shard in scene.shards) if not missing else scene.bytes
        if missing or size != scene.bytes:
            again = "import it again" if config.imported is not None else f"build it too: --config {config.name}"
            what = (
                f"{missing[0]} is missing" if missing else f"the shards have {size} bytes, expected {scene.bytes}"
            )
            raise InputError(f"{out}: scene {scene.name} of config {config.name}: {what}; {again}")
