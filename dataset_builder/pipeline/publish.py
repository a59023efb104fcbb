"""Publishing of staged configs into the dataset folder, and the lock that allows one build per folder.

Files are written in an order that can be repaired after an interruption at any point: first the shards, whose
names contain the digest of their content; then mesh, contact sheet, bars and crossings; then the other pictures
and the card; the manifest last. Files that the new manifest does not list are removed afterwards. If the card,
bars, crossings or pictures of a folder do not match its manifest, a build was interrupted in between or an earlier
version built it, and the next build repairs them.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from cards import dataset_card
from dataset_builder.config.catalog import CONFIGS
from dataset_builder.config.specs import SceneConfigSpec
from dataset_builder.config.trajectories import view_count
from dataset_builder.pipeline.contact_sheet import write_contact_sheet, write_scenes_strip
from dataset_builder.pipeline.folder import (
    CARD,
    LOCK,
    MESHES,
    PICTURES,
    SHARD_DIGEST_CHARACTERS,
    remove_temporary_files,
    remove_unlisted_files,
)
from dataset_builder.pipeline.plan import ConfigPlan, config_parameters, generator_versions
from dataset_builder.pipeline.retained import entry_problems, published_configs
from dataset_builder.pipeline.shards import Staging, pack_shard, read_staged_record, split_into_shards
from dataset_builder.scene.assemblies import aim_point_m, assembly_bars
from dataset_builder.scene.model import Assembly
from rebar_depth_bench.atomic_io import exclusive_lock, write_bytes, write_error, write_text
from rebar_depth_bench.bar_crossings.table import CROSSINGS_FILE, crossings_entry, write_crossings
from rebar_depth_bench.data.bars import BARS_FILE, Bar, read_bars, write_bars
from rebar_depth_bench.data.dataset_config import DatasetConfig
from rebar_depth_bench.data.digests import file_sha256, parameters_digest, views_digest
from rebar_depth_bench.data.manifest import MANIFEST_FILE, MANIFEST_FORMAT, DatasetFolder, open_folder
from rebar_depth_bench.errors import InputError
from rebar_depth_bench.scoring.ground_truth import reference_errors
from rebar_depth_bench.scoring.protocol import PROTOCOL
from rebar_depth_bench.version import software_version
from rebar_depth_bench.view_ids import TEST_SPLIT, view_id

STRIP = f"{PICTURES}/scenes.webp"
"""Strip with one view of each kind of assembly."""


@contextmanager
def build_lock(folder: Path) -> Iterator[None]:
    """Hold an exclusive lock on the file ``lock`` in ``folder``; the lock of a killed process is released.

    Raises ``InputError`` if another process holds the lock, and ``OutputError`` if the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(folder.parent, error) from None
    with ExitStack() as stack:
        try:
            stack.enter_context(exclusive_lock(folder / LOCK))
        except BlockingIOError:
            raise InputError(f"{folder.parent}: another rebar-build process is using this folder") from None
        yield


def is_published(out: Path, plan: ConfigPlan) -> bool:
    """Return whether the folder already contains the shards and the mesh of the plan, with matching digests."""
    if not (out / MANIFEST_FILE).is_file():
        return False
    folder = open_folder(out)
    config = folder.config_by_name.get(plan.spec.name)
    if config is None or any(entry_problems(config)):
        return False
    scenes = {scene.name: scene for scene in config.scenes}
    scene, key = scenes.get(plan.spec.scene.name), config.key
    if isinstance(plan.spec, SceneConfigSpec):
        key = scene_entries(config).get(plan.spec.scene.name, {}).get("key", "")
    if scene is None or scene.mesh is None or key != plan.key:
        return False
    return _files_match(folder, (*scene.shards, scene.mesh))


def scene_entries(config: DatasetConfig) -> Mapping[str, Mapping[str, Any]]:
    """Return the entries of the scenes of a config of several, by name, as its manifest has them."""
    return {entry["name"]: entry for entry in config.manifest_entry.get("scenes", ())}


def repair_metadata(out: Path, plans: Sequence[ConfigPlan]) -> None:
    """Rewrite bars, crossings, card, pictures and manifest if any of them does not match.

    ``plans`` are those of one config.
    """
    folder = open_folder(out)
    config = folder.config(plans[0].spec.name)
    if not _files_match(folder, (BARS_FILE, CROSSINGS_FILE, CARD, STRIP, config.sheet)):
        write_contact_sheet(config, out / config.sheet)
        write_scene_bars(out, {plan.spec.scene.name: assembly_bars(plan.spec.scene.assembly) for plan in plans})
        write_manifest(out, folder.config_by_name)


def _files_match(folder: DatasetFolder, names: Iterable[str]) -> bool:
    paths = {name: Path(folder.root, name) for name in names}
    return all(path.is_file() and file_sha256(path) == folder.files.get(name) for name, path in paths.items())


def publish_config(out: Path, plan: ConfigPlan) -> None:
    """Publish a completely staged config in the folder and remove the files it replaces."""
    name, scene = plan.spec.name, plan.spec.scene.name
    mesh = f"{MESHES}/{scene}.ply"
    write_bytes(out / mesh, plan.staging.mesh.read_bytes())
    entry: dict[str, Any] = {
        **config_parameters(plan.spec),
        "key": plan.key,
        "aim_point_m": aim_point_m(plan.assembly).tolist(),
        **_placement(plan.assembly),
        "protocol_views": view_count(plan.spec.protocol),
        "generator": generator_versions(),
        "mesh": mesh,
    }
    publish_entry(out, name, entry, plan.staging, plan.indices, {scene: plan.assembly.bars})


def publish_entry(
    out: Path,
    name: str,
    parameters: Mapping[str, Any],
    staging: Staging,
    indices: Sequence[int],
    bars: Mapping[str, tuple[Bar, ...]],
) -> None:
    """Publish a config: the staged rows, an entry with the ``parameters``, and the ``bars`` by scene."""
    records = [read_staged_record(staging.row(index), view_id(name, index)) for index in indices]
    shards = publish_shards(out, name, TEST_SPLIT, staging, indices)
    entry = {
        **parameters,
        "sheet": f"{PICTURES}/{name}.webp",
        "shards": shards,
        "bytes": sum((out / shard).stat().st_size for shard in shards),
        "ground_truth_digest": views_digest(records),
        "views": [record.model_dump() for record in records],
    }
    without_reference = DatasetConfig(**DatasetConfig.fields_of_entry(name, entry), root=str(out))
    entry["reference"] = reference_errors(without_reference).to_dict()
    config = DatasetConfig(**DatasetConfig.fields_of_entry(name, entry), root=str(out))
    write_contact_sheet(config, out / config.sheet)
    write_scene_bars(out, bars)
    write_manifest(out, {**published_configs(out), config.name: config})


def _placement(assembly: Assembly) -> dict[str, Any]:
    """Return where the bars of a user's file were placed, as an entry of the manifest."""
    matrix = assembly.world_from_source
    return {} if matrix is None else {"world_from_source": matrix.tolist()}


def write_scene_bars(out: Path, bars: Mapping[str, tuple[Bar, ...]]) -> None:
    """Write the bars of some scenes into the table of bars, and the crossings of all scenes."""
    path = out / BARS_FILE
    published = read_bars(path) if path.is_file() else {}
    write_bars(path, {**published, **bars})
    write_crossings(out / CROSSINGS_FILE, {**published, **bars})


def remove_leftovers(out: Path) -> None:
    """Remove the files left by an interrupted build: temporary files and files not listed in the manifest."""
    remove_unlisted_files(out, _listed_files(published_configs(out).values()))
    remove_temporary_files(out)


def publish_shards(
    out: Path, config: str, prefix: str, staging: Staging, view_indices: Sequence[int]
) -> list[str]:
    """Pack the shards and give each its name in the folder, which carries the digest of all of them.

    ``prefix`` is the beginning of the names of the files: the split, and the scene if the config has several.
    """
    shard_indices = split_into_shards(view_indices)
    packed_paths = [staging.shard(shard) for shard in range(len(shard_indices))]
    for target, indices in zip(packed_paths, shard_indices, strict=True):
        pack_shard([staging.row(index) for index in indices], target)
    digest = parameters_digest([file_sha256(path) for path in packed_paths])[:SHARD_DIGEST_CHARACTERS]
    names = [
        f"{config}/{prefix}-{shard:05d}-of-{len(shard_indices):05d}-{digest}.parquet"
        for shard in range(len(shard_indices))
    ]
    (out / config).mkdir(exist_ok=True)
    for path, name in zip(packed_paths, names, strict=True):
        path.replace(out / name)
    return names


def write_manifest(out: Path, configs: Mapping[str, DatasetConfig]) -> None:
    """Write contact sheets that are missing, strip, card and manifest; remove files not listed."""
    order = [*CONFIGS, *sorted(set(configs) - set(CONFIGS))]
    ordered = [configs[name] for name in order if name in configs]
    version, digest = software_version(), views_digest(view for config in ordered for view in config.views)
    for config in ordered:
        if not (out / config.sheet).is_file():
            write_contact_sheet(config, out / config.sheet)
    by_scene = {_strip_key(config): config for config in reversed(ordered)}
    write_scenes_strip(list(reversed(by_scene.values())), out / STRIP)
    write_text(out / CARD, dataset_card(version, digest, ordered))
    metadata = {CARD, BARS_FILE, CROSSINGS_FILE}
    manifest = {
        "format": MANIFEST_FORMAT,
        "version": version,
        "protocol": PROTOCOL,
        "ground_truth": {"digest": digest},
        "crossings": crossings_entry(out / CROSSINGS_FILE),
        "configs": {config.name: config.manifest_entry for config in ordered},
        "files": {name: file_sha256(out / name) for name in sorted(metadata | _listed_files(ordered))},
    }
    write_text(out / MANIFEST_FILE, json.dumps(manifest, indent=1, allow_nan=False) + "\n")
    remove_unlisted_files(out, _listed_files(ordered))


def _strip_key(config: DatasetConfig) -> str:
    """Return the key of a panel of the strip: assembly kind, digest of a user's file, or an imported config."""
    if config.imported is not None or config.has_splits:
        return config.name
    assembly = config.manifest_entry["scene"]["assembly"]
    return str(assembly.get("sha256", assembly["kind"]))


def _listed_files(configs: Iterable[DatasetConfig]) -> set[str]:
    return {STRIP, *(name for config in configs for name in config.files)}
