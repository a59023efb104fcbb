"""Audit of a dataset folder: a correct folder passes, and every defect is reported."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

import rebar_depth_bench as rdb
from dataset_builder.audit import audit
from dataset_builder.audit.auditing import VIEW_CHECKS, check_crossings, row_problems
from dataset_builder.audit.checks import RayCache, view_from_row
from rebar_depth_bench.bar_crossings.table import write_crossings
from rebar_depth_bench.data.bars import read_bars
from rebar_depth_bench.data.manifest import open_folder

Row = dict[str, Any]


@pytest.fixture
def copy(tiny_root: Path, tmp_path: Path) -> Path:
    target = tmp_path / "dataset"
    shutil.copytree(tiny_root, target)
    return target


@pytest.fixture(scope="module")
def row(tiny_root: Path) -> Row:
    loaded: Row = rdb.load(tiny_root, "lattice")[4]
    return loaded


@pytest.mark.usefixtures("blender")
def test_correct_dataset_passes_with_measured_values(tiny_root: Path) -> None:
    command = [sys.executable, "-m", "dataset_builder", "audit", str(tiny_root), "--depth-views", "2"]
    process = subprocess.run(command, capture_output=True, text=True, check=False, env={"COLUMNS": "160"})
    assert process.returncode == 0, process.stdout + process.stderr
    assert "FAILED" not in process.stdout
    assert (process.stdout.count(" ok "), process.stdout.count("skipped")) == (2 + 2 * (3 + len(VIEW_CHECKS)), 0)
    assert "2 views: median 0.0" in process.stdout  # micrometre agreement with Cycles


def failed_checks(root: Path) -> dict[str, tuple[str, ...]]:
    return {check.name: check.problems for check in audit(root, depth_views=0).failures}


def test_changed_missing_and_extra_files_are_reported(copy: Path) -> None:
    mesh = copy / "meshes" / "lattice.ply"
    mesh.write_bytes(mesh.read_bytes()[:-1] + b"\x7f")
    (copy / "bars.parquet").unlink()
    (copy / "lattice" / "extra.txt").write_text("")
    problems = failed_checks(copy)["files against the manifest"]
    assert len(problems) == 3
    assert any(problem.startswith("meshes/lattice.ply: SHA-256 is") for problem in problems)
    assert "bars.parquet: is missing" in problems
    assert "lattice/extra.txt: is not in the manifest" in problems


def test_crossings_that_are_not_those_of_the_bars_are_reported(copy: Path) -> None:
    bars = read_bars(copy / "bars.parquet")
    write_crossings(copy / "crossings.parquet", {scene: of_scene[:-1] for scene, of_scene in bars.items()})
    manifest = json.loads((copy / "manifest.json").read_text())
    manifest["files"]["crossings.parquet"] = hashlib.sha256((copy / "crossings.parquet").read_bytes()).hexdigest()
    (copy / "manifest.json").write_text(json.dumps(manifest))
    folder = open_folder(copy)
    check = check_crossings(folder, bars)
    assert check.problems == ("crossings.parquet: scene lattice differs from the crossings of its bars",)
    write_crossings(copy / "crossings.parquet", bars)
    folder.files["crossings.parquet"] = hashlib.sha256((copy / "crossings.parquet").read_bytes()).hexdigest()
    assert check_crossings(folder, bars).measured == "375 crossings"
    assert check_crossings(folder, bars).passed


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (
            lambda row: {"left_mask": ~row["left_mask"]},
            "left: the mask differs from the pixels that have a bar id",
        ),
        (lambda row: {"left_depth": 0 * row["left_depth"]}, "left: steel pixels without depth"),
        (lambda row: {"right_bars": np.where(row["right_mask"], 999, 0).astype(np.uint16)}, "bar ids [999]"),
        (
            lambda row: {"left_depth": np.nextafter(row["left_depth"], np.float32(9))},
            "left ground-truth digest differs",
        ),
        (lambda row: {"right_K": row["right_K"] + 1e-9}, "right ground-truth digest differs"),
        (lambda _: {"view_id": "lattice/0001"}, "the row's view_id is lattice/0001"),
    ],
)
def test_broken_row_invariants_are_reported(
    tiny_root: Path, row: Row, damage: Callable[[Row], Row], words: str
) -> None:
    record = open_folder(tiny_root).config("lattice").views[4]
    bar_ids = {bar.bar_id for bar in read_bars(tiny_root / "bars.parquet")["lattice"]}
    assert list(row_problems(view_from_row(row, RayCache()), record, bar_ids)) == []
    damaged = view_from_row({**row, **damage(row)}, RayCache())
    problems = list(row_problems(damaged, record, bar_ids))
    assert any(words in problem for problem in problems), problems


@pytest.mark.slow
def test_manifest_with_other_cameras_is_reported(copy: Path) -> None:
    """Audit unchanged rows against a manifest with a longer baseline and another ring radius."""
    manifest = json.loads((copy / "manifest.json").read_text())
    manifest["configs"]["lattice"]["scenes"][0]["rig"]["baseline_m"] = 0.121
    manifest["configs"]["lattice-orbit"]["scenes"][0]["protocol"]["radius_m"] = 0.326
    (copy / "manifest.json").write_text(json.dumps(manifest))
    failures = failed_checks(copy)
    assert set(failures) == {"lattice: cameras", "lattice-orbit: cameras"}
    assert any("baseline_m is 0.12, expected 0.121" in problem for problem in failures["lattice: cameras"])
    assert all("cam_from_world differs by" in problem for problem in failures["lattice-orbit: cameras"])


@pytest.mark.slow
def test_swapped_rows_are_reported(copy: Path) -> None:
    """Swap two views in a shard while the rest of the manifest stays consistent."""
    shard = next(copy.glob("lattice/*00000-of*.parquet"))
    table = pq.read_table(shard)
    order = [1, 0, *range(2, table.num_rows)]
    pq.write_table(table.take(order), shard)
    manifest = json.loads((copy / "manifest.json").read_text())
    name = shard.relative_to(copy).as_posix()
    manifest["files"][name] = hashlib.sha256(shard.read_bytes()).hexdigest()
    (copy / "manifest.json").write_text(json.dumps(manifest))
    problems = failed_checks(copy)["lattice: rows"]
    assert any("the row's view_id is" in problem for problem in problems)


def test_all_fields_of_view_record_are_compared(tiny_root: Path, row: Row) -> None:
    view = open_folder(tiny_root).config("lattice").views[4]
    record = view.model_copy(update={"scored_px": 1})
    problems = list(row_problems(view_from_row(row, RayCache()), record, set(range(1, 76))))
    assert problems == ["steel and scored pixel counts differ from the manifest's"]
