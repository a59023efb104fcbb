"""Configs of a dataset folder that a build keeps: checks of their manifest entries and files.

They are checked before anything is rendered, since card, pictures and manifest describe all configs of the folder.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from dataset_builder.config.rigs import GRIDS
from dataset_builder.config.specs import SceneConfigSpec
from dataset_builder.pipeline.folder import MESHES, PICTURES, SHARD_NAME
from dataset_builder.pipeline.plan import ConfigPlan, config_parameters
from rebar_depth_bench.data.config_tables import References
from rebar_depth_bench.data.dataset_config import DatasetConfig
from rebar_depth_bench.data.manifest import MANIFEST_FILE, open_folder
from rebar_depth_bench.data.trajectory import RANDOM_VIEWS, SURVEY
from rebar_depth_bench.errors import DatasetError, InputError, Problem
from rebar_depth_bench.validation import StrictModel, format_location, number, one_of, text, validate_table
from rebar_depth_bench.view_ids import TEST_SPLIT

_Count = Annotated[int, Field(ge=0)]
_Distance = Annotated[float, number(0)]


class _Table(StrictModel, extra="ignore"):
    """Base class of the objects of a manifest entry, whose other keys are not used."""


class _Assembly(_Table):
    kind: Annotated[str, text(60)]
    path: Annotated[str, text(1000)] = "-"
    sha256: Annotated[str, text(64)] = "-"


class _Scene(_Table):
    assembly: _Assembly


class _Colour(_Table):
    samples: _Count
    steel_samples: _Count


class _Rig(_Table):
    grid: Annotated[str, one_of(*GRIDS)]


class _Protocol(_Table):
    kind: Annotated[str, one_of("dome", "ring", "sweep", SURVEY, RANDOM_VIEWS)]
    radius_m: _Distance = 1.0


class _ImportedEntry(_Table):
    """Keys of the manifest entry of an imported config that the card shows."""

    bytes: _Count
    protocol_views: _Count


class _GeneratedCage(_Assembly):
    number: _Count
    seed: _Count
    version: _Count


class _SceneOfSplit(_Table):
    """Keys of the entry of a scene in a config of several scenes that the card and a build use."""

    name: Annotated[str, text(200)]
    family: Annotated[str, text(60)]
    assembly: _GeneratedCage
    key: Annotated[str, text(64)]
    bytes: _Count
    protocol: _Protocol
    rig: _Rig


class _ScenesEntry(_Table):
    """Keys of the manifest entry of a config of several scenes that the card and a build use."""

    bytes: _Count
    protocol_views: _Count
    colour: _Colour | None
    scenes: list[_SceneOfSplit]
    references: dict[str, References]


class _Entry(_Table):
    """Keys of a config's manifest entry that the card and the pictures show."""

    bytes: _Count
    protocol_views: _Count
    scene: _Scene
    colour: _Colour | None
    rig: _Rig
    protocol: _Protocol


def published_configs(out: Path) -> Mapping[str, DatasetConfig]:
    """Return the configs of the folder by name, none if it has no manifest yet."""
    return open_folder(out).config_by_name if (out / MANIFEST_FILE).is_file() else {}


def check_retained_configs(out: Path, plans: Sequence[ConfigPlan], replaced: Collection[str] = ()) -> None:
    """Raise ``InputError`` if a config that is not being built, or ``replaced``, is invalid or lacks a file.

    It also raises ``InputError`` if the scene of such a config is being changed.
    """
    planned = {plan.spec.name for plan in plans} | set(replaced)
    published = published_configs(out)
    _check_retained_scenes(out, published, plans)
    retained = [config for name, config in published.items() if name not in planned]
    problems = [problem for config in retained for problem in entry_problems(config)]
    if problems:
        raise DatasetError.from_problems(out / MANIFEST_FILE, problems)
    for config in retained:
        _check_scene(out, config, plans)
        missing_files = [file for file in (*config.shards, *config.meshes) if not (out / file).is_file()]
        if missing_files:
            again = (
                f"rebuild this config too: --config {config.name}"
                if config.imported is None
                else "import it again"
            )
            raise InputError(f"{out}: {missing_files[0]} of config {config.name} is missing; {again}")


def entry_problems(config: DatasetConfig) -> Iterator[Problem]:
    """Yield the problems of a config's manifest entry, whose files have the names that a build gives them."""
    where = format_location("configs", config.name)
    problems: list[Problem] = []
    model = _ImportedEntry if config.imported is not None else _ScenesEntry if config.has_splits else _Entry
    validate_table(model, config.manifest_entry, problems, where)
    yield from problems
    if not config.views or not config.shards:
        yield Problem("missing", where, "no views", "at least one view")
    names = [("sheet", config.sheet, f"{PICTURES}/{config.name}.webp")]
    if config.imported is None:
        names += [("mesh", str(scene.mesh), f"{MESHES}/{scene.name}.ply") for scene in config.scenes]
    for key, found, expected in names:
        if found != expected:
            yield Problem("name", f"{where}.{key}", f"got {found}", expected)
    for shard in config.shards:
        folder, _, name = shard.partition("/")
        if folder != config.name or not SHARD_NAME.fullmatch(name):
            split = "SPLIT-SCENE" if config.has_splits else TEST_SPLIT
            expected = f"{config.name}/{split}-NNNNN-of-NNNNN-DIGEST.parquet"
            yield Problem("name", f"{where}.shards", f"got {shard}", expected)


def _check_scene(out: Path, config: DatasetConfig, plans: Sequence[ConfigPlan]) -> None:
    for plan in plans:
        scene: Any = json.loads(json.dumps(config_parameters(plan.spec)["scene"]))
        is_named = scene["name"] in {published.name for published in config.scenes}
        if is_named and config.manifest_entry.get("scene") != scene:
            raise InputError(
                f"{out}: config {config.name} was built with other parameters of scene {scene['name']!r}; "
                f"rebuild it too (--config {config.name} {plan.spec.name}) or choose another folder"
            )


def _check_retained_scenes(out: Path, published: Mapping[str, DatasetConfig], plans: Sequence[ConfigPlan]) -> None:
    """Raise ``InputError`` if scenes that a config keeps do not fit to those that are planned, or lack a file.

    All scenes of a config have the same image size, colour, seed and version of the generator.
    """
    planned = [plan.spec for plan in plans if isinstance(plan.spec, SceneConfigSpec)]
    if not planned or planned[0].name not in published:
        return
    spec, config = planned[0], published[planned[0].name]
    if problems := list(entry_problems(config)):
        raise DatasetError.from_problems(out / MANIFEST_FILE, problems)
    names = {spec.scene.name for spec in planned}
    kept = [scene for scene in config.scenes if scene.name not in names]
    entries = {entry["name"]: entry for entry in config.manifest_entry["scenes"]}
    found = {(config.grid, _json(config.colour), *_generator(entries[scene.name]["assembly"])) for scene in kept}
    parameters = config_parameters(spec)
    grid = (spec.rig.height, spec.rig.width)
    if found - {(grid, _json(parameters["colour"]), *_generator(parameters["scene"]["assembly"]))}:
        raise InputError(
            f"{out}: contains {len(kept)} other scenes of {spec.name} with another image size, colour, seed or "
            "version of the generator; choose another folder (--out)"
        )
    for scene in kept:
        missing = [file for file in (*scene.shards, scene.mesh) if file is None or not (out / file).is_file()]
        if missing:
            raise InputError(f"{out}: {missing[0]} of scene {scene.name} of {spec.name} is missing; build it too")


def _generator(assembly: Mapping[str, Any]) -> tuple[int, int]:
    return assembly["seed"], assembly["version"]


def _json(values: object) -> str:
    return json.dumps(values, sort_keys=True)
