"""Damaged copies of a dataset folder: a changed manifest with matching digests, and changed rows of a shard."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from rebar_depth_bench.data.files import views_digest
from rebar_depth_bench.data.schema import ViewRecord


def copy_dataset(root: Path, target: Path) -> Path:
    """Copy a dataset folder."""
    return shutil.copytree(root, target)


def change_manifest(root: Path, change: Callable[[Any, Any], object], config: str = "lattice") -> None:
    """Apply ``change`` to the manifest and the entry of a config, and write it with the digests of its views."""
    path = root / "manifest.json"
    manifest = json.loads(path.read_text())
    change(manifest, manifest["configs"][config])
    entries = manifest["configs"].values()
    for entry in entries:
        entry["ground_truth_digest"] = views_digest(ViewRecord(**view) for view in entry["views"])
    records = [ViewRecord(**view) for entry in entries for view in entry["views"]]
    manifest["ground_truth"]["digest"] = views_digest(records)
    path.write_text(json.dumps(manifest))


def first_shard(root: Path, config: str = "lattice-orbit") -> Path:
    """Return the path of the first shard of a config."""
    return min(root.glob(f"{config}/*.parquet"))


def change_rows(shard: Path, change: Callable[[list[dict[str, Any]]], object], **options: Any) -> None:
    """Apply ``change`` to the rows of a shard in place; ``options`` are those of the Parquet writer."""
    table = pq.read_table(shard)
    rows = table.to_pylist()
    change(rows)
    pq.write_table(pa.Table.from_pylist(rows, table.schema), shard, **options)
