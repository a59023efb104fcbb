"""``[cameras] views`` of a layout: BOP's ``scene_camera.json``."""

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
