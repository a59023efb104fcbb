"""Dataset card: YAML header for the ``datasets`` library, and a description with tables from the manifest."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from huggingface_hub import DatasetCardData

from cards.steel import depth_text, steel_by_config
from cards.templates import render
from rebar_depth_bench.data.columns import COLUMN_DESCRIPTIONS, column_kind, features
from rebar_depth_bench.data.config_tables import References
from rebar_depth_bench.data.dataset_config import DatasetConfig
from rebar_depth_bench.data.trajectory import CENTRE, NEAREST_STEEL, SURVEY
from rebar_depth_bench.reporting.formatting import DASH
from rebar_depth_bench.scoring.protocol import PROTOCOL
from rebar_depth_bench.view_ids import TEST_SPLIT

if TYPE_CHECKING:
    from datasets import DatasetInfo

PRETTY_NAME = "Industrial rebar metric depth"
_OPTICS_TEXTS = {
    "ideal": "",
    "raw": "factory-calibrated lenses, on the distorted grid as the sensor sees it",
    "rectified": "factory-calibrated lenses, on the grid that OpenCV's stereoRectify makes of the pair; "
    "depth along the rectified axis",
}
_SIZE_CATEGORIES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"))


def dataset_card(version: str, digest: str, configs: Sequence[DatasetConfig]) -> str:
    """Return the text of the ``README.md`` of a dataset folder, for its version and ground-truth digest.

    Its YAML header is sufficient for ``datasets.load_dataset(ROOT, config)``. The file pattern of each config
    contains the digest of its shards, so that the cache of ``datasets`` never serves an older build of a config.
    """
    return render(
        "dataset_card.md.j2",
        yaml=_card_metadata(version, configs).to_yaml(),
        version=version,
        digest=digest,
        protocol=PROTOCOL,
        configs=[row for config in configs for row in _config_rows(config)],
        has_rendered=bool(_rendered(configs)),
        columns=column_rows(),
        example=configs[0].name,
        example_split=configs[0].splits[0],
    )


def _rendered(configs: Iterable[DatasetConfig]) -> list[DatasetConfig]:
    """Return the configs that were not imported; all statements about rendering and licence hold for these."""
    return [config for config in configs if config.imported is None]


def column_rows() -> list[dict[str, str]]:
    """Return the names, type and description of the dataset columns; left and right columns share one row."""
    rows: dict[str, dict[str, str]] = {}
    for name, feature in features().items():
        kind = column_kind(name)
        row = rows.setdefault(
            kind, {"names": "", "type": _type_name(feature), "meaning": COLUMN_DESCRIPTIONS[kind]}
        )
        row["names"] += f"{', ' if row['names'] else ''}`{name}`"
    return list(rows.values())


def _type_name(feature: Any) -> str:
    kind = type(feature).__name__
    if kind == "List":
        inner = _type_name(feature.feature)
        return f"{inner} x {feature.length}"
    return "image" if kind == "Image" else str(feature.dtype)


def _card_metadata(version: str, configs: Sequence[DatasetConfig]) -> DatasetCardData:
    from datasets.info import DatasetInfosDict

    views = sum(len(config.views) for config in configs)
    card = DatasetCardData(
        license="other" if any(config.imported for config in configs) else "cc-by-4.0",
        pretty_name=PRETTY_NAME,
        task_categories=["depth-estimation"],
        tags=["depth", "stereo", "construction", "rebar", *(["synthetic"] if _rendered(configs) else [])],
        size_categories=[next((name for limit, name in _SIZE_CATEGORIES if views < limit), "100K<n<1M")],
    )
    infos = {config.name: _dataset_info(config, version) for config in configs}
    DatasetInfosDict(infos).to_dataset_card_data(card)
    card["configs"] = [
        {
            "config_name": config.name,
            "data_files": [{"split": split, "path": _shard_paths(config, split)} for split in config.splits],
        }
        for config in configs
    ]
    return card


def _dataset_info(config: DatasetConfig, version: str) -> DatasetInfo:
    from datasets import DatasetInfo, SplitDict, SplitInfo

    size = config.manifest_entry["bytes"]
    splits = {
        split: SplitInfo(
            split, num_examples=len(config.of_split(split).views), num_bytes=_split_bytes(config, split)
        )
        for split in config.splits
    }
    return DatasetInfo(
        features=features(),
        splits=SplitDict(splits),
        config_name=config.name,
        version=version,
        dataset_size=size,
        download_size=size,
    )


def _split_bytes(config: DatasetConfig, split: str) -> int:
    """Return the size of the shards of a split."""
    scenes = config.manifest_entry.get("scenes", [config.manifest_entry])
    return sum(scene["bytes"] for scene in scenes if scene.get("split", TEST_SPLIT) == split)


def _shard_paths(config: DatasetConfig, split: str) -> str | list[str]:
    """Return the glob pattern of the shards, ``<config>/test-*-<digest>.parquet``, or the shards of a split.

    Scenes of a config with splits have digests of their own.
    """
    shards = config.of_split(split).shards
    if config.has_splits:
        return list(shards)
    return f"{config.name}/{TEST_SPLIT}-*-{shards[0].rpartition('-')[2]}"


def _config_rows(config: DatasetConfig) -> list[dict[str, Any]]:
    """Return the rows of a config in the tables: one, or one for each split of a config with splits."""
    if config.has_splits:
        return [_split_row(config.of_split(split), split) for split in config.splits]
    return [_imported_row(config) if config.imported is not None else _config_row(config)]


def _split_row(config: DatasetConfig, split: str) -> dict[str, Any]:
    """Return the row of a config that is restricted to a split of generated scenes."""
    names = {scene.name for scene in config.scenes}
    scenes = [scene for scene in config.manifest_entry["scenes"] if scene["name"] in names]
    distances_m = [distance_m for scene in scenes for distance_m in scene["protocol"]["distances_m"]]
    cameras = dict.fromkeys(scene["rig"]["camera"] for scene in scenes)
    references = References.model_validate(config.manifest_entry["references"][split])
    return {
        **_shared_row(config),
        "name": f"{config.name}, {split}",
        "steel_source": f"{len(scenes)} generated cages",
        "distance": f"{min(distances_m):g}-{max(distances_m):g} m, random views",
        "steel_depth": DASH,
        "sheet": config.sheet if split == config.manifest_entry["scenes"][0]["split"] else None,
        **dict.fromkeys(("variants", "panorama")),
        "optics": f"ideal pinholes with baseline and field of view of {', '.join(sorted(cameras))}",
        "constant": _reference(references, "constant"),
        "one_pixel": _reference(references, "one_pixel"),
        "megabytes": f"{sum(scene['bytes'] for scene in scenes) / 1e6:.1f}",
    }


def _config_row(config: DatasetConfig) -> dict[str, Any]:
    """Return the row of a config of one scene that was rendered."""
    entry = config.manifest_entry
    return {
        **_shared_row(config),
        "name": config.name,
        "views": f"{len(config.views)} of {entry['protocol_views']}",
        "steel_source": _steel_source(entry["scene"]["assembly"]),
        "distance": _distance(entry["protocol"]),
        "steel_depth": _steel_depth(config),
        "sheet": config.sheet,
        "variants": config.scene.appearance.variants,
        "panorama": entry["scene"].get("appearance", {}).get("image_light", {}).get("image"),
        "optics": _OPTICS_TEXTS[entry["rig"]["grid"]],
        "constant": _reference(config.reference, "constant"),
        "one_pixel": _reference(config.reference, "one_pixel"),
        "megabytes": f"{entry['bytes'] / 1e6:.1f}",
    }


def _shared_row(config: DatasetConfig) -> dict[str, Any]:
    """Return the columns that all rows of rendered configs compute alike."""
    rig, views = config.rig, config.views
    steel = np.array([view.steel_px for view in views], float)
    scored = np.array([view.scored_px for view in views], float)
    with_steel = steel > 0
    return {
        "views": f"{len(views)}",
        "samples": "no colour" if config.colour is None else _samples(config.colour),
        "has_colour": config.colour is not None,
        "grid": f"{rig.width} x {rig.height}",
        "steel": f"{100 * np.mean(steel) / (rig.width * rig.height):.1f} %",
        "kept": f"{100 * np.mean(scored[with_steel] / steel[with_steel]):.0f} %" if with_steel.any() else "none",
        "out_of_protocol": int(np.count_nonzero(scored == 0)),
        "imported": None,
    }


def _imported_row(config: DatasetConfig) -> dict[str, Any]:
    """Return the row of an imported config; what is not known of it is a dash."""
    rig, scored = config.rig, [view.scored_px for view in config.views]
    return {
        "name": config.name,
        "views": f"{len(config.views)}",
        **dict.fromkeys(("samples", "distance", "steel_depth", "steel", "kept"), DASH),
        **dict.fromkeys(("optics", "variants", "panorama")),
        "has_colour": config.colour is not None,
        "steel_source": "imported",
        "grid": f"{rig.width} x {rig.height}",
        "out_of_protocol": scored.count(0),
        "sheet": config.sheet,
        "imported": config.manifest_entry["imported"],
        "constant": _reference(config.reference, "constant"),
        "one_pixel": _reference(config.reference, "one_pixel"),
        "megabytes": f"{config.manifest_entry['bytes'] / 1e6:.1f}",
    }


def _reference(references: References | None, name: str) -> str:
    """Return AbsRel and RMSE of a reference; a dash if the manifest has none."""
    errors = getattr(references, name, None)
    if errors is None or errors.abs_rel is None or errors.rmse_cm is None:
        return DASH
    return f"{errors.abs_rel:.4f}, {errors.rmse_cm:.2f} cm"


def _samples(colour: Mapping[str, Any]) -> str:
    """Return the samples per pixel, and those around the steel if they differ."""
    samples, steel_samples = colour["samples"], colour["steel_samples"]
    return f"{samples}" if steel_samples == samples else f"{samples}, {steel_samples} around steel"


def _steel_source(assembly: Mapping[str, Any]) -> str:
    return f"`{assembly['path']}`, not a standard one" if "path" in assembly else assembly["kind"]


def _distance(protocol: Mapping[str, Any]) -> str:
    if protocol["kind"] == "ring":
        return f"{protocol['radius_m']:g} m"
    if protocol["kind"] == SURVEY:
        return f"{min(protocol['distances_m']):g}-{max(protocol['distances_m']):g} m, steel aimed at"
    to_steel = ", nearest steel" if protocol.get("distance_to") == NEAREST_STEEL else ""
    return f"{min(protocol['radii_m']):g}-{max(protocol['radii_m']):g} m{to_steel}"


def _steel_depth(config: DatasetConfig) -> str:
    """Return the range of steel depth of a standard config; a dash for other assemblies and trajectories."""
    entry, steel = config.manifest_entry, steel_by_config().get(config.name)
    if "path" in entry["scene"]["assembly"] or steel is None:
        return DASH
    return depth_text(steel) if entry["protocol"].get("distance_to", CENTRE) == steel["distance_to"] else DASH
