"""Synthetic dataset folder and submissions, computed without rendering for code that does not depend on images."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from dataset_builder.pipeline.shards import View, encode_view
from rebar_depth_bench import SubmissionWriter
from rebar_depth_bench.base.names import config_of
from rebar_depth_bench.data.bars import BARS_FILE, Bar, write_bars
from rebar_depth_bench.data.files import MANIFEST_FILE, file_sha256, views_digest
from rebar_depth_bench.data.manifest import MANIFEST_FORMAT
from rebar_depth_bench.data.rows import RenderedEye
from rebar_depth_bench.data.schema import ViewRecord
from rebar_depth_bench.geometry.cameras import Camera
from rebar_depth_bench.scoring.protocol import PROTOCOL

HEIGHT, WIDTH = 90, 160
BASELINE_M = 0.12
_BAR_PERIOD_PX, _BAR_WIDTH_PX = 16, 6


def write_dataset(root: Path, configs: Sequence[str], views: int) -> None:
    """Write a dataset folder for ``load`` and ``score``; each config has ``views`` views of vertical bars."""
    records = {config: _write_config(root / config, config, views) for config in configs}
    config_yaml = "".join(
        f"- config_name: {name}\n  data_files:\n  - split: test\n    path: {name}/test.parquet\n"
        for name in configs
    )
    (root / "README.md").write_text(f"---\nconfigs:\n{config_yaml}---\n")
    entries = {
        config: {
            **config_entry(config_records),
            "scenes": [scene_entry(config, views, f"{config}/test.parquet")],
        }
        for config, config_records in records.items()
    }
    _write_manifest(root, entries, [record for config in configs for record in records[config]], {})


def _write_manifest(
    root: Path, entries: Mapping[str, object], records: Sequence[ViewRecord], files: Mapping[str, str]
) -> None:
    manifest = {
        "format": MANIFEST_FORMAT,
        "version": "0.0.0",
        "protocol": PROTOCOL,
        "ground_truth": {"digest": views_digest(records)},
        "configs": entries,
        "files": files,
    }
    (root / MANIFEST_FILE).write_text(json.dumps(manifest))


def write_split_dataset(
    root: Path,
    scenes: Mapping[str, str],
    views: int,
    *,
    families: Mapping[str, str] | None = None,
    numbers: Mapping[str, int] | None = None,
    diameters_m: Mapping[str, float] | None = None,
) -> None:
    """Write a dataset folder with the config ``cages``; ``scenes`` are its scenes with their splits.

    Each scene has ``views`` views, a shard, and one bar in ``bars.parquet``. Its number is counted from 1, unless
    ``numbers`` has it; it is the diameter of the bar in mm, unless ``diameters_m`` has that, and 10 times the
    number is the index of its first view in ``_depth_m``. ``families`` has the families of scenes that have one.
    """
    (root / "cages").mkdir(parents=True)
    records: list[ViewRecord] = []
    entries = []
    number_of = {scene: number for number, scene in enumerate(scenes, start=1)} | dict(numbers or {})
    for scene, split in scenes.items():
        number = number_of[scene]
        ids = [f"cages/{split}-{scene}-{index:04d}" for index in range(views)]
        encoded = [
            encode_view(replace(_view(view_id, 10 * number + n), scene=scene)) for n, view_id in enumerate(ids)
        ]
        shard = f"cages/{split}-{scene}.parquet"
        pq.write_table(pa.concat_tables([table for table, _ in encoded]), root / shard, row_group_size=1)
        records += [record for _, record in encoded]
        family = (families or {}).get(scene)
        entries.append({**scene_entry(scene, views, shard, split), "family": family})
    axis_m = ((0.0, 0.0, 0.3), (0.0, 1.0, 0.3))
    known_m = {scene: 0.001 * number for scene, number in number_of.items()} | dict(diameters_m or {})
    bars = {scene: (Bar(1, "vertical", known_m[scene], axis_m),) for scene in scenes}
    write_bars(root / BARS_FILE, bars)
    entry = {**config_entry(records), "has_splits": True, "scenes": entries}
    _write_manifest(root, {"cages": entry}, records, {BARS_FILE: file_sha256(root / BARS_FILE)})


def write_archive(path: Path, configs: Sequence[str], views: int, method: str, seed: int) -> None:
    """Write a submission with a prediction for every view: ground-truth depth with 2 % Gaussian noise, float32."""
    rng = np.random.default_rng(seed)
    with SubmissionWriter(path, method) as writer:
        for config in configs:
            for index in range(views):
                noise = 1 + 0.02 * rng.standard_normal((HEIGHT, WIDTH))
                writer.add(_view_id(config, index), (_depth_m(index) * noise).astype(np.float32))


def _write_config(folder: Path, config: str, views: int) -> list[ViewRecord]:
    folder.mkdir(parents=True)
    encoded = [encode_view(_view(_view_id(config, index), index)) for index in range(views)]
    pq.write_table(pa.concat_tables([table for table, _ in encoded]), folder / "test.parquet", row_group_size=1)
    return [record for _, record in encoded]


def config_entry(records: Sequence[ViewRecord], width: int = WIDTH, height: int = HEIGHT) -> dict[str, Any]:
    """Return the entry of a config in the manifest without its scenes."""
    return {
        "has_splits": False,
        "rig": {"height": height, "width": width},
        "colour": {},
        "views": [record.model_dump() for record in records],
        "ground_truth_digest": views_digest(records),
        "sheet": "pictures/none.webp",
    }


def scene_entry(name: str, views: int, shard: str, split: str = "test") -> dict[str, Any]:
    """Return the entry of a scene in the manifest."""
    return {
        "name": name,
        "split": split,
        "assembly": {"kind": "bars"},
        "board": None,
        "protocol": {"kind": "ring", "radius_m": 1.0, "azimuths": views},
        "protocol_views": views,
        "rig": {"grid": "ideal", "baseline_m": BASELINE_M},
        "key": "",
        "mesh": "meshes/none.ply",
        "shards": [shard],
        "bytes": 0,
    }


def _view_id(config: str, index: int) -> str:
    return f"{config}/{index:04d}"


def _view(view_id: str, index: int) -> View:
    return View(view_id, config_of(view_id), _eye(index, 0.0), _eye(index, BASELINE_M), BASELINE_M)


def _eye(index: int, x_m: float) -> RenderedEye:
    """Return what a camera sees that is displaced by ``x_m``; the scene moves with the camera."""
    mask = np.broadcast_to(_is_bar(), (HEIGHT, WIDTH))
    K = np.array([[100.0, 0.0, (WIDTH - 1) / 2], [0.0, 100.0, (HEIGHT - 1) / 2], [0.0, 0.0, 1.0]])
    cam_from_world = np.eye(4)
    cam_from_world[0, 3] = -x_m
    return RenderedEye(
        Camera(K, np.zeros(5), cam_from_world, WIDTH, HEIGHT),
        rgb=np.where(mask[..., None], 200, 60).astype(np.uint8).repeat(3, axis=2),
        depth_m=_depth_m(index),
        mask=mask,
        bars=mask.astype(np.uint16),
    )


def _is_bar() -> np.ndarray:
    return np.arange(WIDTH) % _BAR_PERIOD_PX < _BAR_WIDTH_PX


def _depth_m(index: int) -> np.ndarray:
    """Return the planar depth of a view, metres, float32, ``HEIGHT`` x ``WIDTH``.

    The bars lean away from the camera and stand 10 mm farther away in each view; the wall behind them is at 1.5 m.
    """
    bars_m = 0.3 + 0.01 * index + 0.001 * np.arange(HEIGHT)[:, None]
    return np.where(_is_bar()[None, :], bars_m, 1.5).astype(np.float32)
