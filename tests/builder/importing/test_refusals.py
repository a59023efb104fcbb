"""Refusals of ``rebar-build import``, and of imported folders that contradict themselves."""

from __future__ import annotations

import json
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import rebar_depth_bench as rdb
from dataset_builder.cli.main import main
from dataset_builder.importing.config_import import plan_import, run_import
from dataset_builder.pipeline.retained import Finished
from rebar_depth_bench.base.errors import DatasetError, InputError
from rebar_depth_bench.data.manifest import open_folder
from tests.builder.importing import source_data as data
from tests.builder.importing.source_data import NAMES
from tests.damage import change_rows

Entry = dict[str, Any]


def refused(layout: Path, out: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """Return the message of a refused import."""
    assert main(["import", str(layout), "--out", str(out), "--config", "mock-up"]) == 2
    message = capsys.readouterr().err
    assert "Traceback" not in message
    assert not (out / "manifest.json").exists()
    return message


@pytest.mark.parametrize(
    ("old", "new", "code", "where"),
    [
        ("truth_sigma_m = 0.001\n", "", "missing", "truth_sigma_m"),
        ("truth_sigma_m = 0.001", "truth_sigma_m = 0", "invalid", "truth_sigma_m"),
        ("[files]", "[file]", "unknown", "file"),
        ('"depth/{view}_left.npy"', '"depth/left.npy"', "invalid", "files.left_depth"),
        ('"depth/{view}_left.npy"', '"../{view}.npy"', "invalid", "files.left_depth"),
        ('"depth/{view}_left.npy"', '"/etc/{view}.npy"', "invalid", "files.left_depth"),
        ('"depth/{view}_left.npy"', '"depth/{view}_{view}.npy"', "invalid", "files.left_depth"),
        ('right_depth = "depth/{view}_right.npy"\n', "", "conflict", "files"),
        ('left_rgb = "left/{view}.png"\n', "", "conflict", "files"),
        ("[poses]", "[depth]\nkind = 'depth'\n[poses]", "invalid", "depth.kind"),
        ("[poses]", "[depth]\nunit = 'mm'\nscale = 1\n[poses]", "conflict", "depth"),
        ("[poses]", "[depth]\nunit = 'mm'\nkind = 'disparity'\n[poses]", "conflict", "depth"),
        ("[bars]", "[masks]\nvalues = 255\n[bars]", "invalid", "masks.values"),
        ('\n[poses]\nfile = "poses/{view}.txt"\n', "", "conflict", ""),
        ('"bars.csv"', '"../bars.csv"', "invalid", "bars.file"),
        ('"bars.csv"', '"~/bars.csv"', "invalid", "bars.file"),
        ('"bars.csv"', '""', "invalid", "bars.file"),
        ("[poses]", "[intrinsics]\nfile = 'k/{view}.txt'\n[poses]", "conflict", ""),
    ],
)
def test_invalid_layout_is_refused_with_its_key(old: str, new: str, code: str, where: str, tmp_path: Path) -> None:
    layout = data.write_layout(tmp_path)
    text = layout.read_text()
    assert old in text
    layout.write_text(text.replace(old, new))
    with pytest.raises(InputError) as caught:
        plan_import(layout, "mock-up")
    assert (code, where) in [(problem.code, problem.where) for problem in caught.value.problems]


def test_disparity_is_refused_beside_intrinsics_of_each_view(tmp_path: Path) -> None:
    tables = "\n[intrinsics]\nfile = 'k/{view}.txt'\n[depth]\nkind = 'disparity'\n"
    with pytest.raises(InputError, match="got intrinsics of each view and disparity, expected one calibration"):
        plan_import(data.write_layout(tmp_path, ("left_depth", "left_rgb"), tables=tables), "mock-up")


def test_invalid_cameras_are_refused_with_their_key(folder: Path) -> None:
    layout = data.write_layout(folder)
    layout.write_text(layout.read_text().replace("cx = 79.5", "cx = 790"))
    with pytest.raises(InputError, match=r"cameras\.left\.cx: got 790"):
        plan_import(layout, "mock-up")


@pytest.mark.parametrize("name", ["lattice", "meshes", "Mock-Up", "a/b", "", "..", "cages x", "a" * 64, "a" * 201])
def test_name_that_is_no_config_is_refused(name: str, folder: Path) -> None:
    with pytest.raises(InputError, match="--config"):
        plan_import(data.write_layout(folder), name)


FIRST, SECOND, THIRD = NAMES
INVALID_FILES: dict[str, tuple[str, bytes | str | None]] = {
    "missing image": (f"right/{SECOND}.png", None),
    "image of another size": (f"right/{SECOND}.png", data.png(np.zeros((45, 80, 3), np.uint8))),
    "empty image": (f"left/{FIRST}.png", b""),
    "depth of another size": (f"depth/{THIRD}_left.npy", data.npy(np.ones((45, 80), np.float32))),
    "pickle": (f"depth/{THIRD}_left.npy", pickle.dumps(np.ones((90, 160)))),
    "array of objects": (f"depth/{THIRD}_left.npy", data.npy(np.full((90, 160), None))),
    "pointer of git LFS": (
        f"depth/{THIRD}_left.npy",
        b"version https://git-lfs.github.com/spec/v1\noid sha256:4d4d\nsize 12\n",
    ),
    "device": (f"depth/{FIRST}_left.npy", "/dev/zero"),
    "mask in colour": (f"mask/{FIRST}_left.png", data.png(np.zeros((90, 160, 3), np.uint8))),
    "ids beside the steel": (f"mask/{FIRST}_left.png", data.png(np.zeros((90, 160), np.uint8))),
    "sheared pose": (f"poses/{FIRST}.txt", b"1 0.1 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"),
    "mirrored pose": (f"poses/{FIRST}.txt", b"1 0 0 0\n0 -1 0 0\n0 0 1 0\n0 0 0 1\n"),
    "short pose": (f"poses/{FIRST}.txt", b"1 2 3\n"),
}
"""File and its content: bytes, the target of a link, or None for no file, by what is invalid."""


@pytest.mark.parametrize(("name", "content"), INVALID_FILES.values(), ids=INVALID_FILES)
def test_invalid_file_is_refused_and_named(
    name: str, content: bytes | str | None, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    layout = data.write_layout(folder)
    (folder / name).unlink()
    if isinstance(content, bytes):
        (folder / name).write_bytes(content)
    elif content is not None:
        (folder / name).symlink_to(content)
    message = refused(layout, tmp_path / "out", capsys)
    assert any(view in message for view in NAMES) or "left_bars" in message


@pytest.mark.parametrize(
    ("column", "suffix", "values"),
    [
        ("left_rgb", ".jpg", np.zeros((90, 160, 3), np.uint8)),
        ("right_rgb", ".png", np.zeros((90, 160, 3), np.uint8)),
        ("left_depth", ".tif", np.ones((90, 160), np.float32)),
        ("left_depth", ".png", np.ones((90, 160), np.uint16)),
        ("left_mask", ".png", np.ones((90, 160), np.uint8)),
        ("left_bars", ".tiff", np.ones((90, 160), np.uint16)),
    ],
)
def test_turned_picture_is_refused(
    column: str, suffix: str, values: np.ndarray, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Check pictures with tag 274 (Orientation) of EXIF or TIFF 6.0: 3, turned by half, keeps the size."""
    exif = Image.Exif()
    exif[274] = 3
    for view in NAMES:
        path = folder / f"turned/{view}{suffix}"
        path.parent.mkdir(exist_ok=True)
        Image.fromarray(values).save(path, exif=exif)
    layout = data.write_layout(folder, files={column: f"turned/{{view}}{suffix}"})
    message = refused(layout, tmp_path / "out", capsys)
    assert f"{FIRST}{suffix}: the EXIF orientation is 3: viewers turn the pixels, expected 1, as the" in message


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


@pytest.fixture
def root(one_camera: Path, tmp_path: Path) -> Path:
    """Return a copy of an imported folder without most columns, which a test may change."""
    return Path(shutil.copytree(one_camera, tmp_path / "copy"))


CONTRADICTIONS: Entry = {
    "left_mask": {"bytes": data.png(np.ones((90, 160), np.uint8)), "path": None},
    "right_K": np.eye(3).tolist(),
    "baseline_m": 0.1,
    "left_depth": None,
    "left_rgb": None,
    "left_K": np.full((3, 3), np.nan).tolist(),
}
"""Values of columns that are absent in the manifest, and none of columns that are present."""


@pytest.mark.parametrize(("column", "value"), CONTRADICTIONS.items(), ids=CONTRADICTIONS)
def test_row_that_contradicts_the_manifest_is_refused(column: str, value: object, root: Path) -> None:
    for path in root.glob("mock-up/*.parquet"):
        change_rows(path, lambda rows: [row.update({column: value}) for row in rows])
    with pytest.raises(DatasetError, match=r"mock-up/0000: \w+ is damaged"):
        list(rdb.load(root, "mock-up"))


def set_imported(key: str, value: object) -> Callable[[Entry], None]:
    return lambda entry: entry["imported"].update({key: value})


def set_view(key: str, value: object) -> Callable[[Entry], None]:
    return lambda entry: entry["views"][0].update({key: value})


ALL_BUT_BARS = ["left_mask", "right_mask", "right_bars", "right_depth", "right_rgb", "right_K"]


@pytest.mark.parametrize(
    ("change", "where"),
    [
        (lambda entry: entry.pop("imported"), "scenes"),
        (set_imported("truth_sigma_m", 0), "imported.truth_sigma_m"),
        (set_imported("truth_sigma_m", None), "imported.truth_sigma_m"),
        (set_imported("absent_columns", ["left_depth"]), "imported.absent_columns"),
        (set_imported("absent_columns", ["left_K"]), "imported.absent_columns"),
        (set_imported("absent_columns", ALL_BUT_BARS), "imported.absent_columns"),
        (set_imported("absent_columns", []), "views"),
        (set_view("steel_px", 5), "views"),
        (set_view("right", "0" * 64), "views"),
        (set_view("left", None), "views 1: left"),
    ],
)
def test_manifest_that_contradicts_itself_is_refused(
    change: Callable[[Entry], Any], where: str, root: Path
) -> None:
    path = root / "manifest.json"
    manifest = json.loads(path.read_bytes())
    change(manifest["configs"]["mock-up"])
    path.write_text(json.dumps(manifest))
    with pytest.raises(DatasetError) as caught:
        open_folder(root)
    assert f"configs.mock-up.{where}" in [problem.where for problem in caught.value.problems]
