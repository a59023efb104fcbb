"""Tests of the cache of ground truth: damage never changes a score."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rebar_depth_bench import DatasetError, score
from rebar_depth_bench.bar_crossings.crossings_file import write_crossings
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.data.bars import read_bars, write_bars
from rebar_depth_bench.data.files import file_sha256
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.extended.ground_truth import load_steel_truth
from rebar_depth_bench.scoring.truth import config_truth, verified_views
from tests.commands import run_in_process
from tests.damage import change_manifest, change_rows, copy_dataset
from tests.ground_truth import truth_of

CONFIG = "lattice-orbit"


@pytest.fixture
def archive(tiny_root: Path, archive_of: Callable[..., Path]) -> Path:
    views = verified_views(open_folder(tiny_root).config(CONFIG))
    return archive_of({view_id: 1.015 * left.depth_m for view_id, (left,), _ in views})


@pytest.fixture
def copy(tiny_root: Path, tmp_path: Path) -> Path:
    return copy_dataset(tiny_root, tmp_path / "dataset")


def tree(folder: Path) -> dict[str, bytes]:
    """Return the content of all files below a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def result(archive: Path, root: Path, target: Path) -> tuple[bytes, str]:
    """Return the extended result of ``rebar-bench score`` and its standard error without progress."""
    finished = run_in_process(main, "score", archive, "--data", root, "--json", target, "--extended")
    assert finished.returncode == 0, finished.stderr
    return target.read_bytes(), "\n".join(line for line in finished.stderr.splitlines() if line[:8] == "warning:")


@pytest.mark.slow
def test_changed_byte_in_a_file_of_the_cache_changes_no_result(
    tiny_root: Path, archive: Path, tmp_path: Path, empty_cache: Path
) -> None:
    target = tmp_path / "result.json"
    expected, warnings = result(archive, tiny_root, target)
    assert warnings == ""
    intact = tree(empty_cache)
    assert len(intact) == 2, "ground truth, and that of extended measures"
    for name, content in intact.items():
        middle = len(content) // 2
        (empty_cache / name).write_bytes(content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :])
    found, warnings = result(archive, tiny_root, target)
    assert found == expected
    assert sorted(name for name in intact for line in warnings.splitlines() if name in line) == sorted(intact)
    assert result(archive, tiny_root, target) == (expected, "")  # Written again, if it was deleted.
    assert tree(empty_cache) == intact


@pytest.mark.usefixtures("empty_cache")
def test_digest_in_manifest_is_no_path(tiny_root: Path, tmp_path: Path, empty_cache: Path) -> None:
    documents = tmp_path / "Documents"
    documents.mkdir()
    (documents / "letter.txt").write_text("precious")
    folder = open_folder(tiny_root)
    hostile = folder.config(CONFIG).model_copy(
        update={"ground_truth_digest": "/../../../Documents", "name": "../../Documents"}
    )
    for _ in range(2):  # The second run deleted the folder.
        config_truth(folder, hostile)
        load_steel_truth(folder, hostile)
    assert tree(documents) == {"letter.txt": b"precious"}
    assert len([*empty_cache.iterdir()]) == 2
    assert {path.name for path in tmp_path.iterdir()} == {"Documents", "caches"}


def test_other_views_have_an_entry_of_their_own(tiny_root: Path, copy: Path, empty_cache: Path) -> None:
    change_manifest(copy, lambda _, config: config["views"].pop(), CONFIG)
    assert len(truth_of(tiny_root, CONFIG).views) == 2
    with pytest.raises(DatasetError, match="the file has 2 rows"):
        truth_of(copy, CONFIG)
    assert len([*empty_cache.iterdir()]) == 1


@pytest.mark.usefixtures("empty_cache")
def test_dataset_folder_is_not_written(copy: Path, archive: Path) -> None:
    before = tree(copy)
    score(archive, copy)
    load_steel_truth(open_folder(copy), open_folder(copy).config(CONFIG))
    assert tree(copy) == before


@pytest.mark.usefixtures("empty_cache")
def test_shuffled_rows_give_the_same_order(tiny_root: Path, copy: Path) -> None:
    expected = truth_of(tiny_root, "lattice").view_ids
    for shard in copy.glob("lattice/*.parquet"):
        change_rows(shard, list.reverse)
    for path in Path(os.environ["XDG_CACHE_HOME"]).glob("*/*"):
        path.unlink()
    truths = truth_of(copy, "lattice")
    assert tuple(truth.view_id for truth in truths.views) == truths.view_ids == expected


@pytest.mark.usefixtures("empty_cache")
def test_images_may_show_bars_that_the_table_lacks(copy: Path) -> None:
    bars = read_bars(copy / "bars.parquet")
    write_bars(copy / "bars.parquet", {scene: of_scene[: len(of_scene) // 2] for scene, of_scene in bars.items()})
    write_crossings(copy / "crossings.parquet", read_bars(copy / "bars.parquet"))
    digests = {name: file_sha256(copy / name) for name in ("bars.parquet", "crossings.parquet")}
    change_manifest(copy, lambda manifest, _: manifest["files"].update(digests), CONFIG)
    folder = open_folder(copy)
    steel = load_steel_truth(folder, folder.config(CONFIG))
    truth = steel.view(0)
    assert np.isnan(steel.bars_by_view[truth.view_id].diameter_m[truth.bar_id]).any()


def test_cache_command_shows_and_clears(tiny_root: Path, empty_cache: Path) -> None:
    def lines(*options: str) -> str:
        finished = run_in_process(main, "cache", *options)
        assert (finished.returncode, finished.stderr) == (0, "")
        return finished.stdout

    limit = "of at most 21474836480 (REBAR_MAX_CACHE_BYTES)"
    assert lines() == f"{empty_cache}: 0 files, 0 bytes {limit}\n"
    truth_of(tiny_root, CONFIG)
    [path] = empty_cache.iterdir()
    size = f"1 file, {path.stat().st_size} bytes"
    assert lines() == f"{empty_cache}: {size} {limit}\n"
    assert lines("--clear") == f"{empty_cache}: deleted {size}\n"
    assert [*empty_cache.iterdir()] == []


def test_cache_command_refuses_linked_folder(empty_cache: Path, tmp_path: Path) -> None:
    empty_cache.parent.mkdir()
    (tmp_path / "other").mkdir()
    empty_cache.symlink_to(tmp_path / "other")
    for options in ([], ["--clear"]):
        finished = run_in_process(main, "cache", *options)
        assert finished.returncode == 2
        assert f"{empty_cache}: is a symbolic link" in finished.stderr
