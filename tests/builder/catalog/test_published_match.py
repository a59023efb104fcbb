"""Configs beside which the paper's rows are shown."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from dataset_builder.cameras.trajectories import view_count
from dataset_builder.catalog.named_configs import CONFIGS
from dataset_builder.pipeline.plan import config_parameters
from dataset_builder.specs.config_specs import ConfigSpec
from rebar_depth_bench.data.files import views_digest
from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.data.schema import ViewRecord
from rebar_depth_bench.scoring.table import PublishedMatch
from rebar_depth_bench.scoring.truth import published_match


def config_of_spec(spec: ConfigSpec, views: int | None = None) -> DatasetConfig:
    """Return the config of a complete build, or of one with fewer ``views``."""
    count = view_count(spec.protocol)
    records = [
        ViewRecord(view_id=f"{spec.name}/{n:04d}", left="0" * 64, right="0" * 64, steel_px=9, scored_px=1)
        for n in range(views or count)
    ]
    parameters = config_parameters(spec)
    scene = {
        **parameters["scene"],
        **{key: parameters[key] for key in ("protocol", "rig")},
        "split": "test",
        "protocol_views": count,
        "key": "k",
        "mesh": "m.ply",
        "shards": ["x.parquet"],
        "bytes": 1,
    }
    entry: dict[str, Any] = {
        **{key: parameters[key] for key in ("name", "rig", "colour")},
        "has_splits": False,
        "scenes": [scene],
        "sheet": "s.webp",
        "ground_truth_digest": views_digest(records),
        "views": [record.model_dump() for record in records],
    }
    return DatasetConfig(**DatasetConfig.fields_of_entry(entry["name"], entry), root="x")


EXACT = {"lattice-zed": "lattice", "pile": "pile", "pier": "pier"}
OTHER_OPTICS = {"lattice": "lattice", "lattice-zed-raw": "lattice"}


@pytest.mark.parametrize("name", CONFIGS)
def test_standard_configs(name: str) -> None:
    expected = None
    if scene := (EXACT | OTHER_OPTICS).get(name):
        expected = PublishedMatch(scene, same_optics=name in EXACT)
    assert published_match(config_of_spec(CONFIGS[name]())) == expected


@pytest.mark.parametrize(
    "change",
    [
        lambda spec: replace(spec, rig=replace(spec.rig, width=640, height=360)),
        lambda spec: replace(spec, protocol=replace(spec.protocol, azimuths=11)),
        lambda spec: replace(spec, protocol=replace(spec.protocol, distance_to="centre")),
        lambda spec: replace(spec, scene=replace(spec.scene, environment="laboratory")),
        lambda spec: replace(spec, scene=replace(spec.scene, assembly=replace(spec.scene.assembly, levels=44))),
    ],
)
def test_other_conditions_have_no_match(change: Callable[[ConfigSpec], ConfigSpec]) -> None:
    assert published_match(config_of_spec(change(CONFIGS["pier"]()))) is None


def test_incomplete_build_has_no_match() -> None:
    assert published_match(config_of_spec(CONFIGS["pier"](), views=6)) is None
