"""Export of configs with splits: a folder for each scene, in every layout."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import rebar_depth_bench as rdb
from dataset_builder.cli.main import main
from dataset_builder.export import export
from dataset_builder.export.target import MARKER
from rebar_depth_bench.base.errors import DatasetError, InputError
from tests.synthetic_dataset import write_dataset, write_split_dataset

SCENES = {"a": "train", "b-1": "train", "c": "validation", "d": "test"}
FOLDERS = {scene: f"cages/{split}-{scene}" for scene, split in SCENES.items()}
VIEWS = 3


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes") / "dataset"
    write_split_dataset(folder, SCENES, VIEWS, families={"a": "wall"})
    return folder


def files(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def test_plain_export_has_a_folder_for_each_scene(root: Path, tmp_path: Path) -> None:
    summary = export(root, tmp_path / "out")
    assert [(part.config, part.views) for part in summary] == [(name, VIEWS) for name in FOLDERS.values()]
    for scene, name in FOLDERS.items():
        folder = tmp_path / "out" / name
        cameras = json.loads((folder / "cameras.json").read_text())
        assert (cameras["config"], cameras["scene"], cameras["split"]) == ("cages", scene, SCENES[scene])
        assert cameras["parameters"].get("family") == ("wall" if scene == "a" else None)
        assert len(cameras["cameras"]) == 2 * VIEWS
        assert {path for path in files(folder) if path.startswith("images/")} == {
            f"images/{index:04d}_{eye}.png" for index in range(VIEWS) for eye in ("left", "right")
        }
        bar_points = (folder / "sparse/0/points3D.txt").read_text().splitlines()
        assert len(bar_points) > 100, "on the bar of the scene"
    for row in rdb.load(root, "cages", split="train", columns=["view_id", "left_mask", "scene"]):
        path = tmp_path / "out" / FOLDERS[row["scene"]] / f"masks/{row['view_id'][-4:]}_left.png"
        assert np.array_equal(np.asarray(Image.open(path)) > 0, row["left_mask"])


def test_export_is_resumed_and_extended_by_splits(root: Path, tmp_path: Path) -> None:
    first = export(root, tmp_path / "out", split="validation", views=2)
    assert [(part.config, part.views) for part in first] == [(FOLDERS["c"], 2)]
    second = export(root, tmp_path / "out")
    assert {part.config: part.kept > 0 for part in second} == {
        name: name == FOLDERS["c"] for name in FOLDERS.values()
    }
    assert {path.split("/", 1)[0] for path in files(tmp_path / "out")} == {"cages", MARKER}
    export(root, tmp_path / "whole")
    assert files(tmp_path / "out") == files(tmp_path / "whole")


def test_splits_that_do_not_exist_are_refused(root: Path, tmp_path: Path) -> None:
    write_dataset(tmp_path / "one", ["lattice"], 1)
    with pytest.raises(DatasetError, match="no config has the split train"):
        export(tmp_path / "one", tmp_path / "out", split="train")
    with pytest.raises(DatasetError, match="lattice has no split train"):
        export(tmp_path / "one", tmp_path / "out", ["lattice"], split="train")
    assert not (tmp_path / "out").exists()


def test_link_in_place_of_the_folder_of_a_scene_is_refused(root: Path, tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "cages").symlink_to(outside)
    (tmp_path / "out" / MARKER).write_text("{}")
    with pytest.raises(InputError, match="is a symbolic link"):
        export(root, tmp_path / "out")
    assert not list(outside.iterdir())


def test_command_exports_a_split(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["export", str(root), "--out", str(tmp_path / "out"), "--split", "train", "--views", "1"]
    assert main(command) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in lines[:2]] == [FOLDERS["a"], FOLDERS["b-1"]]
    with pytest.raises(SystemExit):
        main([*command[:-3], "hidden"])
