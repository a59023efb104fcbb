"""Views of a dataset written as a capture: methods read and predict what they do for the dataset."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("cv2")

from rebar_depth_bench.captures.views import open_capture
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.methods import Views
from rebar_depth_bench.methods.run import dataset_views

STEREO = ("left_rgb", "right_rgb", "left_K", "right_K", "left_distortion", "right_distortion", "baseline_m")


def rows(views: Views, columns: Sequence[str] = STEREO) -> list[dict[str, Any]]:
    return [{**row} for row in views.rows(*columns)]


@pytest.fixture(scope="module")
def dataset_rows(tiny_root: Path) -> list[dict[str, Any]]:
    [views] = dataset_views(open_folder(tiny_root), ["lattice"], "test")
    return rows(views)


def camera_lines(row: dict[str, Any], eye: str) -> list[str]:
    """Return a camera of ``cameras.toml``; the repr of a float is read back to the same number."""
    (fx, _, cx), (_, fy, cy), _ = row[f"{eye}_K"].tolist()
    numbers = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "distortion": row[f"{eye}_distortion"].tolist()}
    return [f"[{eye}]", *(f"{key} = {value!r}" for key, value in numbers.items())]


@pytest.fixture(scope="module")
def capture(dataset_rows: list[dict[str, Any]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the parallel pairs of the dataset, their cameras and the board, and return the folder."""
    root = tmp_path_factory.mktemp("capture") / "lattice"
    for row in dataset_rows:
        for eye in ("left", "right"):
            (root / eye).mkdir(parents=True, exist_ok=True)
            path = root / eye / f"{row['view_id'].partition('/')[2]}.png"
            Image.fromarray(row[f"{eye}_rgb"]).save(path)
    first = dataset_rows[0]
    stereo = ["[stereo]", "rotation = [0, 0, 0]", f"baseline_m = {float(first['baseline_m'])!r}"]
    values = {**asdict(BoardSpec()), "dictionary": f'"{BoardSpec.dictionary}"'}
    board = ["[board]", *(f"{key} = {value}" for key, value in values.items())]
    lines = [*camera_lines(first, "left"), *camera_lines(first, "right"), *stereo, *board]
    (root / "cameras.toml").write_text("\n".join(lines))
    return root


def test_method_reads_the_same_arrays(capture: Path, dataset_rows: list[dict[str, Any]]) -> None:
    views = open_capture(capture)
    read = rows(views)
    assert len(read) == len(dataset_rows) == 9
    for one, other in zip(read, dataset_rows, strict=True):
        assert one["view_id"] == other["view_id"]
        for name in STEREO:
            assert np.array_equal(one[name], other[name]), (one["view_id"], name)
    assert not views.has_poses
    assert not views.board_is_assumed


def archive_depths(path: Path) -> list[bytes]:
    with zipfile.ZipFile(path) as archive:
        return [archive.read(name) for name in sorted(archive.namelist()) if name != "submission.json"]


@pytest.mark.slow
def test_capture_predicts_as_its_dataset_does(tiny_root: Path, capture: Path, tmp_path: Path) -> None:
    of_dataset, of_capture = tmp_path / "dataset.zip", tmp_path / "capture.zip"
    predict = ["predict", "sgbm", "--data"]
    assert main([*predict, str(tiny_root), "--config", "lattice", "--out", str(of_dataset)]) == 0
    assert main([*predict, str(capture), "--out", str(of_capture)]) == 0
    assert archive_depths(of_dataset) == archive_depths(of_capture)
    assert len(set(archive_depths(of_dataset))) == 9
    assert main(["score", str(of_capture), "--data", str(tiny_root)]) == 0
