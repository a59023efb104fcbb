"""From staged pieces to the dataset folder, in an order that a kill at any moment leaves mendable.

Shards first, under names that carry their content's digest; then meshes and bars; then pictures and card; the
manifest last. Files that the new manifest no longer names go afterwards. A folder whose card, bars or pictures are
not those of its manifest was left by a kill in between: the next build mends it.

One build at a time in a dataset folder.
"""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from rebar_depth_bench.errors import InputError
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any
from cards import dataset_card
from dataset_builder.scene.assemblies import aim_point_m, make_assembly
from dataset_builder.build.bars_table import BARS, read_bars, write_bars
from dataset_builder.config.catalog import CONFIGS
from dataset_builder.build.contact_sheet import write_contact_sheet, write_scenes_strip
from dataset_builder.build.plan import BUILD_FOLDER, ConfigPlan, generator_stamp
from dataset_builder.config.trajectories import offsets_m
from dataset_builder.build.shards import pack_shard, runs_of_views, staged_record
from rebar_depth_bench.data.digests import file_sha256, parameters_digest, views_digest
from rebar_depth_bench.atomic_io import write_bytes, write_text
from rebar_depth_bench.data.manifest import FORMAT, MANIFEST, read_manifest
from rebar_depth_bench.scoring.protocol import PROTOCOL
from rebar_depth_bench.version import software_version

LOCK = "lock"


@contextmanager
def build_lock(folder: Path) -> Iterator[None]:
    """Hold ``folder/lock``; raise ``InputError`` if another process does. A killed holder lets go of it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder.parent}: cannot be made or written to: {error.strerror}") from None
    with (folder / LOCK).open("w") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(f"{folder.parent}: another rebar-build is at work there") from None
        yield


MESHES = "meshes"
CARD = "README.md"
PICTURES = "pictures"
STRIP = f"{PICTURES}/scenes.webp"
"""One view of each kind of assembly, side by side."""
_SHARDS = "*/test-*-of-*.parquet"
_TEMPORARY = ".*.tmp"
_DIGEST_CHARACTERS = 12


def is_published(out: Path, plan: ConfigPlan) -> bool:
    """Return whether the folder already holds the shards and the mesh that the plan would build, byte for byte."""
    manifest = _manifest(out)
    entry = manifest["configs"].get(plan.spec.name)
    if entry is None or entry["key"] != plan.key:
        return False
    return all(_is_as_named(out, name, manifest) for name in (*entry["shards"], entry["mesh"]))


def mend_descriptions(out: Path, plan: ConfigPlan) -> None:
    """Write what describes a published config again if any of it is not the manifest's."""
    manifest = _manifest(out)
    descriptions = (BARS, CARD, STRIP, manifest["configs"][plan.spec.name]["sheet"])
    if not all(_is_as_named(out, name, manifest) for name in descriptions):
        write_contact_sheet(out, manifest["configs"][plan.spec.name]["shards"], out / _sheet(plan))
        _write_bars(out, plan)
        _write_manifest(out, manifest["configs"])


def _is_as_named(out: Path, name: str, manifest: Mapping[str, Any]) -> bool:
    return (out / name).is_file() and file_sha256(out / name) == manifest["files"].get(name)


def check_folder(out: Path) -> None:
    """Raise ``InputError`` unless ``out`` is new, empty or a dataset folder: nothing foreign is ever touched."""
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file, expected a folder")
    if (out / MANIFEST).is_file():
        read_manifest(out / MANIFEST)
    elif out.is_dir() and any(out.iterdir()) and not (out / BUILD_FOLDER / LOCK).is_file():
        raise InputError(f"{out}: is not empty and holds no {MANIFEST}, expected a new or a dataset folder")


def check_kept_files(out: Path, plans: Sequence[ConfigPlan]) -> None:
    """Raise ``InputError`` where a config that stays has lost a shard or its mesh."""
    planned = {plan.spec.name for plan in plans}
    for name, entry in _manifest(out)["configs"].items():
        lost = [file for file in (*entry["shards"], entry["mesh"]) if not (out / file).is_file()]
        if lost and name not in planned:
            raise InputError(f"{out}: {lost[0]} of config {name} is missing; build it again too: --config {name}")


def check_scenes(out: Path, plans: Sequence[ConfigPlan]) -> None:
    """Raise ``InputError`` where a config that stays would stand on another version of a scene being built."""
    planned = {plan.spec.name for plan in plans}
    for name, entry in _manifest(out)["configs"].items():
        for plan in plans:
            scene = plan.parameters["scene"]
            same_name = entry["scene"]["name"] == scene["name"]
            if name not in planned and same_name and entry["scene"] != json.loads(json.dumps(scene)):
                raise InputError(
                    f"{out}: config {name} was built on scene {scene['name']!r} with other parameters; "
                    f"build it again too (--config {name} {plan.spec.name}) or choose another folder"
                )


def publish_config(out: Path, plan: ConfigPlan) -> None:
    """Put a fully staged config into the folder and remove what it replaces."""
    shards = _publish_shards(out, plan)
    mesh = f"{MESHES}/{plan.spec.scene.name}.ply"
    write_bytes(out / mesh, plan.staging.mesh.read_bytes())
    write_contact_sheet(out, shards, out / _sheet(plan))
    _write_bars(out, plan)
    records = [staged_record(plan.staging.row(index)) for index in plan.indices]
    entry = {
        **plan.parameters,
        "key": plan.key,
        "aim_point_m": aim_point_m(make_assembly(plan.spec.scene.assembly)).tolist(),
        "protocol_views": len(offsets_m(plan.spec.protocol)),
        "generator": generator_stamp(),
        "mesh": mesh,
        "sheet": _sheet(plan),
        "shards": shards,
        "bytes": sum((out / name).stat().st_size for name in shards),
        "ground_truth_digest": views_digest([asdict(record) for record in records]),
        "views": [asdict(record) for record in records],
    }
    _write_manifest(out, {**_manifest(out)["configs"], plan.spec.name: entry})


def _write_bars(out: Path, plan: ConfigPlan) -> None:
    scene = plan.spec.scene
    write_bars(out / BARS, {**read_bars(out / BARS), scene.name: make_assembly(scene.assembly).bars})


def _sheet(plan: ConfigPlan) -> str:
    return f"{PICTURES}/{plan.spec.name}.webp"


def sweep(out: Path) -> None:
    """Remove what a killed build left behind: temporary files, and what no manifest names."""
    _remove_unnamed(out, _manifest(out))
    configs = {path.parent for path in out.glob(_SHARDS)}
    for folder in (out, out / MESHES, out / PICTURES, *configs, *(out / name for name in CONFIGS)):
        for temporary in folder.glob(_TEMPORARY):
            temporary.unlink()


def _publish_shards(out: Path, plan: ConfigPlan) -> list[str]:
    """Pack the shards and give each its name in the folder, which carries the digest of all of them."""
    runs = runs_of_views(plan.indices)
    packed = [plan.staging.shard(shard) for shard in range(len(runs))]
    for target, run in zip(packed, runs, strict=True):
        pack_shard([plan.staging.row(index) for index in run], target)
    digest = parameters_digest([file_sha256(path) for path in packed])[:_DIGEST_CHARACTERS]
    names = [
        f"{plan.spec.name}/test-{shard:05d}-of-{len(runs):05d}-{digest}.parquet" for shard in range(len(runs))
    ]
    (out / plan.spec.name).mkdir(exist_ok=True)
    for path, name in zip(packed, names, strict=True):
        path.replace(out / name)
    return names


def _write_manifest(out: Path, configs: Mapping[str, Any]) -> None:
    order = [*CONFIGS, *sorted(set(configs) - set(CONFIGS))]
    ordered = {name: configs[name] for name in order if name in configs}
    views = [view for entry in ordered.values() for view in entry["views"]]
    manifest: dict[str, Any] = {
        "format": FORMAT,
        "version": software_version(),
        "protocol": PROTOCOL,
        "ground_truth": {"digest": views_digest(views)},
        "configs": ordered,
    }
    for entry in ordered.values():
        if not (out / entry["sheet"]).is_file():
            write_contact_sheet(out, entry["shards"], out / entry["sheet"])
    by_scene = {_strip_key(entry): entry for entry in reversed(ordered.values())}
    write_scenes_strip(out, list(reversed(by_scene.values())), out / STRIP)
    write_text(out / CARD, dataset_card(manifest))
    named = [CARD, BARS, STRIP, *_config_files(ordered.values())]
    manifest["files"] = {name: file_sha256(out / name) for name in sorted(set(named))}
    write_text(out / MANIFEST, json.dumps(manifest, indent=1, allow_nan=False) + "\n")
    _remove_unnamed(out, manifest)


def _strip_key(entry: Mapping[str, Any]) -> str:
    """Return what is shown once: each kind of the standard assemblies, and each assembly of a user's."""
    assembly = entry["scene"]["assembly"]
    return str(assembly.get("sha256", assembly["kind"]))


def _config_files(entries: Iterable[Mapping[str, Any]]) -> list[str]:
    return [name for entry in entries for name in (*entry["shards"], entry["mesh"], entry["sheet"])]


def _remove_unnamed(out: Path, manifest: Mapping[str, Any]) -> None:
    named = set(_config_files(manifest["configs"].values()))
    named.add(STRIP)
    for path in [*out.glob(_SHARDS), *(out / MESHES).glob("*.ply"), *(out / PICTURES).glob("*.webp")]:
        if path.relative_to(out).as_posix() not in named:
            path.unlink()


def _manifest(out: Path) -> dict[str, Any]:
    """Return the folder's manifest, or an empty one for a folder that has none yet."""
    if not (out / MANIFEST).is_file():
        return {"configs": {}}
    return read_manifest(out / MANIFEST)
