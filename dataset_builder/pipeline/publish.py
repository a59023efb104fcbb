"""Publishing of staged configs into the dataset folder.

Files are written in an order that can be repaired after an interruption at any point: first the shards, whose
names contain the digest of their content; then meshes and contact sheets; then the strip, bars, crossings and the
card; the manifest last. Files that the new manifest does not list are removed afterwards. Until the manifest is
written, the shards of the old one stay, and a copy of its bars is in the build folder. If the card, bars,
crossings or pictures of a folder do not match its manifest, a build was interrupted in between, and the next build
repairs them.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from cards.dataset import dataset_card
from dataset_builder.cameras.trajectories import view_count
from dataset_builder.catalog.named_configs import CONFIGS
from dataset_builder.pipeline.contact_sheet import write_contact_sheet, write_scenes_strip
from dataset_builder.pipeline.folder import (
    CARD,
    MESHES,
    PICTURES,
    SHARD_DIGEST_CHARACTERS,
    file_matches,
    remove_temporary_files,
    remove_unlisted_files,
    stored_bars_path,
)
from dataset_builder.pipeline.plan import BUILD_FOLDER, ConfigPlan, config_parameters, generator_versions
from dataset_builder.pipeline.shards import Staging, pack_shard, split_into_shards
from dataset_builder.specs.config_specs import SceneConfigSpec
from rebar_depth_bench import software_version
from rebar_depth_bench.bar_crossings.crossings_file import (
    CROSSINGS_FILE,
    crossings_entry,
    read_crossings,
    write_crossings,
)
from rebar_depth_bench.bar_crossings.definition import Crossings, crossing_parameters
from rebar_depth_bench.base.names import SPLITS, TEST_SPLIT
from rebar_depth_bench.base.reading import remove_file
from rebar_depth_bench.base.writing import write_bytes, write_text
from rebar_depth_bench.data.bars import BARS_FILE, Bar, read_bars, write_bars
from rebar_depth_bench.data.files import MANIFEST_FILE, file_sha256, parameters_digest, planes_digest, views_digest
from rebar_depth_bench.data.manifest import MANIFEST_FORMAT, DatasetConfig, DatasetFolder, validated_folder
from rebar_depth_bench.data.schema import ViewRecord
from rebar_depth_bench.scoring.protocol import PROTOCOL
from rebar_depth_bench.scoring.truth import reference_errors

STRIP = f"{PICTURES}/scenes.webp"
"""Strip with one view of each kind of assembly."""


@dataclass(frozen=True)
class StagedScene:
    """Completely staged scene: its entry in the manifest without files, its view indices by id, and its bars.

    ``prefix`` is the beginning of the names of its shards: the split, and the scene if the config has several.
    """

    entry: Mapping[str, Any]
    prefix: str
    staging: Staging
    views: Mapping[str, int]
    bars: tuple[Bar, ...]


def publish_plans(
    out: Path, folder: DatasetFolder | None, plans: Sequence[ConfigPlan], kept: Sequence[DatasetConfig]
) -> DatasetFolder:
    """Publish the completely staged scenes of one config beside the published scenes that are ``kept``.

    Arguments and result are those of ``publish``.
    """
    spec = plans[0].spec
    head = {
        "has_splits": isinstance(spec, SceneConfigSpec),
        "rig": {"width": spec.rig.width, "height": spec.rig.height},
        "colour": config_parameters(spec)["colour"],
    }
    return publish(out, folder, spec.name, head, [_staged_scene(plan) for plan in plans], kept)


def _staged_scene(plan: ConfigPlan) -> StagedScene:
    spec, parameters = plan.spec, config_parameters(plan.spec)
    entry = {
        **parameters["scene"],
        "split": parameters.get("split", TEST_SPLIT),
        "protocol": parameters["protocol"],
        "protocol_views": view_count(spec.protocol),
        "rig": parameters["rig"],
        **plan.derived(),
        "key": plan.key,
        "generator": dict(generator_versions()),
        "mesh": f"{MESHES}/{spec.scene.name}.ply",
    }
    prefix = spec.scene_prefix.rstrip("-") or TEST_SPLIT
    return StagedScene(entry, prefix, plan.staging, plan.view_ids, plan.bars)


def publish(
    out: Path,
    folder: DatasetFolder | None,
    name: str,
    head: Mapping[str, Any],
    staged: Sequence[StagedScene],
    kept: Sequence[DatasetConfig] = (),
) -> DatasetFolder:
    """Publish a config of staged and ``kept`` scenes in ``folder``, and remove the files that it replaces.

    ``head`` has the keys of the config's entry other than its scenes, views and digests. Returns the dataset that
    the folder then holds.
    """
    digests: dict[str, str] = {}
    scenes = {config.scene.name: (config.scene.entry, config.views) for config in kept}
    for scene in staged:
        shards, records = _publish_shards(out, name, scene)
        size = sum((out / shard).stat().st_size for shard in shards)
        scenes[scene.entry["name"]] = {**scene.entry, "shards": list(shards), "bytes": size}, tuple(records)
        digests |= shards
    ordered = sorted(scenes.values(), key=lambda scene: _order(scene[0]))
    views = [view for _, of_scene in ordered for view in of_scene]
    entry = {
        "name": name,
        **head,
        "scenes": [scene for scene, _ in ordered],
        "sheet": f"{PICTURES}/{name}.webp",
        "ground_truth_digest": views_digest(views),
        "views": [view.model_dump() for view in views],
    }
    if any("planes" in scene for scene, _ in ordered):
        entry["planes_digest"] = planes_digest(scene for scene, _ in ordered)
    published = None if folder is None else folder.config_by_name.get(name)
    entry["references"] = _references(_config(out, name, entry), published)
    config = _config(out, name, entry)
    for scene in staged:
        if mesh := scene.entry["mesh"]:
            content = scene.staging.mesh.read_bytes()
            write_bytes(out / mesh, content)
            digests[mesh] = hashlib.sha256(content).hexdigest()
    write_contact_sheet(config, out / config.sheet)
    digests[config.sheet] = file_sha256(out / config.sheet)
    configs = {**(folder.config_by_name if folder is not None else {}), name: config}
    return write_folder(out, folder, configs, digests, {scene.entry["name"]: scene.bars for scene in staged})


def _order(scene: Mapping[str, Any]) -> tuple[int, int]:
    """Return the place of a scene: by split, then by the number of its cage."""
    return SPLITS.index(scene["split"]), scene.get("assembly", {}).get("number", 0)


def _config(out: Path, name: str, entry: Mapping[str, Any]) -> DatasetConfig:
    return DatasetConfig(**DatasetConfig.fields_of_entry(name, json.loads(json.dumps(entry))), root=str(out))


def _references(config: DatasetConfig, published: DatasetConfig | None) -> dict[str, Any]:
    """Return the reference errors of each split; those of splits whose views have not changed are taken over."""
    known = {}
    if published is not None and published.imported is None:
        known = {
            split: published.of_split(split).views for split in published.references if split in published.splits
        }
    return {
        split: published.references[split].model_dump()
        if published is not None and known.get(split) == config.of_split(split).views
        else reference_errors(config.of_split(split))
        for split in config.splits
    }


def repair_metadata(out: Path, folder: DatasetFolder, plans: Sequence[ConfigPlan]) -> DatasetFolder:
    """Rewrite bars, crossings, card, pictures and manifest if any of them does not match.

    ``plans`` belong to one config. Returns the dataset that the folder then holds.
    """
    config = folder.config(plans[0].spec.name)
    names = (BARS_FILE, CROSSINGS_FILE, CARD, STRIP, config.sheet)
    if all(file_matches(folder, name) for name in names):
        return folder
    write_contact_sheet(config, out / config.sheet)
    digests = {config.sheet: file_sha256(out / config.sheet)}
    bars = {plan.spec.scene.name: plan.bars for plan in plans}
    return write_folder(out, folder, folder.config_by_name, digests, bars)


def remove_leftovers(out: Path, folder: DatasetFolder | None) -> None:
    """Remove the files left by an interrupted build: temporary files and files not listed in the manifest."""
    remove_unlisted_files(out, _listed_files(folder.config_by_name.values() if folder is not None else ()))
    remove_temporary_files(out)


def _publish_shards(out: Path, config: str, scene: StagedScene) -> tuple[dict[str, str], list[ViewRecord]]:
    """Pack the shards of a scene and give each its name in the folder, which carries the digest of all of them.

    Return their SHA-256 digests by name, and the records of the views.
    """
    runs = split_into_shards(list(scene.views.items()))
    packed_paths = [scene.staging.shard(shard) for shard in range(len(runs))]
    records: list[ViewRecord] = []
    for target, run in zip(packed_paths, runs, strict=True):
        records += pack_shard({view_id: scene.staging.row(index) for view_id, index in run}, target)
    digests = [file_sha256(path) for path in packed_paths]
    digest = parameters_digest(digests)[:SHARD_DIGEST_CHARACTERS]
    names = [
        f"{config}/{scene.prefix}-{shard:05d}-of-{len(runs):05d}-{digest}.parquet" for shard in range(len(runs))
    ]
    (out / config).mkdir(exist_ok=True)
    for path, name in zip(packed_paths, names, strict=True):
        path.replace(out / name)
    return dict(zip(names, digests, strict=True)), records


def write_folder(
    out: Path,
    folder: DatasetFolder | None,
    configs: Mapping[str, DatasetConfig],
    digests: Mapping[str, str],
    bars: Mapping[str, tuple[Bar, ...]],
) -> DatasetFolder:
    """Write bars, crossings, strip, card and manifest; remove files not listed.

    ``digests`` are those of the shards, meshes and contact sheets that have been written, ``bars`` those of their
    scenes. Digests, bars and crossings of all others are those of ``folder``, the dataset so far: files are not
    hashed again, so that damage still shows. Returns the dataset that the folder then holds.

    Raises ``InputError`` as ``stored_bars_path`` if the bars of another scene are needed.
    """
    order = [*CONFIGS, *sorted(set(configs) - set(CONFIGS))]
    ordered = [configs[name] for name in order if name in configs]
    version, digest = software_version(), views_digest(view for config in ordered for view in config.views)
    known = {**(folder.files if folder is not None else {}), **digests}
    written = [STRIP, BARS_FILE, CROSSINGS_FILE]
    for config in ordered:
        if not (out / config.sheet).is_file():
            write_contact_sheet(config, out / config.sheet)
            written.append(config.sheet)
    by_scene = {_strip_key(config): config for config in reversed(ordered)}
    write_scenes_strip(list(reversed(by_scene.values())), out / STRIP)
    _write_scene_bars(out, folder, ordered, bars)
    known |= {name: file_sha256(out / name) for name in written}
    # ``datasets`` raises an error for a table without rows, as in a folder of imported views without bars.
    tables = {name: known[name] for name in (BARS_FILE, CROSSINGS_FILE) if pq.read_metadata(out / name).num_rows}
    write_text(out / CARD, dataset_card(version, digest, ordered, tables))
    known[CARD] = file_sha256(out / CARD)
    manifest = {
        "format": MANIFEST_FORMAT,
        "version": version,
        "protocol": PROTOCOL,
        "ground_truth": {"digest": digest},
        "crossings": crossings_entry(out / CROSSINGS_FILE),
        "configs": {config.name: config.manifest_entry for config in ordered},
        "files": {name: known[name] for name in sorted({*written, CARD, *_listed_files(ordered)})},
    }
    published = validated_folder(manifest, [], str(out), out / MANIFEST_FILE)
    write_text(out / MANIFEST_FILE, json.dumps(manifest, indent=1, allow_nan=False) + "\n")
    remove_file(out / BUILD_FOLDER / BARS_FILE)
    remove_unlisted_files(out, _listed_files(ordered))
    return published


def _write_scene_bars(
    out: Path,
    folder: DatasetFolder | None,
    configs: Iterable[DatasetConfig],
    bars: Mapping[str, tuple[Bar, ...]],
) -> None:
    """Write the bars and crossings of all scenes; those of scenes without new ``bars`` are taken over."""
    others = {scene.name for config in configs for scene in config.scenes} - bars.keys()
    known: dict[str, Crossings] = {}
    if others and folder is not None:
        content = stored_bars_path(out, folder).read_bytes()
        write_bytes(out / BUILD_FOLDER / BARS_FILE, content)  # The old ones, until the manifest is written.
        stored = read_bars(out / BUILD_FOLDER / BARS_FILE)
        bars = {**{scene: stored.get(scene, ()) for scene in others}, **bars}
        same_rules = crossing_parameters().items() <= folder.crossings.items()
        if same_rules and file_matches(folder, CROSSINGS_FILE):
            crossings = read_crossings(out / CROSSINGS_FILE)
            known = {scene: crossings[scene] for scene in others & crossings.keys()}
    write_bars(out / BARS_FILE, bars)
    write_crossings(out / CROSSINGS_FILE, bars, known)


def _strip_key(config: DatasetConfig) -> str:
    """Return the key of a panel of the strip: assembly kind, digest of a user's file, or an imported config."""
    if config.has_splits:
        return config.name
    assembly = config.scene.assembly
    return config.name if assembly is None else assembly.sha256 or assembly.kind


def _listed_files(configs: Iterable[DatasetConfig]) -> set[str]:
    return {STRIP, *(name for config in configs for name in config.files)}
