"""``rebar-build import``: data in many formats become the rows that they were made from."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import datasets
import numpy as np
import pytest
import yaml

import rebar_depth_bench as rdb
from cards.dataset import dataset_card
from dataset_builder.audit import audit
from dataset_builder.cli.main import main as build_main
from dataset_builder.importing.config_import import plan_import, run_import
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.cli.main import main as bench_main
from rebar_depth_bench.data.bars import read_bars
from rebar_depth_bench.data.manifest import DatasetConfig, open_folder
from rebar_depth_bench.geometry.cameras import inverse_rigid
from tests.builder.importing import source_data as data
from tests.builder.importing.source_data import FILES, NAMES, Row

pytestmark = pytest.mark.slow
SIZE = "width = 160\nheight = 90\n"


def imported(layout: Path, out: Path, name: str = "mock-up") -> DatasetConfig:
    run_import(plan_import(layout, name), out)
    return open_folder(out).config(name)


@pytest.fixture(scope="module")
def complete(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a dataset folder with everything imported."""
    out = tmp_path_factory.mktemp("complete") / "dataset"
    imported(data.write_layout(source), out)
    return out


def test_rows_are_those_that_the_files_were_made_from(complete: Path, rows: list[Row]) -> None:
    read = list(rdb.load(complete, "mock-up"))
    assert [row["view_id"] for row in read] == [f"mock-up/{n:04d}" for n in range(len(NAMES))]
    for row, expected in zip(read, rows, strict=True):
        for name in (*FILES, "left_K", "right_K", "left_distortion", "right_distortion"):
            assert np.array_equal(row[name], expected[name]), name
        for name in ("left_cam_from_world", "right_cam_from_world"):
            assert np.allclose(row[name], expected[name], rtol=0, atol=1e-12), name
        assert row["baseline_m"] == pytest.approx(expected["baseline_m"], abs=1e-12)


def test_imported_folder_is_verified_audited_and_loaded_by_plain_datasets(complete: Path, rows: list[Row]) -> None:
    assert bench_main(["verify", str(complete)]) == 0
    report = audit(complete)
    assert not report.failures
    assert [check.name for check in report.checks if check.skipped] == ["mock-up: depth against a second source"]
    loaded = datasets.load_dataset(str(complete), "mock-up", split="test")
    assert len(loaded) == len(rows)
    assert np.array_equal(np.asarray(loaded[0]["left_rgb"]), rows[0]["left_rgb"])


def test_surveyed_bars_are_in_the_table(complete: Path, tiny_root: Path) -> None:
    read, expected = (read_bars(root / "bars.parquet") for root in (complete, tiny_root))
    for bar, other in zip(read["mock-up"], expected["lattice"], strict=True):
        assert (bar.bar_id, bar.role, bar.diameter_m) == (other.bar_id, other.role, other.diameter_m)
        assert np.allclose(bar.axis_m, other.axis_m, rtol=0, atol=1e-15)


def test_uncertainty_is_beside_the_results(
    complete: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    archive = tmp_path / "a.zip"
    with rdb.SubmissionWriter(archive, method="exact") as writer:
        for row in rdb.load(complete, "mock-up"):
            writer.add(row["view_id"], row["left_depth"])
    result, page = tmp_path / "r.json", tmp_path / "r.html"
    outputs = ["--json", str(result), "--html", str(page)]
    assert bench_main(["score", str(archive), "--data", str(complete), "--extended", *outputs]) == 0
    table = json.loads(result.read_bytes())["tables"]["mock-up"]
    assert (table["truth_sigma_m"], table["rank_error"]) == (0.001, 0.0)
    assert "standard deviation of 1 mm" in " ".join(capsys.readouterr().out.split())
    assert "standard deviation of 1 mm" in page.read_text()
    assert "0.001 m" in (complete / "README.md").read_text()


def test_card_states_licence_and_origin_of_each_config(complete: Path, tiny_root: Path) -> None:
    """What holds for rendered configs only is not said of imported ones."""
    own, rendered = (list(open_folder(root).config_by_name.values()) for root in (complete, tiny_root))
    text = dataset_card("1.0.0", "digest", own, {})
    header = yaml.safe_load(text.split("---")[1])
    assert header["license"] == "other"
    assert "synthetic" not in header["tags"]
    assert not {"annotations_creators", "source_datasets"} & set(header)
    assert "`mock-up`: its authors state no licence." in text
    assert not [word for word in ("Cycles", "CC BY", "Synthetic", "measured depth") if word in text]
    both = dataset_card("1.0.0", "digest", [*rendered, *own], {})
    header = yaml.safe_load(both.split("---")[1])
    assert header["license"] == "other"
    assert not {"annotations_creators", "source_datasets"} & set(header)
    assert "The configs `mock-up` were imported" in both
    assert "was measured" not in both
    assert "The rendered data: CC BY 4.0." in both


@pytest.mark.parametrize("name", data.DEPTH_FORMATS)
def test_depth_format_is_read(name: str, rows: list[Row], folder: Path, tmp_path: Path) -> None:
    tolerance_m = data.DEPTH_FORMATS[name][3]
    imported(data.write_depth_format(folder, rows, name), tmp_path / "out")
    for read, row in zip(rdb.load(tmp_path / "out", "mock-up"), rows, strict=True):
        expected = row["left_depth"]
        assert np.array_equal(read["left_depth"] > 0, expected > 0)
        assert np.abs(read["left_depth"] - expected).max() <= tolerance_m


@pytest.mark.parametrize(("table", "steel"), [("", 2), ("[masks]\nvalues = [255]\n", 1)])
def test_values_of_masks_are_steel(table: str, steel: int, folder: Path) -> None:
    values = np.zeros((90, 160), np.uint8)
    values[40, 50:52] = 128, 255
    data.write(folder / f"mask/{NAMES[0]}_left.png", data.png(values))
    layout = data.write_layout(folder, ("left_depth", "left_rgb", "left_mask"), tables=f"\n{table}")
    assert np.count_nonzero(plan_import(layout, "mock-up").views.decode(NAMES[0])["left_mask"]) == steel


@pytest.mark.parametrize(
    ("table", "write"),
    [
        ('file = "p/{view}.npy"', lambda row: (".npy", data.npy(row["left_cam_from_world"][:3]))),
        (
            'file = "p/{view}.npy"\nkind = "world_from_cam"\naxes = "opengl"',
            lambda row: (".npy", data.npy(data.opengl_world_from_cam(row))),
        ),
        (
            'file = "p/{view}.json"\nkey = "camera.K"\nkind = "world_from_cam"',
            lambda row: (".json", data.json_matrix(inverse_rigid(row["left_cam_from_world"]))),
        ),
    ],
)
def test_pose_convention_is_read(table: str, write: Any, rows: list[Row], folder: Path, tmp_path: Path) -> None:
    for view, row in zip(NAMES, rows, strict=True):
        suffix, content = write(row)
        data.write(folder / f"p/{view}{suffix}", content)
    layout = data.write_layout(folder, ("left_depth", "left_rgb"), tables=f"\n[poses]\n{table}\n")
    imported(layout, tmp_path / "out")
    for read, row in zip(rdb.load(tmp_path / "out", "mock-up"), rows, strict=True):
        assert np.allclose(read["left_cam_from_world"], row["left_cam_from_world"], rtol=0, atol=1e-12)


PARTS = {
    "depth only": (("left_depth",), ""),
    "one camera": (("left_depth", "left_rgb", "left_mask"), data.POSES),
    "bar ids without masks": (("left_depth", "left_rgb", "left_bars"), data.POSES + data.BARS),
    "stereo without right depth": (("left_depth", "left_rgb", "right_rgb", "left_mask"), data.STEREO),
    "stereo without colour": (("left_depth", "right_depth", "left_mask", "left_bars"), data.STEREO + data.POSES),
}


@pytest.mark.parametrize("name", PARTS)
def test_absent_parts_are_null_and_every_command_works(
    name: str, folder: Path, rows: list[Row], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    columns, tables = PARTS[name]
    layout = data.write_layout(folder, columns, tables=tables)
    if "left_rgb" not in columns:
        layout.write_text(SIZE + layout.read_text())
    out = tmp_path / "out"
    config = imported(layout, out)
    row = rdb.load(out, "mock-up")[0]
    absent = {column for column, value in row.items() if value is None}
    assert absent == config.absent_columns
    assert absent.isdisjoint(columns)
    if "left_bars" in columns:
        assert np.array_equal(row["left_mask"], rows[0]["left_mask"])
    if "left_mask" in absent:
        assert config.views[0].scored_px == np.count_nonzero(rows[0]["left_depth"] > 0)
        assert config.views[0].steel_px is None
    assert not audit(out).failures
    assert bench_main(["verify", str(out)]) == 0
    assert bench_main(["predict", "truth", "--data", str(out), "--out", str(tmp_path / "a.zip")]) == 0
    assert bench_main(["check", str(tmp_path / "a.zip"), "--data", str(out)]) == 0
    result, page = str(tmp_path / "r.json"), str(tmp_path / "r.html")
    command = ["score", str(tmp_path / "a.zip"), "--data", str(out), "--extended"]
    assert bench_main([*command, "--json", result, "--html", page]) == 0
    assert json.loads(Path(result).read_bytes())["tables"]["mock-up"]["rank_error"] == 0
    assert bench_main(["table", str(tmp_path / "a.zip"), "--data", str(out)]) == 0
    capsys.readouterr()
    if "right_rgb" not in columns:
        assert bench_main(["predict", "sgbm", "--data", str(out), "--out", str(tmp_path / "s.zip")]) == 2
        assert "right_rgb" in capsys.readouterr().err
        assert not (tmp_path / "s.zip").exists()
    assert build_main(["export", str(out), "--out", str(tmp_path / "e")]) == 2


def test_import_is_repeatable_and_keeps_other_configs(
    source: Path, complete: Path, tiny_root: Path, tmp_path: Path
) -> None:
    out = Path(shutil.copytree(tiny_root, tmp_path / "out"))
    before = {path: path.read_bytes() for path in (out / "lattice").iterdir()}
    layout = data.write_layout(source)
    imported(layout, out)
    assert {path: path.read_bytes() for path in (out / "lattice").iterdir()} == before
    shards = {path.name: path.read_bytes() for path in (out / "mock-up").iterdir()}
    assert shards == {path.name: path.read_bytes() for path in (complete / "mock-up").iterdir()}
    files = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    imported(layout, out)
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == files
    for name in ("lattice-orbit", "bars"):
        with pytest.raises(InputError, match=f"--config is {name}, expected .* none of .*{name}"):
            imported(layout, out, name)


def test_interrupted_import_is_continued_to_the_same_bytes(source: Path, complete: Path, tmp_path: Path) -> None:
    layout = data.write_layout(source)

    class StoppedError(Exception):
        pass

    def stop(task: str, done: int, _: int) -> None:
        if task.startswith("import") and done == 2:
            raise StoppedError

    out = tmp_path / "out"
    with pytest.raises(StoppedError):
        run_import(plan_import(layout, "mock-up"), out, stop)
    assert not (out / "manifest.json").exists()
    imported(layout, out)
    expected = {path.relative_to(complete): path.read_bytes() for path in complete.rglob("*") if path.is_file()}
    assert {path.relative_to(out): path.read_bytes() for path in out.rglob("*") if path.is_file()} == expected


def test_dry_run_writes_nothing(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    layout = data.write_layout(source, ("left_depth", "left_rgb"), tables="")
    out = tmp_path / "out"
    assert build_main(["import", str(layout), "--out", str(out), "--config", "mock-up", "--dry-run"]) == 0
    printed = capsys.readouterr().out
    assert "3 views of 160 x 90" in printed
    assert "right_rgb" in printed
    assert not out.exists()


def test_streamed_rows_are_the_loaded_ones(one_camera: Path) -> None:
    loaded, streamed = rdb.load(one_camera, "mock-up"), rdb.load(one_camera, "mock-up", streaming=True)
    absent = open_folder(one_camera).config("mock-up").absent_columns
    for row, other in zip(loaded, streamed, strict=True):
        assert row.keys() == other.keys()
        for name, value in row.items():
            assert np.array_equal(value, other[name]), name
            assert (value is None) == (name in absent)


def test_torch_batches_leave_absent_parts_out(one_camera: Path) -> None:
    batch = next(iter(rdb.torch_loader(rdb.load(one_camera, "mock-up"), batch_size=2, stereo=True)))
    assert set(batch) == {"rgb", "depth", "K", "poses", "view_id"}
    assert tuple(batch["depth"].shape) == (2, 1, 90, 160)
