"""Publishing of generated scenes into a config of several scenes and splits.

Each scene has its own shards and mesh, so that scenes can be added without changing the files of others. The
config is published once all requested scenes are staged: its entry, card and pictures describe all scenes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from dataset_builder.pipeline.contact_sheet import write_contact_sheet
from dataset_builder.pipeline.folder import MESHES, PICTURES
from dataset_builder.pipeline.place_cameras import ScenePlan
from dataset_builder.pipeline.plan import ConfigPlan, config_parameters, generator_versions
from dataset_builder.pipeline.publish import publish_shards, scene_entries, write_manifest, write_scene_bars
from dataset_builder.pipeline.retained import published_configs
from dataset_builder.pipeline.shards import read_staged_record
from rebar_depth_bench.atomic_io import write_bytes
from rebar_depth_bench.data.config_tables import ViewRecord
from rebar_depth_bench.data.dataset_config import DatasetConfig
from rebar_depth_bench.data.digests import parameters_digest, views_digest
from rebar_depth_bench.scoring.ground_truth import reference_errors
from rebar_depth_bench.view_ids import SPLITS

_Entry = Mapping[str, Any]


def publish_scenes(out: Path, plans: Sequence[ConfigPlan]) -> None:
    """Publish the completely staged scenes among the plans of one config, beside those published already.

    Scenes of the same name are replaced.
    """
    name, staged = plans[0].spec.name, [plan for plan in plans if isinstance(plan, ScenePlan)]
    published = published_configs(out).get(name)
    kept, views_by_scene = _kept_scenes(published, [plan.spec.scene.name for plan in staged])
    for plan in staged:
        kept[plan.spec.scene.name] = _publish_scene(out, plan)
        views_by_scene[plan.spec.scene.name] = [
            read_staged_record(plan.staging.row(index), plan.spec.view_id(index)) for index in plan.indices
        ]
    scenes = sorted(kept.values(), key=lambda scene: (SPLITS.index(scene["split"]), scene["assembly"]["number"]))
    entry = _config_entry(staged[0], scenes, [view for s in scenes for view in views_by_scene[s["name"]]])
    changed = {plan.spec.scene.name for plan in staged}
    entry["references"] = _references(out, name, entry, published, changed)
    config = _dataset_config(out, name, entry)
    write_contact_sheet(config, out / config.sheet)
    write_scene_bars(out, {plan.spec.scene.name: plan.bars for plan in staged})
    write_manifest(out, {**published_configs(out), name: config})


def _kept_scenes(
    published: DatasetConfig | None, replaced: Iterable[str]
) -> tuple[dict[str, _Entry], dict[str, list[ViewRecord]]]:
    """Return the entries of the published scenes that are not replaced, and the views of all, by scene."""
    if published is None:
        return {}, {}
    entries = {name: entry for name, entry in scene_entries(published).items() if name not in set(replaced)}
    views: dict[str, list[ViewRecord]] = {name: [] for name in scene_entries(published)}
    for view in published.views:
        views[published.scene_by_view[view.view_id]].append(view)
    return entries, views


def _publish_scene(out: Path, plan: ScenePlan) -> _Entry:
    """Publish mesh and shards of a scene, and return its entry."""
    spec, parameters = plan.spec, config_parameters(plan.spec)
    mesh = f"{MESHES}/{spec.scene.name}.ply"
    write_bytes(out / mesh, plan.staging.mesh.read_bytes())
    shards = publish_shards(out, spec.name, spec.scene_prefix.rstrip("-"), plan.staging, plan.indices)
    return {
        **parameters["scene"],
        "split": parameters["split"],
        "family": plan.record["family"],
        "mesh": mesh,
        "shards": shards,
        "bytes": sum((out / shard).stat().st_size for shard in shards),
        "rig": parameters["rig"],
        "protocol": parameters["protocol"],
        "cage": dict(plan.record),
        "key": plan.key,
        "generator": generator_versions(),
    }


def _config_entry(plan: ScenePlan, scenes: Sequence[_Entry], views: Sequence[ViewRecord]) -> dict[str, Any]:
    """Return the entry of the config; image size and colour are those of all of its scenes."""
    rig = plan.spec.rig
    return {
        "scenes": list(scenes),
        "rig": {"width": rig.width, "height": rig.height},
        "colour": config_parameters(plan.spec)["colour"],
        "key": parameters_digest([scene["key"] for scene in scenes]),
        "protocol_views": len(views),
        "sheet": f"{PICTURES}/{plan.spec.name}.webp",
        "bytes": sum(scene["bytes"] for scene in scenes),
        "ground_truth_digest": views_digest(views),
        "views": [view.model_dump() for view in views],
    }


def _references(
    out: Path, name: str, entry: _Entry, published: DatasetConfig | None, changed: set[str]
) -> dict[str, Any]:
    """Return the reference errors of each split; those of splits without changed scenes are kept."""
    config = _dataset_config(out, name, entry)
    known = {} if published is None else published.manifest_entry.get("references", {})
    return {
        split: known[split]
        if split in known and not changed & {scene.name for scene in config.of_split(split).scenes}
        else reference_errors(config.of_split(split)).to_dict()
        for split in config.splits
    }


def _dataset_config(out: Path, name: str, entry: _Entry) -> DatasetConfig:
    return DatasetConfig(**DatasetConfig.fields_of_entry(name, entry), root=str(out))
