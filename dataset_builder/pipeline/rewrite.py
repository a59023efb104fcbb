"""Conversion of the manifest of an earlier format, without rendering or reading any other file of the folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dataset_builder.pipeline.folder import check_target, remove_build_folder
from dataset_builder.pipeline.plan import BUILD_FOLDER
from dataset_builder.pipeline.publish import build_lock, manifest_text
from rebar_depth_bench.atomic_io import write_text
from rebar_depth_bench.data.manifest import (
    MANIFEST_FILE,
    MANIFEST_FORMAT,
    OLD_FORMAT,
    read_manifest,
    validated_folder,
)
from rebar_depth_bench.view_ids import TEST_SPLIT

_OF_SCENE = (
    *("protocol", "protocol_views", "rig", "aim_point_m", "world_from_source", "key", "generator"),
    *("mesh", "shards", "bytes"),
)
"""Keys beside the scene in an entry of one scene that belong to the scene now, in the order of the manifest."""
_OF_CONFIG = ("name", "imported", "rig", "colour", "sheet", "ground_truth_digest", "views")


def rewrite_manifest(out: Path) -> None:
    """Convert the manifest of a dataset folder to the present format; one that has it already is left as it is.

    Digests of views and files do not change. Raises ``DatasetError`` if the folder has no valid manifest, and
    ``InputError`` if another build is using the folder.
    """
    check_target(out, (), ())
    path = out / MANIFEST_FILE
    values, problems = read_manifest(path)
    if isinstance(values, dict) and values.get("format") == OLD_FORMAT:
        values = converted(values)
        validated_folder(values, problems, str(out), path)
        with build_lock(out / BUILD_FOLDER):
            try:
                write_text(path, manifest_text(values))
            finally:
                remove_build_folder(out / BUILD_FOLDER)
        return
    validated_folder(values, problems, str(out), path)


def converted(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """Return a manifest of the earlier format in the present one; what is not valid in it stays so."""
    configs = manifest.get("configs")
    if isinstance(configs, dict):
        configs = {name: _converted_config(name, entry) for name, entry in configs.items()}
    return {**manifest, "format": MANIFEST_FORMAT, "configs": configs}


def _converted_config(name: str, entry: Any) -> Any:
    """Return the entry of a config: an entry of one scene had its parameters and files beside ``scene``."""
    if not isinstance(entry, dict):
        return entry
    if isinstance(scenes := entry.get("scenes"), list):
        parts = {"has_splits": True, "scenes": [_with_number_of_views(scene) for scene in scenes]}
        references = entry.get("references", {})
    else:
        scene = entry["scene"] if isinstance(entry.get("scene"), dict) else {}
        files = {key: entry[key] for key in _OF_SCENE if key in entry}
        if "imported" in entry:  # Its rig has only the size of the images, and it has no trajectory.
            files = {key: value for key, value in files.items() if key not in ("rig", "protocol")}
        parts = {"has_splits": False, "scenes": [{**scene, "split": TEST_SPLIT, **files}]}
        references = {TEST_SPLIT: entry["reference"]} if "reference" in entry else {}
    kept = {"name": name, **{key: entry[key] for key in _OF_CONFIG if key in entry}}
    if isinstance(rig := kept.get("rig"), dict):
        kept["rig"] = {key: rig[key] for key in ("width", "height") if key in rig}
    return {**kept, **parts, "references": references}


def _with_number_of_views(scene: Any) -> Any:
    """Return a scene with the number of views of its trajectory."""
    protocol = scene.get("protocol") if isinstance(scene, dict) else None
    return {**scene, "protocol_views": protocol.get("views")} if isinstance(protocol, dict) else scene
