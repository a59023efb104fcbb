"""``[cameras] views`` of a layout: BOP's ``scene_camera.json``, and what is refused."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rebar_depth_bench as rdb
from dataset_builder.cli.main import main
from dataset_builder.importing.config_import import Import, plan_import, run_import
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.geometry.cameras import look_at
from tests.builder.importing import source_data as data

WIDTH, HEIGHT = 32, 24
POSES = (look_at(np.array([0.3, -1.2, 0.4]), np.zeros(3)), look_at(np.array([-0.5, -0.9, 0.7]), np.zeros(3)))
UNITS = (500 + np.arange(WIDTH * HEIGHT) % 200).reshape(HEIGHT, WIDTH).astype(np.uint16)
"""Depth maps before scaling: 500, 501, ... in the first row."""
Document = dict[str, Any]


def write_layout(
    folder: Path,
    document: object,
    names: Sequence[str] = ("000000", "000001"),
    *,
    files: Mapping[str, str] = {},
    tables: str = "",
    units: np.ndarray = UNITS,
) -> Path:
    """Write depth maps and colour of the views, the file of cameras, and a layout; return the layout."""
    patterns = {"left_depth": "depth/{view}.png", "left_rgb": "rgb/{view}.png", **files}
    for name in names:
        data.write(folder / patterns["left_depth"].replace("{view}", name), data.png(units))
        rgb = data.png(np.zeros((HEIGHT, WIDTH, 3), np.uint8))
        data.write(folder / patterns["left_rgb"].replace("{view}", name), rgb)
    (folder / "views.json").write_text(document if isinstance(document, str) else json.dumps(document))
    lines = "".join(f'{key} = "{pattern}"\n' for key, pattern in patterns.items())
    path = folder / "layout.toml"
    path.write_text(f'truth_sigma_m = 0.001\n[files]\n{lines}[cameras]\nviews = "views.json"\n{tables}')
    return path


def planned(layout: Path) -> Import:
    return plan_import(layout, "mock-up")


def bop_entry(pose: np.ndarray | None = None, fx: float = 40.0, scale: float | None = 0.1) -> Document:
    """Return an entry as ``_BopWriterUtility.get_frame_camera`` of BlenderProc writes it: K as Python lists, the
    rotation through a quaternion of float32, the translation in millimetres."""
    entry: Document = {"cam_K": [fx, 0.0, 15.5, 0.0, fx, 11.5, 0.0, 0.0, 1.0], "depth_scale": scale}
    if pose is not None:
        entry["cam_R_w2c"] = pose[:3, :3].astype(np.float32).ravel().tolist()
        entry["cam_t_w2c"] = (1000 * pose[:3, 3]).tolist()
    return {key: value for key, value in entry.items() if value is not None}


@pytest.mark.slow
def test_output_of_blenderproc_is_imported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """BlenderProc, ``write_bop``: ``rgb/000000.png``, ``depth/000000.png`` and one line for each image id."""
    entries = {0: bop_entry(POSES[0]), 1: bop_entry(POSES[1], fx=44.0, scale=1.0), 2: bop_entry(POSES[0])}
    lines = [f'  "{key}": {json.dumps(entry, sort_keys=True)}' for key, entry in entries.items()]
    layout = write_layout(tmp_path / "train_pbr", "{\n" + ",\n".join(lines) + "\n}")
    assert main(["import", str(layout), "--out", str(tmp_path / "out"), "--config", "mock-up"]) == 0
    assert "views.json: 1 of 3 entries are those of no view" in capsys.readouterr().err
    rows = list(rdb.load(tmp_path / "out", "mock-up"))
    for row, pose, fx, unit_mm in zip(rows, POSES, (40, 44), (0.1, 1.0), strict=True):
        assert row["left_depth"] == pytest.approx(UNITS * unit_mm / 1000, rel=1e-6)
        assert row["left_K"].tolist() == [[fx, 0, 15.5], [0, fx, 11.5], [0, 0, 1]]
        assert row["left_cam_from_world"] == pytest.approx(pose, abs=1e-6)
        assert not row["left_distortion"].any()
    assert open_folder(tmp_path / "out").config("mock-up").imported.has_poses  # type: ignore[union-attr]


def test_bop_without_poses_converts_range_by_the_camera_of_each_view(tmp_path: Path) -> None:
    """bop_toolkit, ``docs/bop_datasets_format.md``: poses and ``view_level`` are optional. Keys may have zeros."""
    document = {
        "000012": {**bop_entry(), "view_level": 2},
        "3": {**bop_entry(fx=20.0, scale=1.0), "elevation": 10},
    }
    source = planned(write_layout(tmp_path, document, ("12", "0003"), tables="[depth]\nkind = 'range'\n"))
    assert not source.views.has_poses
    for name, fx, unit_mm in (("12", 40.0, 0.1), ("0003", 20.0, 1.0)):
        columns = source.views.decode(name)
        ray = math.sqrt(1 + (15.5 / fx) ** 2 + (11.5 / fx) ** 2)  # Of the pixel (0, 0), whose centre is (0, 0).
        assert columns["left_depth"][0, 0] == pytest.approx(500 * unit_mm / 1000 / ray, rel=1e-6)
        assert np.array_equal(columns["left_cam_from_world"], np.eye(4))


def test_unit_of_the_layout_is_used_if_the_file_states_none(tmp_path: Path) -> None:
    document = {"0": bop_entry(scale=None), "1": bop_entry(scale=None)}
    columns = planned(write_layout(tmp_path, document, tables="[depth]\nunit = 'cm'\n")).views.decode("000000")
    assert columns["left_depth"][0, 1] == pytest.approx(5.01)


def test_other_cameras_are_other_data(tmp_path: Path) -> None:
    document = {"0": bop_entry(), "1": bop_entry()}
    run_import(planned(write_layout(tmp_path, document)), tmp_path / "out")
    document["1"] = bop_entry(scale=0.2)
    layout = write_layout(tmp_path, document)
    with pytest.raises(InputError, match="other data"):
        run_import(planned(layout), tmp_path / "out")
    run_import(planned(layout), tmp_path / "out", overwrite=["mock-up"])
    assert rdb.load(tmp_path / "out", "mock-up")[1]["left_depth"][0, 0] == pytest.approx(0.1)


def test_unknown_fields_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    layout = write_layout(tmp_path, {"0": {**bop_entry(), "shutter_speed": 3, "iso": 100}}, ("000000",))
    assert main(["import", str(layout), "--out", str(tmp_path / "o"), "--config", "mock-up", "--dry-run"]) == 0
    errors = " ".join(capsys.readouterr().err.split())
    assert "views.json: fields without a known meaning are left out: shutter_speed, iso" in errors


BOTH = {"0": bop_entry(POSES[0]), "1": bop_entry(POSES[1])}


def bop(**keys: Any) -> dict[str, Any]:
    """Return a file whose first entry has other values of ``keys``, or lacks those that are None."""
    entry = {**BOTH["0"], **keys}
    return {"0": {key: value for key, value in entry.items() if value is not None}, "1": BOTH["1"]}


REFUSED: dict[str, tuple[object, str]] = {
    "no JSON": ("0: {cam_K: [1]}", "not valid JSON"),
    "key twice": ('{"0": {}, "0": {}}', "the key 0 occurs twice"),
    "a list": ([1], "expected BOP's scene_camera.json"),
    "nothing": ({}, "expected BOP's scene_camera.json"),
    "camera.json of BOP": ({"cx": 16, "cy": 12, "depth_scale": 0.1, "fx": 40, "fy": 40}, "has the keys cx, cy"),
    "nerfstudio": ({"fl_x": 40, "frames": [{"file_path": "000000.png"}]}, "has the keys fl_x, frames"),
    "text as an entry": ({"0": "K", "1": BOTH["1"]}, "0: .*got 'K', expected a table with cam_K"),
    "view without an entry": ({"0": BOTH["0"], "7": BOTH["1"]}, "1 of 2 views have no entry, such as 000001"),
    "id with and without zeros": ({**BOTH, "01": BOTH["0"]}, "view 000001 has 2 entries: 1, 01"),
    "no K": (bop(cam_K=None), "0: .*got .* expected a table with cam_K"),
    "eight numbers": (bop(cam_K=[40, 0, 15, 0, 40, 11, 0, 0]), "0: cam_K: .*got .* expected 9 numbers"),
    "text in K": (bop(cam_K=["40", 0, 15, 0, 40, 11, 0, 0, 1]), "0: cam_K: .*expected 9 numbers"),
    "skew": (bop(cam_K=[40, 1, 15, 0, 40, 11, 0, 0, 1]), r"0: left: K is .* expected \[\[fx, 0, cx\]"),
    "K of another size": (bop(cam_K=[40, 0, 150, 0, 40, 11, 0, 0, 1]), "0: cx: .*got 150.0, expected"),
    "non-square pixels": (bop(cam_K=[40, 0, 15, 0, 60, 11, 0, 0, 1]), "images of another aspect ratio"),
    "depth_scale of 0": (bop(depth_scale=0), "0: depth_scale: .*got 0"),
    "no depth_scale": (bop(depth_scale=None), "0: depth_scale: .*missing, expected either it, or"),
    "rotation alone": (bop(cam_t_w2c=None), "0: cam_t_w2c: .*missing, expected 3 numbers"),
    "mirror": (bop(cam_R_w2c=[1, 0, 0, 0, -1, 0, 0, 0, 1]), "0: cam_R_w2c: .*expected a rotation"),
    "poses of some": (bop(cam_R_w2c=None, cam_t_w2c=None), "1 of 2 views have no pose, such as 000000"),
    "fisheye of HOT3D": (bop(cam_model={"projection_model_type": "FISHEYE624"}), "cam_model: .*undistort images"),
}
"""Content of the file, and words of the refusal, by what is wrong."""


@pytest.mark.parametrize(("document", "words"), REFUSED.values(), ids=REFUSED)
def test_file_that_states_no_cameras_of_the_views_is_refused(document: object, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=rf"(?s)views\.json: 1 problem.*{words}"):
        planned(write_layout(tmp_path, document))


BARS = '[bars]\nfile = "bars.csv"\n'
NO_POSES = {"0": bop_entry(), "1": bop_entry()}
CONFLICTS: dict[str, tuple[object, str, str]] = {
    "calibration": (BOTH, 'calibration = "a.yml"', "got cameras.views and cameras.calibration"),
    "left": (BOTH, "[cameras.left]\nfx = 40", "got cameras.views and cameras.left"),
    "pose": (BOTH, "[[cameras.pose]]\nimage = 'a'", "got cameras.views and cameras.pose"),
    "poses": (BOTH, '[poses]\nfile = "p/{view}.txt"', "got cameras.views and poses"),
    "intrinsics": (BOTH, '[intrinsics]\nfile = "k/{view}.txt"', "got cameras.views and intrinsics"),
    "disparity": (BOTH, "[depth]\nkind = 'disparity'", "got cameras.views and disparity"),
    "unit beside depth_scale": (BOTH, "[depth]\nunit = 'mm'", "0: depth_scale: .*given beside depth.unit"),
    "scale beside depth_scale": (BOTH, "[depth]\nscale = 0.001", "0: depth_scale: .*given beside depth.unit"),
    "bars without poses": (NO_POSES, BARS, "2 of 2 views have no pose, .* or of none in a layout without bars"),
}
"""Content of the file, lines of the layout after ``views``, and words of the refusal, by what contradicts."""


@pytest.mark.parametrize(("document", "lines", "words"), CONFLICTS.values(), ids=CONFLICTS)
def test_cameras_that_contradict_the_layout_are_refused(
    document: object, lines: str, words: str, tmp_path: Path
) -> None:
    layout = write_layout(tmp_path, document, tables=lines + "\n")
    with pytest.raises(InputError, match=f"(?s){words}"):
        planned(layout)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"views.json"', '"../views.json"', "the name of a file in or below the layout's folder"),
        ('"views.json"', "3", "cameras.views is 3, expected the name of a file"),
        ('"views.json"', '"none.json"', r"none\.json: .*cannot be read"),
        ("[cameras]", 'right_rgb = "rgb/{view}.png"\n[cameras]', "got cameras.views and a right camera"),
    ],
)
def test_layout_with_views_is_checked(old: str, new: str, words: str, tmp_path: Path) -> None:
    layout = write_layout(tmp_path, BOTH)
    layout.write_text(layout.read_text().replace(old, new))
    with pytest.raises(InputError, match=f"(?s){words}"):
        planned(layout)
