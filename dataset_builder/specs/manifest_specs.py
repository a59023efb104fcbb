"""Specs of a scene, read from its entry in the manifest; ``dataclasses.asdict`` writes them there."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from functools import cache
from typing import Any, TypeVar, cast, get_args

from pydantic import create_model

from dataset_builder.specs.config_specs import FocalRigSpec, GeneratedCageSpec, RigSpec, TrajectorySpec
from rebar_depth_bench.base.errors import DatasetError, Problem
from rebar_depth_bench.base.validation import StrictModel, format_location, validate_table
from rebar_depth_bench.data.files import MANIFEST_FILE
from rebar_depth_bench.data.manifest import DatasetConfig

_Spec = TypeVar("_Spec")
_TRAJECTORIES: Mapping[str, type[TrajectorySpec]] = {spec.kind: spec for spec in get_args(TrajectorySpec)}


def trajectory_spec(config: DatasetConfig) -> TrajectorySpec:
    """Return the camera trajectory of a config of one scene.

    Raises ``DatasetError`` with all problems if the manifest does not have one that this version writes.
    """
    kind = config.scene.trajectory.kind if config.scene.trajectory is not None else ""
    return _read_spec(config, "protocol", _TRAJECTORIES[kind])


def rig_spec(config: DatasetConfig) -> RigSpec:
    """Return the stereo rig of a config of one scene. Raises ``DatasetError`` as ``trajectory_spec``."""
    values = config.scene.entry.get("rig")
    is_focal = isinstance(values, dict) and "focal_px" in values
    return _read_spec(config, "rig", FocalRigSpec if is_focal else RigSpec)


def cage_spec(config: DatasetConfig) -> GeneratedCageSpec:
    """Return the generated cage of a config of one scene. Raises ``DatasetError`` as ``trajectory_spec``."""
    return _read_spec(config, "assembly", GeneratedCageSpec)


@cache
def _model_of(key: str, spec: Hashable) -> type[StrictModel]:
    """Return the model of a table whose only key has a spec."""
    fields: dict[str, Any] = {key: (spec, ...)}
    return create_model("SceneEntry", __base__=StrictModel, **fields)


def _read_spec(config: DatasetConfig, key: str, spec: type[_Spec]) -> _Spec:
    problems: list[Problem] = []
    where = format_location("configs", config.name, "scenes", config.scene.name)
    values: dict[str, Any] = {key: config.scene.entry[key]} if key in config.scene.entry else {}
    entry = validate_table(_model_of(key, cast(Hashable, spec)), values, problems, where, from_json=True)
    if entry is None:
        raise DatasetError.from_problems(f"{config.root}: {MANIFEST_FILE}", problems)
    value: _Spec = getattr(entry, key)
    return value
