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
from dataset_builder.pipeline.folder import MESHES, PICTURES, SHARD_NAME
from dataset_builder.pipeline.plan import ConfigPlan, config_parameters
from rebar_depth_bench.data.dataset_config import DatasetConfig
from rebar_depth_bench.data.manifest import MANIFEST_FILE, open_folder
from rebar_depth_bench.data.trajectory import SURVEY
from rebar_depth_bench.errors import DatasetError, InputError, Problem
from rebar_depth_bench.validation import StrictModel, format_location, number, one_of, text, validate_table

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
    steel_samples: _Count | None = None
    """None in entries of versions that sampled uniformly."""


class _Rig(_Table):
    grid: Annotated[str, one_of(*GRIDS)]


class _Protocol(_Table):
    kind: Annotated[str, one_of("dome", "ring", "sweep", SURVEY)]
    radius_m: _Distance = 1.0


class _ImportedEntry(_Table):
    """Keys of the manifest entry of an imported config that the card shows."""

    bytes: _Count
    protocol_views: _Count


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
    retained = [config for name, config in published_configs(out).items() if name not in planned]
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
    validate_table(_Entry if config.imported is None else _ImportedEntry, config.manifest_entry, problems, where)
    yield from problems
    if not config.views or not config.shards:
        yield Problem("missing", where, "no views", "at least one view")
    names = [("sheet", config.sheet, f"{PICTURES}/{config.name}.webp")]
    if config.imported is None:
        names.append(("mesh", config.mesh, f"{MESHES}/{config.scene.name}.ply"))
    for key, found, expected in names:
        if found != expected:
            yield Problem("name", f"{where}.{key}", f"got {found}", expected)
    for shard in config.shards:
        folder, _, name = shard.partition("/")
        if folder != config.name or not SHARD_NAME.fullmatch(name):
            expected = f"{config.name}/test-NNNNN-of-NNNNN-DIGEST.parquet"
            yield Problem("name", f"{where}.shards", f"got {shard}", expected)


def _check_scene(out: Path, config: DatasetConfig, plans: Sequence[ConfigPlan]) -> None:
    for plan in plans:
        scene: Any = json.loads(json.dumps(config_parameters(plan.spec)["scene"]))
        if config.scene.name == scene["name"] and config.manifest_entry["scene"] != scene:
            raise InputError(
                f"{out}: config {config.name} was built with other parameters of scene {scene['name']!r}; "
                f"rebuild it too (--config {config.name} {plan.spec.name}) or choose another folder"
            )
