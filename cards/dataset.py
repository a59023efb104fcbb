"""Dataset card: YAML header for the ``datasets`` library, and a description with tables from the manifest."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from huggingface_hub import DatasetCardData

from cards.steel import depth_text, steel_by_config
from cards.templates import render
from rebar_depth_bench.bar_crossings.crossings_file import CROSSINGS_FILE
from rebar_depth_bench.base.names import TEST_SPLIT
from rebar_depth_bench.data.bars import BARS_FILE
from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.data.schema import (
    CENTRE,
    COLUMN_DESCRIPTIONS,
    NEAREST_STEEL,
    AnyTrajectory,
    Assembly,
    Colour,
    GivenPoses,
    MatRecord,
    References,
    Scene,
    SceneRig,
    Survey,
    Trajectory,
    column_kind,
    features,
)
from rebar_depth_bench.scoring.columns import DASH
from rebar_depth_bench.scoring.protocol import PROTOCOL

if TYPE_CHECKING:
    from datasets import DatasetInfo

PRETTY_NAME = "Reinforcement views with metric depth (rebar-depth-bench)"
"""Title of the card; the evaluation set of the paper, which is in another format, has another one."""
_OPTICS_TEXTS = {
    "ideal": "ideal pinholes",
    "raw": "calibrated lenses, on the distorted grid as the sensor sees it",
    "rectified": "calibrated lenses, on the rectified grid; depth along the rectified axis",
}
_CAMERA_TEXT = " with baseline and field of view, not noise or depth engine, of "
_SIZE_CATEGORIES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"))


def dataset_card(version: str, digest: str, configs: Sequence[DatasetConfig], tables: Mapping[str, str]) -> str:
    """Return the text of the ``README.md`` of a dataset folder, for its version and ground-truth digest.

    ``tables`` are the hex SHA-256 of its tables of bars and crossings that have rows, by file name. The YAML
    header is sufficient for ``datasets.load_dataset(ROOT, config)``. The file pattern of each config contains the
    digest of its shards, and a table has a version, so that the cache of ``datasets`` serves no older build.
    """
    metadata = _card_metadata(version, configs, tables)
    return render(
        "dataset_card.md.j2",
        yaml=metadata.to_yaml(),
        title=PRETTY_NAME,
        version=version,
        digest=digest,
        protocol=PROTOCOL,
        configs=[row for config in configs for row in _config_rows(config)],
        has_rendered=bool(_rendered(configs)),
        mats=[row for config in configs for row in _mat_rows(config)],
        columns=column_rows(),
        tables=[entry["config_name"] for entry in metadata["configs"][len(configs) :]],
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


def _card_metadata(version: str, configs: Sequence[DatasetConfig], tables: Mapping[str, str]) -> DatasetCardData:
    from datasets.info import DatasetInfosDict

    views = sum(len(config.views) for config in configs)
    has_imported = any(config.imported for config in configs)  # Of other licences, sources and annotations.
    card = DatasetCardData(
        license="other" if has_imported else "cc-by-4.0",
        annotations_creators=None if has_imported else ["machine-generated"],
        source_datasets=None if has_imported else ["original"],
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
    card["configs"] += [
        {
            "config_name": name,
            "data_files": [{"split": "train", "path": file}],
            "version": _table_version(tables[file]),
        }
        for name, file in (("bars", BARS_FILE), ("crossings", CROSSINGS_FILE))
        if file in tables and name not in infos
    ]
    return card


def _table_version(sha256: str) -> str:
    """Return a version ``x.y.z`` from the digest of a table.

    The path of a table is always the same, so that ``datasets`` would take an older one from its cache.
    """
    return ".".join(f"{int(sha256[start : start + 8], 16)}" for start in (0, 8, 16))


def _dataset_info(config: DatasetConfig, version: str) -> DatasetInfo:
    from datasets import DatasetInfo, SplitDict, SplitInfo

    parts = {split: config.of_split(split) for split in config.splits}
    splits = {
        split: SplitInfo(split, num_examples=len(part.views), num_bytes=part.bytes)
        for split, part in parts.items()
    }
    return DatasetInfo(
        features=features(),
        splits=SplitDict(splits),
        config_name=config.name,
        version=version,
        dataset_size=config.bytes,
        download_size=config.bytes,
    )


def _shard_paths(config: DatasetConfig, split: str) -> str | list[str]:
    """Return the glob pattern of the shards, ``<config>/test-*-<digest>.parquet``, or the shards of a split.

    Scenes of a config with splits have digests of their own.
    """
    shards = config.of_split(split).shards
    if config.has_splits:
        return list(shards)
    return f"{config.name}/{TEST_SPLIT}-*-{shards[0].rpartition('-')[2]}"


def _config_rows(config: DatasetConfig) -> list[dict[str, Any]]:
    """Return the rows of a config in the tables: one for each split."""
    rows = []
    for split in config.splits:
        part = config.of_split(split)
        row = _shared_row(part, split)
        if config.imported is None:
            row |= _rendered_row(part) | (_split_row(part) if config.has_splits else _config_row(part))
        rows.append(row)
    return rows


def _shared_row(config: DatasetConfig, split: str) -> dict[str, Any]:
    """Return the columns of a config restricted to a split; those that only rendered configs have are dashes."""
    rig, references = config.rig, config.references.get(split)
    return {
        **dict.fromkeys(("samples", "distance", "steel", "kept", "steel_depth"), DASH),
        **dict.fromkeys(("optics", "variants", "panorama")),
        "name": config.name,
        "steel_source": "imported",
        "views": f"{len(config.views)}",
        "grid": f"{rig.width} x {rig.height}",
        "has_colour": config.colour is not None,
        "out_of_protocol": sum(view.scored_px == 0 for view in config.views),
        "sheet": config.sheet,
        "constant": _reference(references, "constant"),
        "one_pixel": _reference(references, "one_pixel"),
        "megabytes": f"{config.bytes / 1e6:.1f}",
        "imported": config.imported,
    }


def _split_row(config: DatasetConfig) -> dict[str, Any]:
    """Return the columns of a split of generated scenes; the first split shows the contact sheet."""
    trajectories = [scene.trajectory for scene in config.scenes if scene.trajectory is not None]
    distances_m = [distance_m for trajectory in trajectories for distance_m in trajectory.distances_m]
    cameras = dict.fromkeys(scene.rig.camera for scene in config.scenes if scene.rig is not None)
    split = config.scenes[0].split
    return {
        "name": f"{config.name}, {split}",
        "steel_source": f"{len(config.scenes)} generated cages",
        "distance": f"{min(distances_m):g}-{max(distances_m):g} m, random views",
        "sheet": config.sheet if split == config.manifest_entry["scenes"][0]["split"] else None,
        "optics": _OPTICS_TEXTS["ideal"] + _CAMERA_TEXT + ", ".join(sorted(cameras)),
    }


def _mat_rows(config: DatasetConfig) -> list[dict[str, Any]]:
    """Return the deviations of the cover of generated cages: one row for each family, millimetres."""
    mats: dict[str, list[MatRecord]] = {}
    for scene in config.scenes:
        if scene.family is not None and scene.mats:
            mats.setdefault(scene.family, []).extend(scene.mats)
    rows = []
    for family, of_family in sorted(mats.items()):
        mm = 1000 * np.array([mat.deviation_m for mat in of_family])
        within = f"{np.mean([not mat.beyond for mat in of_family]):.0%}"
        median_mm = np.median(np.abs(mm).max(axis=1))
        deviations = " | ".join(f"{value:.1f}" for value in (mm.min(), median_mm, mm.max()))
        rows.append({"family": family, "mats": len(of_family), "within": within, "deviations": deviations})
    return rows


def _config_row(config: DatasetConfig) -> dict[str, Any]:
    """Return the columns of a config of one scene that was rendered."""
    scene, light = config.scene, config.scene.appearance.image_light
    return {
        "views": f"{len(config.views)} of {scene.protocol_views}",
        "steel_source": _steel_source(scene.assembly) if scene.assembly is not None else DASH,
        "distance": _distance(scene.trajectory) if scene.trajectory is not None else DASH,
        "steel_depth": _steel_depth(config.name, scene),
        "variants": scene.appearance.variants,
        "panorama": light.image if light is not None else None,
        "optics": _optics(scene.rig) if scene.rig is not None else "",
    }


def _optics(rig: SceneRig) -> str:
    """Return the optics of a rig in words; an empty string for the default rig."""
    if rig.calibration is not None:
        return f"{_OPTICS_TEXTS[rig.grid]}; baseline {rig.baseline_m:.4g} m"
    return _OPTICS_TEXTS[rig.grid] + _CAMERA_TEXT + rig.camera if rig.camera else ""


def _rendered_row(config: DatasetConfig) -> dict[str, Any]:
    """Return the columns that all rendered configs have."""
    rig, views = config.rig, config.views
    steel = np.array([view.steel_px for view in views], float)
    scored = np.array([view.scored_px for view in views], float)
    with_steel = steel > 0
    return {
        "samples": "no colour" if config.colour is None else _samples(config.colour),
        "steel": f"{100 * np.mean(steel) / (rig.width * rig.height):.1f} %",
        "kept": f"{100 * np.mean(scored[with_steel] / steel[with_steel]):.0f} %" if with_steel.any() else "none",
    }


def _reference(references: References | None, name: str) -> str:
    """Return AbsRel and RMSE of a reference; a dash if the manifest has none."""
    errors = getattr(references, name, None)
    if errors is None or errors.abs_rel is None or errors.rmse_cm is None:
        return DASH
    return f"{errors.abs_rel:.4f}, {errors.rmse_cm:.2f} cm"


def _samples(colour: Colour) -> str:
    """Return the samples per pixel, and those around the steel if they differ."""
    samples, steel_samples = colour.samples, colour.steel_samples
    return f"{samples}" if steel_samples == samples else f"{samples}, {steel_samples} around steel"


def _steel_source(assembly: Assembly) -> str:
    return f"`{assembly.path}`, not a standard one" if assembly.path is not None else assembly.kind


def _distance(trajectory: AnyTrajectory) -> str:
    distances_m = trajectory.distances_m
    if trajectory.kind == "ring":
        return f"{distances_m[0]:g} m"
    to_steel = ""
    if isinstance(trajectory, Survey):
        to_steel = ", steel aimed at"
    elif isinstance(trajectory, GivenPoses):
        to_steel = ", target aimed at"
    elif isinstance(trajectory, Trajectory) and trajectory.distance_to == NEAREST_STEEL:
        to_steel = ", nearest steel"
    return f"{min(distances_m):.4g}-{max(distances_m):.4g} m{to_steel}"


def _steel_depth(config: str, scene: Scene) -> str:
    """Return the range of steel depth of a standard config; a dash for other assemblies and trajectories."""
    steel = steel_by_config().get(config)
    if scene.assembly is None or scene.assembly.path is not None or steel is None:
        return DASH
    distance_to = scene.trajectory.distance_to if isinstance(scene.trajectory, Trajectory) else CENTRE
    return depth_text(steel) if distance_to == steel["distance_to"] else DASH
