"""Dataset folder of smooth reinforcing mats whose views are computed in closed form, with judged crossings."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from dataset_builder.pipeline.shards import View, encode_view
from rebar_depth_bench.bar_crossings.crossings_file import CROSSINGS_FILE, crossings_entry, write_crossings
from rebar_depth_bench.data.bars import BARS_FILE, Bar, write_bars
from rebar_depth_bench.data.files import MANIFEST_FILE, file_sha256, planes_digest, views_digest
from rebar_depth_bench.data.manifest import MANIFEST_FORMAT
from rebar_depth_bench.data.rows import RenderedEye
from rebar_depth_bench.data.schema import ViewRecord
from rebar_depth_bench.geometry.cameras import Camera, look_at
from rebar_depth_bench.scoring.protocol import PROTOCOL
from tests.bench.extended.cage_scenes import FOCAL_PX, HEIGHT, WIDTH, bar, cast, pixel_directions
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


DECK_Z_M = -0.061
"""Height of the deck, 30 mm below the lying bars of the mat and 51 mm below the upright ones."""
DECK = {"name": "deck", "point_m": [0.4, 0.2, DECK_Z_M], "normal": [0.0, 0.0, 1.0]}


def on_deck_m(pose: np.ndarray) -> np.ndarray:
    """Return the planar depth, metres, at which the ray of each pixel meets the deck."""
    rotation, shift_m = pose[:3, :3], pose[:3, 3]
    camera_z_m = -(rotation.T @ shift_m)[2]
    return np.asarray((DECK_Z_M - camera_z_m) / (pixel_directions() @ rotation[:, 2]))


def mat_views(
    ids: Sequence[str],
    scene: str,
    bars: Sequence[Bar],
    *,
    with_deck: bool = False,
    at: Sequence[np.ndarray] | None = None,
) -> list[View]:
    """Return the views of a mat with the given ids, at poses (default: those of ``poses``)."""
    K = np.array([[FOCAL_PX, 0, (WIDTH - 1) / 2], [0, FOCAL_PX, (HEIGHT - 1) / 2], [0, 0, 1.0]])
    views = []
    for view_id, pose in zip(ids, poses(len(ids)) if at is None else at, strict=True):
        depth_m, bar_ids = cast([item for item in bars if item.has_axis], pose)
        if with_deck:
            depth_m = np.where(bar_ids > 0, depth_m, on_deck_m(pose))
        depth_m, bar_ids = (image.reshape(HEIGHT, WIDTH) for image in (depth_m, bar_ids))
        eye = RenderedEye(
            Camera(K, np.zeros(5), pose, WIDTH, HEIGHT),
            rgb=np.where(bar_ids[..., None] > 0, 150, 70).astype(np.uint8).repeat(3, axis=2),
            depth_m=depth_m.astype(np.float32),
            mask=bar_ids > 0,
            bars=bar_ids.astype(np.uint16),
        )
        views.append(View(view_id, scene, eye, eye, 0.12))
    return views


def write_mat_dataset(
    root: Path,
    *,
    with_crossings: bool = True,
    with_deck: bool = False,
    at: Sequence[np.ndarray] | None = None,
) -> dict[str, np.ndarray]:
    """Write the folder with the configs ``mat`` and ``cages``; return the left depth of every view by id.

    With ``with_deck``, all mats lie above a deck of formwork. ``at`` are the poses of the views of ``mat``.
    """
    views_of_mat = VIEWS if at is None else len(at)
    bars = {CONFIG: mat_bars(), **{name: mat_bars((-0.06, 0.01 * i)) for i, name in enumerate(SCENES)}}
    by_scene = {CONFIG: [f"{CONFIG}/{index:04d}" for index in range(views_of_mat)]}
    by_scene |= {
        name: [f"{CAGES}/{split}-{name}-{index:04d}" for index in range(2)] for name, split in SCENES.items()
    }
    entries: dict[str, dict[str, Any]] = {}
    records: list[ViewRecord] = []
    depths: dict[str, np.ndarray] = {}
    shards: dict[str, tuple[str, list[ViewRecord]]] = {}
    for scene, ids in by_scene.items():
        views = mat_views(ids, scene, bars[scene], with_deck=with_deck, at=at if scene == CONFIG else None)
        encoded = [encode_view(view) for view in views]
        depths |= {view.view_id: view.left.depth_m for view in views}
        folder = CONFIG if scene == CONFIG else CAGES
        (root / folder).mkdir(parents=True, exist_ok=True)
        shard = f"{folder}/{scene}.parquet"
        rows = pa.concat_tables([table for table, _ in encoded])
        pq.write_table(rows, root / shard, row_group_size=1, write_statistics=False)
        shards[scene] = shard, [record for _, record in encoded]
        records += shards[scene][1]
    planes = {"planes": [DECK]} if with_deck else {}
    entries[CONFIG] = {
        **config_entry(shards[CONFIG][1], WIDTH, HEIGHT),
        "scenes": [scene_entry(CONFIG, views_of_mat, shards[CONFIG][0]) | planes],
    }
    entries[CAGES] = {
        **config_entry([record for name in SCENES for record in shards[name][1]], WIDTH, HEIGHT),
        "has_splits": True,
        "scenes": [scene_entry(name, 2, shards[name][0], split) | planes for name, split in SCENES.items()],
    }
    if with_deck:
        for entry in entries.values():
            entry["planes_digest"] = planes_digest(entry["scenes"])
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
