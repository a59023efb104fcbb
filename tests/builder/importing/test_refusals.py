"""``rebar-build import`` of invalid layouts, and of damaged or hostile files: refused, and nothing is written."""

from __future__ import annotations

import pickle
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dataset_builder.cli.main import main
from dataset_builder.importing.config_import import plan_import, run_import
from dataset_builder.pipeline.retained import Finished
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.data.manifest import open_folder
from tests.bench.damage import damaged
from tests.builder.importing import source_data as data
from tests.builder.importing.source_data import NAMES, Row

CASES = 150


@pytest.fixture(scope="module")
def rows(tiny_root: Path) -> list[Row]:
    return data.sample_rows(tiny_root)


@pytest.fixture
def folder(rows: list[Row], tiny_root: Path, tmp_path: Path) -> Path:
    return data.write_source(tmp_path / "source", rows, tiny_root)


def refused(layout: Path, out: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """Return the message of a refused import."""
    assert main(["import", str(layout), "--out", str(out), "--config", "mock-up"]) == 2
    message = capsys.readouterr().err
    assert "Traceback" not in message
    assert not (out / "manifest.json").exists()
    return message


@pytest.mark.parametrize(
    ("old", "new", "code", "where", "line"),
    [
        ("truth_sigma_m = 0.001\n", "", "missing", "truth_sigma_m", None),
        ("truth_sigma_m = 0.001", "truth_sigma_m = 0", "invalid", "truth_sigma_m", 2),
        ("[files]", "[file]", "unknown", "file", 4),
        ('"depth/{view}_left.npy"', '"depth/left.npy"', "invalid", "files.left_depth", 5),
        ('"depth/{view}_left.npy"', '"../{view}.npy"', "invalid", "files.left_depth", 5),
        ('"depth/{view}_left.npy"', '"/etc/{view}.npy"', "invalid", "files.left_depth", 5),
        ('"depth/{view}_left.npy"', '"depth/{view}_{view}.npy"', "invalid", "files.left_depth", 5),
        ('right_depth = "depth/{view}_right.npy"\n', "", "conflict", "files", 4),
        ("[poses]", "[depth]\nkind = 'depth'\n[poses]", "invalid", "depth.kind", 35),
        ("[poses]", "[depth]\nunit = 'mm'\nscale = 1\n[poses]", "conflict", "depth", 34),
        ("[poses]", "[depth]\nunit = 'mm'\nkind = 'disparity'\n[poses]", "conflict", "depth", 34),
        ("[bars]", "[masks]\nvalues = 255\n[bars]", "invalid", "masks.values", 38),
        ('\n[poses]\nfile = "poses/{view}.txt"\n', "", "conflict", "", None),
        ('"bars.csv"', '"../bars.csv"', "invalid", "bars.file", 38),
        ('"bars.csv"', '"~/bars.csv"', "invalid", "bars.file", 38),
        ('"bars.csv"', '""', "invalid", "bars.file", 38),
        ("[poses]", "[intrinsics]\nfile = 'k/{view}.txt'\n[poses]", "conflict", "", None),
    ],
)
def test_invalid_layout_is_refused_with_its_line(
    old: str, new: str, code: str, where: str, line: int | None, tmp_path: Path
) -> None:
    layout = data.write_layout(tmp_path)
    text = layout.read_text()
    assert old in text
    layout.write_text(text.replace(old, new))
    with pytest.raises(InputError) as caught:
        plan_import(layout, "mock-up")
    problem = next(one for one in caught.value.problems if one.where == where)
    assert problem.code == code
    assert problem.found.startswith(f"line {line}: " if line else "")


def test_disparity_is_refused_beside_intrinsics_of_each_view(tmp_path: Path) -> None:
    tables = "\n[intrinsics]\nfile = 'k/{view}.txt'\n[depth]\nkind = 'disparity'\n"
    with pytest.raises(InputError, match="got intrinsics of each view and disparity, expected one calibration"):
        plan_import(data.write_layout(tmp_path, ("left_depth", "left_rgb"), tables=tables), "mock-up")


def test_invalid_cameras_are_refused_with_their_line(folder: Path) -> None:
    layout = data.write_layout(folder)
    layout.write_text(layout.read_text().replace("cx = 79.5", "cx = 790"))
    with pytest.raises(InputError, match=r"cameras\.left\.cx: line \d+: got 790"):
        plan_import(layout, "mock-up")


@pytest.mark.parametrize("name", ["lattice", "meshes", "Mock-Up", "a/b", "", "..", "cages x", "a" * 64, "a" * 201])
def test_name_that_is_no_config_is_refused(name: str, folder: Path) -> None:
    with pytest.raises(InputError, match="--config"):
        plan_import(data.write_layout(folder), name)


def missing_image(folder: Path) -> None:
    (folder / f"right/{NAMES[1]}.png").unlink()


def other_size(folder: Path) -> None:
    data.write(folder / f"right/{NAMES[1]}.png", data.png(np.zeros((45, 80, 3), np.uint8)))


def other_depth_size(folder: Path) -> None:
    data.write(folder / f"depth/{NAMES[2]}_left.npy", data.npy(np.ones((45, 80), np.float32)))


def pickled(folder: Path) -> None:
    data.write(folder / f"depth/{NAMES[2]}_left.npy", pickle.dumps(np.ones((90, 160))))


def objects(folder: Path) -> None:
    data.write(folder / f"depth/{NAMES[2]}_left.npy", data.npy(np.full((90, 160), None)))


def colour_mask(folder: Path) -> None:
    data.write(folder / f"mask/{NAMES[0]}_left.png", data.png(np.zeros((90, 160, 3), np.uint8)))


def ids_beside_steel(folder: Path) -> None:
    data.write(folder / f"mask/{NAMES[0]}_left.png", data.png(np.zeros((90, 160), np.uint8)))


def sheared_pose(folder: Path) -> None:
    (folder / f"poses/{NAMES[0]}.txt").write_text("1 0.1 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")


def mirrored_pose(folder: Path) -> None:
    (folder / f"poses/{NAMES[0]}.txt").write_text("1 0 0 0\n0 -1 0 0\n0 0 1 0\n0 0 0 1\n")


def short_pose(folder: Path) -> None:
    (folder / f"poses/{NAMES[0]}.txt").write_text("1 2 3\n")


def empty_image(folder: Path) -> None:
    (folder / f"left/{NAMES[0]}.png").write_bytes(b"")


def device(folder: Path) -> None:
    (folder / f"depth/{NAMES[0]}_left.npy").unlink()
    (folder / f"depth/{NAMES[0]}_left.npy").symlink_to("/dev/zero")


@pytest.mark.parametrize(
    "damage",
    [
        *(missing_image, other_size, other_depth_size, pickled, objects, colour_mask, ids_beside_steel),
        *(sheared_pose, mirrored_pose, short_pose, empty_image, device),
    ],
)
def test_invalid_file_is_refused_and_named(
    damage: Callable[[Path], None],
    folder: Path,
    rows: list[Row],
    tiny_root: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    layout = data.write_layout(folder)
    damage(folder)
    message = refused(layout, tmp_path / "out", capsys)
    assert any(name in message for name in NAMES) or "left_bars" in message
    shutil.rmtree(folder)
    data.write_layout(data.write_source(folder, rows, tiny_root))
    run_import(plan_import(layout, "mock-up"), tmp_path / "out")  # What is repaired is imported.


@pytest.mark.parametrize(
    ("K", "words"),
    [
        ("1 2 3 4 5 6 7 8 9", "expected fx 0 cx"),
        ("0 0 79 0 87 44 0 0 1", "expected fx 0 cx"),
        ("87 1 79 0 87 44 0 0 1", "expected fx 0 cx"),
        ("9 0 79 0 9 44 0 0 1", "cannot be inverted at"),
    ],
)
def test_intrinsics_that_are_no_camera_of_the_images_are_refused(K: str, words: str, folder: Path) -> None:
    for name in NAMES:
        data.write(folder / f"k/{name}.txt", K.encode())
    tables = "\n[intrinsics]\nfile = 'k/{view}.txt'\n[depth]\nkind = 'range'\n"
    layout = data.write_layout(folder, ("left_depth", "left_rgb"), tables=tables)
    layout.write_text(layout.read_text().replace("[0, 0, 0, 0]", "[-0.1, 0, 0, 0]"))
    with pytest.raises(InputError, match=words):
        plan_import(layout, "mock-up").views.decode(NAMES[0])


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("1,x,0.01,0,0", "invalid"),
        ("0,x,0.01,0,0,0", "invalid"),
        ("1.5,x,0.01,0,0,0", "invalid"),
        ("70000,x,0.01,0,0,0", "invalid"),
        ("1,x,-0.01,0,0,0", "invalid"),
        ("1,x,nan,0,0,0", "invalid"),
        ("1,x,0.01,1e999,0,0", "invalid"),
        ("1,x,0.02,0,0,0", "conflict"),
        ("999,x,0.02,0,0,0", "invalid"),
    ],
)
def test_invalid_bars_are_refused(line: str, problem: str, folder: Path) -> None:
    with (folder / "bars.csv").open("a") as file:
        file.write(f"\n{line}\n")
    with pytest.raises(InputError, match=r"bars\.csv") as caught:
        plan_import(data.write_layout(folder), "mock-up")
    assert caught.value.problems[0].code == problem


@pytest.mark.parametrize(
    "content", [b"", b"\xff\xfe", b"a,b\n1,2\n", b'bar_id\n"', b"bar_id,diameter_m,x_m,y_m,z_m\n"]
)
def test_file_without_bars_is_refused(content: bytes, folder: Path) -> None:
    (folder / "bars.csv").write_bytes(content)
    with pytest.raises(InputError, match=r"bars\.csv"):
        plan_import(data.write_layout(folder), "mock-up")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["layout.toml", "bars.csv", *(f"{kind}" for kind in data.DEPTH_FORMATS)])
def test_damaged_file_is_refused_or_read(name: str, rows: list[Row], folder: Path, tmp_path: Path) -> None:
    """Damage one of the files many times; whatever is read has finite depth."""
    if name in data.DEPTH_FORMATS:
        suffix, keys, encode, _ = data.DEPTH_FORMATS[name]
        for view, row in zip(NAMES, rows, strict=True):
            data.write(folder / f"other/{view}{suffix}", encode(tmp_path, row))
        files, tables = {"left_depth": f"other/{{view}}{suffix}"}, f"{data.STEREO}\n[depth]\n{keys}\n"
        layout = data.write_layout(folder, ("left_depth", "left_rgb", "right_rgb"), tables=tables, files=files)
        path = folder / f"other/{NAMES[0]}{suffix}"
    else:
        layout = data.write_layout(folder)
        path = folder / name
    sound, rng, outcomes = path.read_bytes(), random.Random(name), []
    for _ in range(CASES):
        path.write_bytes(damaged(sound, rng))
        try:
            columns = plan_import(layout, "mock-up").views.decode(NAMES[0])
        except InputError:
            outcomes.append("refused")
        else:
            assert np.isfinite(columns["left_depth"]).all()
            assert (columns["left_depth"] >= 0).all()
            outcomes.append("read")
    assert set(outcomes) <= {"refused", "read"}
    assert "refused" in outcomes


def test_folder_that_is_no_dataset_is_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "photos"
    out.mkdir()
    (out / "holiday.jpg").write_bytes(b"x")
    refused(data.write_layout(folder), out, capsys)
    assert [path.name for path in out.iterdir()] == ["holiday.jpg"]


def test_rendered_config_is_not_replaced(
    tiny_root: Path, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rendered = {"mock-up": open_folder(tiny_root).config("lattice")}
    monkeypatch.setattr(Finished, "configs", rendered)
    with pytest.raises(InputError, match="config mock-up was rendered"):
        run_import(plan_import(data.write_layout(folder), "mock-up"), tmp_path / "out")
