"""Export for Ultralytics: files, types and data file as its ``DepthDataset`` reads them, resumption, refusals."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

import rebar_depth_bench as rdb
from dataset_builder.cli.main import main
from dataset_builder.export import export
from rebar_depth_bench.base.errors import InputError
from tests.damage import change_manifest
from tests.synthetic_dataset import write_split_dataset

SCENES = {"a": "train", "b": "train", "c": "validation", "d": "test"}
VIEWS = 2
EYES = ("left", "right")


@pytest.fixture(scope="module")
def scenes_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder whose config ``cages`` has four scenes."""
    folder = tmp_path_factory.mktemp("scenes") / "dataset"
    write_split_dataset(folder, SCENES, VIEWS)
    return folder


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def pairs(folder: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return image and depth of a folder of images by file name, found as ``DepthDataset`` does."""
    assert folder.is_dir()
    found = {}
    for path in folder.iterdir():
        depth = folder.parent / "depth" / path.name
        assert not depth.is_file(), "PNG is preferred, as depth in millimetres"
        with Image.open(path) as image:
            found[path.stem] = np.asarray(image), np.load(depth.with_suffix(".npy"), allow_pickle=False)
    return found


def assert_equal_to_rows(
    found: dict[str, tuple[np.ndarray, np.ndarray]], rows: list[dict[str, np.ndarray]]
) -> None:
    expected = {f"{row['view_id'][-4:]}_{eye}": (row, eye) for row in rows for eye in EYES}
    assert found.keys() == expected.keys()
    for name, (image, depth_m) in found.items():
        row, eye = expected[name]
        assert np.array_equal(image, row[f"{eye}_rgb"])
        assert depth_m.dtype == np.float32
        assert np.array_equal(depth_m, row[f"{eye}_depth"])


def test_data_file_names_the_views_of_each_split(
    scenes_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(scenes_root), "--out", str(tmp_path / "out"), "--format", "ultralytics"]) == 0
    assert "cages/train-a: 2 views, 8 files written, 0 kept" in capsys.readouterr().out
    to = (tmp_path / "out").rename(tmp_path / "moved")
    data = yaml.safe_load((to / "cages.yaml").read_text())
    assert data.keys() == {"train", "val", "test", "names"}, "without path, which is then the folder of the file"
    assert data["names"] == {0: "depth"}
    for key, split in {"train": "train", "val": "validation", "test": "test"}.items():
        scenes = [scene for scene in SCENES if SCENES[scene] == split]
        assert data[key] == [f"cages/{split}-{scene}/images" for scene in scenes]
        for scene, images in zip(scenes, data[key], strict=True):
            rows = [row for row in rdb.load(scenes_root, "cages", split=split) if row["scene"] == scene]
            assert_equal_to_rows(pairs(to / images), rows)
    images = 2 * VIEWS * len(SCENES)
    assert len(content(to)) == 2 * images + 2, "images, depth, cages.yaml and export.json"


def test_config_without_splits_is_validated_on_its_test_views(tiny_root: Path, tmp_path: Path) -> None:
    export(tiny_root, tmp_path, ["lattice"], file_format="ultralytics")
    data = yaml.safe_load((tmp_path / "lattice.yaml").read_text())
    assert (data["train"], data["val"], data["test"]) == ([], ["lattice/images"], ["lattice/images"])
    assert_equal_to_rows(pairs(tmp_path / "lattice/images"), list(rdb.load(tiny_root, "lattice")))


def test_data_file_names_the_folders_of_earlier_exports(scenes_root: Path, tmp_path: Path) -> None:
    export(scenes_root, tmp_path, split="train", file_format="ultralytics")
    export(scenes_root, tmp_path, split="validation")
    export(scenes_root, tmp_path, split="test", file_format="ultralytics")
    data = yaml.safe_load((tmp_path / "cages.yaml").read_text())
    assert data["train"] == ["cages/train-a/images", "cages/train-b/images"]
    assert (data["val"], data["test"]) == ([], ["cages/test-d/images"]), "without the plain export, which has EXR"


def test_interrupted_export_resumes_to_same_bytes(scenes_root: Path, tmp_path: Path) -> None:
    def interrupt(what: str, done: int, total: int) -> None:
        if (what, done) == ("export of cages/train-b", 1):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export(scenes_root, tmp_path / "out", progress=interrupt, file_format="ultralytics")
    assert not (tmp_path / "out/cages.yaml").exists()
    (tmp_path / "out/.cages.yaml.abcd_123.tmp").write_text("tr")  # As left by a kill while writing.
    summary = export(scenes_root, tmp_path / "out", file_format="ultralytics")
    assert [(part.kept, part.written) for part in summary] == [(8, 0), (4, 4), (0, 8), (0, 8)]
    export(scenes_root, tmp_path / "whole", file_format="ultralytics")
    assert content(tmp_path / "out") == content(tmp_path / "whole")


def test_unknown_format_is_refused(scenes_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["export", str(scenes_root), "--out", str(tmp_path / "out"), "--format", "coco"])
    assert stop.value.code == 2
    assert "'coco'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_config_without_colour_is_refused_before_any_file(scenes_root: Path, tmp_path: Path) -> None:
    root = shutil.copytree(scenes_root, tmp_path / "root")
    change_manifest(root, lambda _, config: config.update(colour=None), "cages")
    with pytest.raises(
        InputError, match=r"config cages was built with --no-colour, .* build it without --no-colour"
    ):
        export(root, tmp_path / "out", file_format="ultralytics")
    assert not (tmp_path / "out").exists()
