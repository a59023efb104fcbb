"""Caches of ``datasets``: scenes of ``cages`` that are added or built anew are seen by the next call."""

from __future__ import annotations

import shutil
from pathlib import Path

import datasets
import pytest

import rebar_depth_bench as rdb
from rebar_depth_bench.data.manifest import open_folder
from tests.building import RunBuild


def loaded_ids(root: Path) -> list[list[str]]:
    """Return the view ids of ``train`` as plain ``datasets`` and ``load`` return them, streaming and not."""
    return [
        [row["view_id"] for row in load(str(root), "cages", split="train", streaming=streaming)]
        for streaming in (False, True)
        for load in (datasets.load_dataset, rdb.load)
    ]


def first_depth(root: Path) -> list[bytes]:
    plain = datasets.load_dataset(str(root), "cages", split="train")[0]["left_depth"]
    return [plain, rdb.load(root, "cages", split="train", columns=["left_depth"])[0]["left_depth"].tobytes()]


@pytest.mark.slow
def test_added_and_rebuilt_scenes_are_loaded_in_place_of_cached_ones(tmp_path: Path, run_build: RunBuild) -> None:
    root = tmp_path / "dataset"

    def build(scenes: int, seed: int) -> None:
        size = ("--width", "64", "--height", "36", "--no-colour", "--views-per-scene", "1")
        request = ("--config", "cages", "--split", "train", "--scenes", str(scenes), "--seed", str(seed))
        process = run_build("--out", root, *request, *size)
        assert process.returncode == 0, process.stderr

    def expected() -> list[str]:
        return list(open_folder(root).config("cages").of_split("train").view_ids)

    build(1, seed=0)
    depth = first_depth(root)
    assert loaded_ids(root) == [expected()] * 4
    build(2, seed=0)
    assert len(expected()) == 2
    assert loaded_ids(root) == [expected()] * 4
    assert first_depth(root) == depth
    shutil.rmtree(root)
    build(1, seed=1)
    assert loaded_ids(root) == [expected()] * 4
    assert all(new != old for new, old in zip(first_depth(root), depth, strict=True))
    assert 'load_dataset("PATH_OR_HUB_ID", "cages", split="train")' in (root / "README.md").read_text()
