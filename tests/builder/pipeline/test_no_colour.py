"""Builds without colour: equal ground truth, null columns of colour, and what refuses or skips them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import datasets
import numpy as np
import pytest
from PIL import Image

import rebar_depth_bench as rdb
from dataset_builder.audit import audit
from dataset_builder.export import export
from dataset_builder.pipeline.contact_sheet import TILE_PX
from rebar_depth_bench.base.errors import DatasetError
from rebar_depth_bench.cli.main import main as rebar_bench
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.rows import ConfigViews
from rebar_depth_bench.data.schema import COLUMNS
from tests.building import TINY, TINY_VIEWS, RunBuild
from tests.commands import run_in_process

SIZE = TINY[:4]
COLOUR_COLUMNS = ("left_rgb", "right_rgb")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory, run_build: RunBuild) -> Path:
    """Return a build without colour of the sample data, in the folder's own copy."""
    root = tmp_path_factory.mktemp("no-colour") / "dataset"
    for config, views in (("lattice", TINY_VIEWS), ("lattice-orbit", 2)):
        process = run_build("--out", root, "--config", config, "--views", str(views), *SIZE, "--no-colour")
        assert process.returncode == 0, process.stderr
    return root


def bench(*arguments: str | Path) -> str:
    process = run_in_process(rebar_bench, *arguments)
    assert process.returncode == 0, process.stderr
    return process.stdout


def test_ground_truth_equals_that_of_build_with_colour(root: Path, tiny_root: Path) -> None:
    without, with_colour = open_folder(root), open_folder(tiny_root)
    assert without.digest == with_colour.digest
    assert without.files["meshes/lattice.ply"] == with_colour.files["meshes/lattice.ply"]
    assert without.files["bars.parquet"] == with_colour.files["bars.parquet"]
    for name, config in without.config_by_name.items():
        assert config.manifest_entry["colour"] is None
        assert config.key != with_colour.config(name).key
        assert config.references == with_colour.config(name).references


def test_plain_datasets_loads_null_colour(root: Path) -> None:
    rows = datasets.load_dataset(str(root), "lattice", split="test")
    assert rows.column_names == list(COLUMNS)
    assert [row[column] for row in rows for column in COLOUR_COLUMNS] == [None] * 2 * TINY_VIEWS
    assert all(row["left_preview"].size == (160, 90) and row["left_mask"].size == (160, 90) for row in rows)


@pytest.mark.parametrize("streaming", [False, True])
def test_rows_and_batches_have_no_colour_and_equal_others(root: Path, tiny_root: Path, streaming: bool) -> None:
    rows, others = rdb.load(root, "lattice", streaming=streaming), rdb.load(tiny_root, "lattice")
    for row, other in zip(rows, others, strict=True):
        assert list(row) == list(other)
        assert row["left_rgb"] is row["right_rgb"] is None
        assert all(np.array_equal(row[name], other[name]) for name in COLUMNS if name not in COLOUR_COLUMNS)
    torch_loader = pytest.importorskip("rebar_depth_bench.data.torch").torch_loader
    batch = next(iter(torch_loader(rows, batch_size=2, stereo=True)))
    assert not {"rgb", "right_rgb"} & set(batch)
    assert batch["depth"].shape == batch["right_depth"].shape == (2, 1, 90, 160)


def test_archive_has_same_scores_as_with_colour(root: Path, tiny_root: Path, tmp_path: Path) -> None:
    for method in ("truth", "noisy-truth", "constant"):
        archive, report = tmp_path / f"{method}.zip", tmp_path / f"{method}.html"
        bench("predict", method, "--data", root, "--out", archive)
        bench("check", archive, "--data", root)
        bench("score", archive, "--data", root, "--html", report)
        assert rdb.score(archive, root).to_json() == rdb.score(archive, tiny_root).to_json()
        assert "Left colour image" not in report.read_text()
        assert report.read_text().count("Ground truth</strong>") == 11
    assert "noisy-truth" in bench("table", tmp_path / "truth.zip", tmp_path / "noisy-truth.zip", "--data", root)
    bench("verify", root)


@pytest.mark.parametrize("method", ["sgbm", "board-plane", "sweep-aruco"])
def test_methods_of_colour_are_refused(root: Path, tmp_path: Path, method: str) -> None:
    archive = tmp_path / "out" / "a.zip"
    archive.parent.mkdir()
    process = run_in_process(rebar_bench, "predict", method, "--data", root, "--out", archive)
    assert process.returncode == 2
    assert f"{method} needs left_rgb" in process.stderr
    assert "config lattice was built without colour (rebar-build --no-colour)" in " ".join(process.stderr.split())
    assert list(archive.parent.iterdir()) == []


def test_method_that_asks_for_colour_later_is_refused(root: Path) -> None:
    views = ConfigViews(open_folder(root).config("lattice"))
    assert len(list(views.rows("left_depth"))) == TINY_VIEWS
    with pytest.raises(DatasetError, match="right_rgb"):
        next(views.rows("left_depth", "right_rgb"))


def test_audit_contact_sheet_and_export_have_depth_alone(root: Path, tmp_path: Path) -> None:
    checks = audit(root, depth_views=0).checks
    assert [check.name for check in checks if not check.passed] == [
        f"{name}: {skipped}"
        for name in ("lattice", "lattice-orbit")
        for skipped in ("planes of formwork", "depth compared with Cycles")
    ]
    with Image.open(root / "pictures" / "lattice-orbit.webp") as sheet:
        assert sheet.size == (2 * TILE_PX[0], TILE_PX[1])
    summary = export(root, tmp_path / "export", ["lattice-orbit"])
    assert [(config.views, config.written, config.kept) for config in summary] == [(2, 16, 0)]
    folder = tmp_path / "export" / "lattice-orbit"
    assert {path.name for path in folder.iterdir()} == {
        *("depth", "depth_mm", "masks", "bars", "cameras.json", "README.txt")
    }
    cameras = json.loads((folder / "cameras.json").read_text())["cameras"]
    assert [camera for camera in cameras if "image" in camera] == []
    assert all((folder / camera["depth"]).is_file() for camera in cameras)
    assert (
        "built without colour: images/, sparse/ and transforms.json do not exist"
        in (folder / "README.txt").read_text()
    )


@pytest.mark.parametrize(
    ("colour", "words"),
    [
        (None, r"view lattice/\d+: left_rgb is damaged"),
        ({"samples": 1}, r"view lattice/\d+: left_rgb is damaged"),
        ("none", r"configs\.lattice\.colour: "),
    ],
)
def test_manifest_that_contradicts_its_rows_is_damaged(
    root: Path, tiny_root: Path, tmp_path: Path, colour: object, words: str
) -> None:
    """Load images of a config that has none, and null of one that has."""
    copy = Path(shutil.copytree(root if isinstance(colour, dict) else tiny_root, tmp_path / "dataset"))
    manifest = json.loads((copy / "manifest.json").read_text())
    manifest["configs"]["lattice"]["colour"] = colour
    (copy / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(DatasetError, match=words):
        rdb.load(copy, "lattice")[0]
