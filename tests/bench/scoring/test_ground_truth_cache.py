"""Tests of the cache of ground truth: damage never changes a score."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rebar_depth_bench import DatasetError, score
from rebar_depth_bench.bar_crossings.table import write_crossings
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.data.bars import read_bars, write_bars
from rebar_depth_bench.data.codecs import decode, encode_depth
from rebar_depth_bench.data.files import file_sha256
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.rows import EyeTruth
from rebar_depth_bench.extended.ground_truth import load_steel_truth
from rebar_depth_bench.scoring.truth import config_truth, verified_views
from tests.commands import run_in_process
from tests.damage import change_manifest
from tests.ground_truth import truth_of
from tests.requirements import Repetitions

GRID = (90, 160)
CONFIG = "lattice-orbit"


@pytest.fixture
def archive(tiny_root: Path, archive_of: Callable[..., Path]) -> Path:
    views = verified_views(open_folder(tiny_root).config(CONFIG))
    return archive_of({view_id: 1.015 * left.depth_m for view_id, left, _ in views})


@pytest.fixture
def copy(tiny_root: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(tiny_root, tmp_path / "dataset"))


def tree(folder: Path) -> dict[str, bytes | str]:
    """Return the content of all files and the targets of all links below a folder."""
    return {
        str(path.relative_to(folder)): str(path.readlink()) if path.is_symlink() else path.read_bytes()
        for path in folder.rglob("*")
        if path.is_symlink() or path.is_file()
    }


def result(archive: Path, root: Path, target: Path, *options: str) -> tuple[bytes, str]:
    """Return the result JSON of ``rebar-bench score`` and its standard error without progress."""
    finished = run_in_process(main, "score", archive, "--data", root, "--json", target, *options)
    assert finished.returncode == 0, finished.stderr
    return target.read_bytes(), "\n".join(line for line in finished.stderr.splitlines() if line[:8] == "warning:")


@pytest.mark.slow
@pytest.mark.parametrize("options", [(), ("--extended",)])
def test_changed_bytes_of_cache_never_change_results(
    tiny_root: Path,
    archive: Path,
    tmp_path: Path,
    empty_cache: Path,
    repetitions: Repetitions,
    options: tuple[str, ...],
) -> None:
    rng = np.random.default_rng(23)
    target = tmp_path / "result.json"
    expected, warnings = result(archive, tiny_root, target, *options)
    assert warnings == ""
    intact = tree(empty_cache)
    assert len(intact) == 1 + 2 * len(options)  # Extended: bars and layers, and judged crossings.
    for number in range(repetitions(12, 500)):
        path = sorted(empty_cache.iterdir())[number % len(intact)]
        content = bytearray(path.read_bytes())
        bytes_from_end = len(content) if number % 4 < 2 else min(900, len(content))  # The index is at the end.
        position = len(content) - 1 - int(rng.integers(bytes_from_end))
        content[position] ^= int(rng.integers(1, 256))
        path.write_bytes(content)
        found, warnings = result(archive, tiny_root, target, *options)
        assert found == expected, (path.name, position)
        [warning] = warnings.splitlines()
        assert path.name in warning
        assert result(archive, tiny_root, target, *options) == (expected, "")  # Written again, if it was deleted.
        assert tree(empty_cache) == intact


def test_changed_digit_of_median_is_detected(
    tiny_root: Path, archive: Path, empty_cache: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    expected = score(archive, tiny_root).to_json()
    [path] = empty_cache.iterdir()
    median_m = truth_of(tiny_root, CONFIG).traits[-1].distance_m
    content = path.read_bytes()
    digits = str(median_m).encode()
    changed = digits.replace(b"0.", b"9.", 1)
    assert content.count(digits) == 1
    assert changed != digits
    path.write_bytes(content.replace(digits, changed))
    assert score(archive, tiny_root).to_json() == expected
    assert "does not match its checksum" in capsys.readouterr().err


def test_cache_of_other_views_is_refused(tiny_root: Path, archive: Path, empty_cache: Path) -> None:
    expected = score(archive, tiny_root).to_json()
    [path] = empty_cache.iterdir()
    truth_of(tiny_root, "lattice")
    [other] = {*empty_cache.iterdir()} - {path}
    other.replace(path)
    assert score(archive, tiny_root).to_json() == expected


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
    assert len([*empty_cache.iterdir()]) == 3
    assert {path.name for path in tmp_path.iterdir()} == {"Documents", "caches"}


def test_other_views_have_an_entry_of_their_own(tiny_root: Path, copy: Path, empty_cache: Path) -> None:
    change_manifest(copy, lambda _, config: config["views"].pop(), CONFIG)
    assert len(truth_of(tiny_root, CONFIG)) == 2
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
    for path in copy.glob("lattice/*.parquet"):
        table = pq.read_table(path)
        pq.write_table(table.take(np.arange(len(table))[::-1]), path)
    for path in Path(os.environ["XDG_CACHE_HOME"]).glob("*/*"):
        path.unlink()
    truths = truth_of(copy, "lattice")
    assert tuple(truth.view_id for truth in truths) == truths.view_ids == expected


@pytest.mark.usefixtures("empty_cache")
def test_infinite_depth_of_scored_pixel_names_view(copy: Path) -> None:
    change_depth(copy, lambda depth_m: np.where(depth_m > 0, np.float32(np.inf), depth_m))
    with pytest.raises(DatasetError, match=rf"view {CONFIG}/\d+: left_depth is damaged"):
        truth_of(copy, CONFIG)


@pytest.mark.usefixtures("empty_cache")
def test_grid_that_differs_from_images_names_view(copy: Path) -> None:
    def turn(_: object, config: dict[str, Any]) -> None:
        config["rig"] |= {"width": GRID[0], "height": GRID[1]}  # The number of pixels stays.

    change_manifest(copy, turn, CONFIG)
    with pytest.raises(DatasetError, match=rf"view {CONFIG}/\d+: left_depth is damaged: its size"):
        truth_of(copy, CONFIG)


def change_depth(root: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Change the left depth of all views of a config, and their digests in the manifest."""
    digests: dict[str, str] = {}
    views = {view_id: left for view_id, left, _ in verified_views(open_folder(root).config(CONFIG))}
    for path in root.glob(f"{CONFIG}/*.parquet"):
        table = pq.read_table(path)
        rows = table.to_pylist()
        for row in rows:
            depth_m = change(decode("depth", row["left_depth"], GRID))
            row["left_depth"] = encode_depth(depth_m)
            left = views[row["view_id"]]
            digests[row["view_id"]] = EyeTruth(left.camera, None, depth_m, left.mask, left.bars).digest()
        pq.write_table(pa.Table.from_pylist(rows, table.schema), path)
    change_manifest(
        root, lambda _, config: [view.update(left=digests[view["view_id"]]) for view in config["views"]], CONFIG
    )


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
