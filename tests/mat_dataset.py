"""Dataset folder of smooth reinforcing mats whose views are computed in closed form, with judged crossings."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from dataset_builder.pipeline.shards import View, encode_view
from rebar_depth_bench.bar_crossings.crossings_file import CROSSINGS_FILE, crossings_entry, write_crossings
from rebar_depth_bench.data.bars import BARS_FILE, Bar, write_bars
from rebar_depth_bench.data.files import MANIFEST_FILE, file_sha256, views_digest
from rebar_depth_bench.data.manifest import MANIFEST_FORMAT
from rebar_depth_bench.data.rows import EyeView
from rebar_depth_bench.data.schema import ViewRecord
from rebar_depth_bench.geometry.cameras import Camera, look_at
from rebar_depth_bench.scoring.protocol import PROTOCOL
from tests.bench.extended.cage_scenes import FOCAL_PX, HEIGHT, WIDTH, bar, cast
from tests.synthetic_dataset import config_entry, scene_entry

VIEWS = 6
CONFIG, CAGES = "mat", "cages"
SCENES = {"first": "test", "second": "test", "third": "train"}
"""Scenes of the config ``cages`` with their splits."""


def mat_bars(upright: Sequence[float] = (-0.06, 0.06)) -> tuple[Bar, ...]:
    """Return upright bars at x before two lying ones, 1 mm apart, and a bar without axis that no view shows."""
    bars = [bar(i + 1, (x, -0.15, 0.0), (x, 0.15, 0.0)) for i, x in enumerate(upright)]
    bars += [bar(i + 11, (-0.2, y, -0.021), (0.2, y, -0.021)) for i, y in enumerate((-0.05, 0.05))]
    return (*bars, Bar.without_axis(40, "plate"))


def poses(count: int) -> list[np.ndarray]:
    """Return poses of cameras before the mat, 0.36 m away and more, each a little to the side of the last."""
    angles = np.linspace(-0.3, 0.3, count)
    return [
        look_at(np.array([d * np.sin(a), 0.05 * np.cos(5 * a), d * np.cos(a)]), np.zeros(3))
        for d, a in zip(np.linspace(0.36, 0.52, count), angles, strict=True)
    ]


def mat_views(ids: Sequence[str], scene: str, bars: Sequence[Bar]) -> list[View]:
    """Return the views of a mat with the given ids."""
    K = np.array([[FOCAL_PX, 0, (WIDTH - 1) / 2], [0, FOCAL_PX, (HEIGHT - 1) / 2], [0, 0, 1.0]])
    views = []
    for view_id, pose in zip(ids, poses(len(ids)), strict=True):
        depth_m, bar_ids = cast([item for item in bars if item.has_axis], pose)
        depth_m, bar_ids = (image.reshape(HEIGHT, WIDTH) for image in (depth_m, bar_ids))
        eye = EyeView(
            Camera(K, np.zeros(5), pose, WIDTH, HEIGHT),
            rgb=np.where(bar_ids[..., None] > 0, 150, 70).astype(np.uint8).repeat(3, axis=2),
            depth_m=depth_m.astype(np.float32),
            mask=bar_ids > 0,
            bars=bar_ids.astype(np.uint16),
        )
        views.append(View(view_id, scene, eye, eye, 0.12))
    return views


def write_mat_dataset(root: Path, *, with_crossings: bool = True) -> dict[str, np.ndarray]:
    """Write the folder with the configs ``mat`` and ``cages``; return the left depth of every view by id."""
    bars = {CONFIG: mat_bars(), **{name: mat_bars((-0.06, 0.01 * i)) for i, name in enumerate(SCENES)}}
    by_scene = {CONFIG: [f"{CONFIG}/{index:04d}" for index in range(VIEWS)]}
    by_scene |= {
        name: [f"{CAGES}/{split}-{name}-{index:04d}" for index in range(2)] for name, split in SCENES.items()
    }
    entries: dict[str, object] = {}
    records: list[ViewRecord] = []
    depths: dict[str, np.ndarray] = {}
    shards: dict[str, tuple[str, list[ViewRecord]]] = {}
    for scene, ids in by_scene.items():
        views = mat_views(ids, scene, bars[scene])
        encoded = [encode_view(view) for view in views]
        depths |= {view.view_id: view.left.depth_m for view in views}
        folder = CONFIG if scene == CONFIG else CAGES
        (root / folder).mkdir(parents=True, exist_ok=True)
        shard = f"{folder}/{scene}.parquet"
        pq.write_table(pa.concat_tables([table for table, _ in encoded]), root / shard, row_group_size=1)
        shards[scene] = shard, [record for _, record in encoded]
        records += shards[scene][1]
    entries[CONFIG] = {
        **config_entry(shards[CONFIG][1], WIDTH, HEIGHT),
        "scenes": [scene_entry(CONFIG, VIEWS, shards[CONFIG][0])],
    }
    entries[CAGES] = {
        **config_entry([record for name in SCENES for record in shards[name][1]], WIDTH, HEIGHT),
        "has_splits": True,
        "scenes": [scene_entry(name, 2, shards[name][0], split) for name, split in SCENES.items()],
    }
    _write_tables(root, bars, entries, records, with_crossings)
    return depths


def _write_tables(
    root: Path,
    bars: Mapping[str, tuple[Bar, ...]],
    entries: Mapping[str, object],
    records: Sequence[ViewRecord],
    with_crossings: bool,
) -> None:
    write_bars(root / BARS_FILE, bars)
    write_crossings(root / CROSSINGS_FILE, bars)
    names = [BARS_FILE, *([CROSSINGS_FILE] if with_crossings else [])]
    manifest = {
        "format": MANIFEST_FORMAT,
        "version": "0.0.0",
        "protocol": PROTOCOL,
        "ground_truth": {"digest": views_digest(records)},
        **({"crossings": crossings_entry(root / CROSSINGS_FILE)} if with_crossings else {}),
        "configs": entries,
        "files": {name: file_sha256(root / name) for name in names},
    }
    if not with_crossings:
        (root / CROSSINGS_FILE).unlink()
    (root / MANIFEST_FILE).write_text(json.dumps(manifest))
