"""The audit passes a good folder, with figures, and names what is wrong with a bad one."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

import rebar_depth_bench as rdb
from dataset_builder.audit import audit
from dataset_builder.audit.files import array_problems, row_problems
from dataset_builder.audit.run import VIEW_CHECKS
from dataset_builder.build.bars_table import read_bars
from rebar_depth_bench.data.ground_truth import CACHE_FOLDER
from rebar_depth_bench.data.manifest import open_folder

Row = dict[str, Any]


@pytest.fixture
def copy(tiny_root: Path, tmp_path: Path) -> Path:
    target = tmp_path / "dataset"
    shutil.copytree(tiny_root, target, ignore=shutil.ignore_patterns(CACHE_FOLDER))
    return target


@pytest.fixture(scope="module")
def row(tiny_root: Path) -> Row:
    found: Row = rdb.load(tiny_root, "lattice")[4]
    return found


@pytest.mark.render
def test_a_good_folder_passes_every_check_with_figures(tiny_root: Path) -> None:
    command = [sys.executable, "-m", "dataset_builder", "audit", str(tiny_root), "--depth-views", "2"]
    finished = subprocess.run(command, capture_output=True, text=True, check=False, env={"COLUMNS": "160"})
    assert finished.returncode == 0, finished.stdout + finished.stderr
    assert "FAILED" not in finished.stdout
    assert finished.stdout.count(" ok ") == 2 + 2 * (3 + len(VIEW_CHECKS))
    assert "2 views: median 0.0" in finished.stdout  # micrometres against Cycles


def failed(root: Path) -> dict[str, tuple[str, ...]]:
    return {check.name: check.problems for check in audit(root, depth_views=0).failures}


def test_a_changed_a_missing_and_a_foreign_file_are_named(copy: Path) -> None:
    mesh = copy / "meshes" / "lattice.ply"
    mesh.write_bytes(mesh.read_bytes()[:-1] + b"\x7f")
    (copy / "bars.parquet").unlink()
    (copy / "lattice" / "extra.txt").write_text("")
    problems = failed(copy)["files against the manifest"]
    assert len(problems) == 3
    assert any(problem.startswith("meshes/lattice.ply: SHA-256 is") for problem in problems)
    assert "bars.parquet: is missing" in problems
    assert "lattice/extra.txt: is not in the manifest" in problems


def test_a_wrong_digest_is_named(copy: Path) -> None:
    manifest = json.loads((copy / "manifest.json").read_text())
    manifest["ground_truth"]["digest"] = "sha256:00"
    (copy / "manifest.json").write_text(json.dumps(manifest))
    assert "the ground-truth digest is sha256:00, expected sha256:" in failed(copy)["digests of the manifest"][0]


def changed(row: Row, **cells: Any) -> Row:
    return {**row, **cells}


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda row: {"left_depth": row["left_depth"].astype(np.float64)}, "left depth is float64"),
        (
            lambda row: {"right_rgb": row["right_rgb"][:-1]},
            "right rgb is uint8 (89, 160, 3), expected uint8 (90, 160, 3)",
        ),
        (lambda row: {"left_depth": -row["left_depth"]}, "below 0"),
        (lambda row: {"right_depth": row["right_depth"] + np.float32(np.nan)}, "right depth has values"),
        (lambda row: {"left_K": row["left_K"][:2]}, "left_K is not (3, 3) of finite numbers"),
        (lambda row: {"right_distortion": row["right_distortion"] + np.inf}, "right_distortion is not (5,)"),
    ],
)
def test_arrays_that_cannot_be_judged_are_named(
    tiny_root: Path, row: Row, damage: Callable[[Row], Row], words: str
) -> None:
    rig = open_folder(tiny_root).config("lattice")["rig"]
    assert list(array_problems(row, rig)) == []
    problems = list(array_problems(changed(row, **damage(row)), rig))
    assert any(words in problem for problem in problems), problems


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
            "left ground truth has another",
        ),
        (lambda row: {"right_K": row["right_K"] + 1e-9}, "right ground truth has another"),
        (lambda _: {"view_id": "lattice/0001"}, "the row's view_id is lattice/0001"),
    ],
)
def test_every_broken_invariant_is_named(
    tiny_root: Path, row: Row, damage: Callable[[Row], Row], words: str
) -> None:
    record = open_folder(tiny_root).views("lattice")[4]
    bar_ids = {bar.bar_id for bar in read_bars(tiny_root / "bars.parquet")["lattice"]}
    assert list(row_problems(row, record, bar_ids)) == []
    problems = list(row_problems(changed(row, **damage(row)), record, bar_ids))
    assert any(words in problem for problem in problems), problems


def test_a_manifest_of_other_cameras_is_noticed(copy: Path) -> None:
    """The rows stay as they are; the manifest claims a longer baseline and another dome."""
    manifest = json.loads((copy / "manifest.json").read_text())
    manifest["configs"]["lattice"]["rig"]["baseline_m"] = 0.121
    manifest["configs"]["lattice-orbit"]["protocol"]["radius_m"] = 0.326
    (copy / "manifest.json").write_text(json.dumps(manifest))
    found = failed(copy)
    assert set(found) == {"lattice: cameras", "lattice-orbit: cameras"}
    assert any("baseline_m is 0.12, expected 0.121" in problem for problem in found["lattice: cameras"])
    assert all("cam_from_world is" in problem for problem in found["lattice-orbit: cameras"])


def test_a_swapped_row_is_noticed(copy: Path) -> None:
    """Two views change places in a shard, with a manifest that is otherwise in order."""
    shard = next(copy.glob("lattice/*00000-of*.parquet"))
    table = pq.read_table(shard)
    order = [1, 0, *range(2, table.num_rows)]
    pq.write_table(table.take(order), shard)
    manifest = json.loads((copy / "manifest.json").read_text())
    name = shard.relative_to(copy).as_posix()
    manifest["files"][name] = hashlib.sha256(shard.read_bytes()).hexdigest()
    (copy / "manifest.json").write_text(json.dumps(manifest))
    problems = failed(copy)["lattice: rows"]
    assert any("the row's view_id is" in problem for problem in problems)


def test_records_are_compared_whole(tiny_root: Path, row: Row) -> None:
    folder = open_folder(tiny_root)
    record = replace(folder.views("lattice")[4], scored_px=1)
    problems = list(row_problems(row, record, set(range(1, 76))))
    assert problems == ["steel and scored pixel counts differ from the manifest's"]
