"""Export folder: resumption, extension, locking, rejected targets, and folders of scenes with splits."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import rebar_depth_bench as rdb
from dataset_builder.cli.main import main
from dataset_builder.export import export
from dataset_builder.export.exporting import MARKER
from rebar_depth_bench.base.errors import DatasetError, InputError
from tests.damage import change_manifest
from tests.synthetic_dataset import write_split_dataset

SMALL_CONFIG = ("lattice-orbit",)
"""Config with two views, quick to export."""
IMAGES_PER_VIEW = 10


@pytest.fixture(scope="module")
def exported(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a complete export of the small config."""
    to = tmp_path_factory.mktemp("export") / "all"
    export(tiny_root, to, SMALL_CONFIG)
    return to


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def run_export(root: Path, to: Path, body: str) -> subprocess.CompletedProcess[str]:
    """Export in a separate process that runs ``body`` after each view."""
    code = f"""
import os, resource, signal
from dataset_builder.export import export
def progress(what, done, total):
    {body}
export({str(root)!r}, {str(to)!r}, {SMALL_CONFIG!r}, progress=progress)
"""
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.slow
def test_killed_export_resumes_to_same_bytes(tiny_root: Path, exported: Path, tmp_path: Path) -> None:
    to = tmp_path / "export"
    process = run_export(tiny_root, to, "os.kill(os.getpid(), signal.SIGKILL)")
    assert process.returncode == -signal.SIGKILL, process.stderr
    # As left by a kill while writing.
    (to / "lattice-orbit/depth/.0075_left.exr.abcd_123.tmp").write_bytes(b"half")
    (to / "lattice-orbit/bars/0025_right.png").unlink()
    (summary,) = export(tiny_root, to, SMALL_CONFIG)
    assert (summary.kept, summary.written) == (IMAGES_PER_VIEW - 1, IMAGES_PER_VIEW + 1)
    assert content(to) == content(exported)


@pytest.mark.slow
def test_write_failure_is_reported(tiny_root: Path, tmp_path: Path) -> None:
    process = run_export(tiny_root, tmp_path / "x", "resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))")
    last_line = process.stderr.splitlines()[-1]
    assert last_line.startswith(f"rebar_depth_bench.base.errors.OutputError: {tmp_path / 'x'}/")
    assert "cannot be written: " in last_line
    assert "File too large" in last_line
    assert not list((tmp_path / "x").rglob("*.tmp"))


@pytest.mark.slow
def test_export_is_extended_by_views_and_configs(tiny_root: Path, exported: Path, tmp_path: Path) -> None:
    to = tmp_path / "grown"
    progress_calls: list[tuple[object, ...]] = []
    (summary,) = export(tiny_root, to, SMALL_CONFIG, views=1, progress=lambda *step: progress_calls.append(step))
    assert (summary.config, summary.views, summary.written) == ("lattice-orbit", 1, IMAGES_PER_VIEW)
    assert progress_calls == [("export of lattice-orbit", 1, 1)]
    assert {path.stem[:4] for path in (to / "lattice-orbit/images").iterdir()} == {"0075"}
    export(tiny_root, to, SMALL_CONFIG)
    assert content(to) == content(exported)
    export(tiny_root, to, ["lattice"], views=2)
    assert {path.stem[:4] for path in (to / "lattice/images").iterdir()} == {"0140", "0364"}
    orbit_files = {name: data for name, data in content(to).items() if name.startswith("lattice-orbit/")}
    assert orbit_files == {name: data for name, data in content(exported).items() if name != MARKER}


def test_foreign_folder_is_rejected_and_unchanged(tiny_root: Path, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match=r"not empty \(it contains thesis.tex\) and has no export.json"):
        export(tiny_root, tmp_path)
    assert content(tmp_path) == {"thesis.tex": b"years of work"}
    with pytest.raises(InputError, match="is a file, expected a folder"):
        export(tiny_root, tmp_path / "thesis.tex")
    with pytest.raises(InputError, match="is inside the dataset folder"):
        export(tiny_root, tiny_root / "raw")
    assert not (tiny_root / "raw").exists()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda record: record.update(dataset="sha256:00"), "dataset sha256:00, expected sha256:"),
        (
            lambda record: record["configs"][SMALL_CONFIG[0]].update(key="0"),
            "config lattice-orbit of another build",
        ),
        (lambda record: record.update(format="rebar-depth-export-9"), "got 'rebar-depth-export-9', expected"),
    ],
    ids=["dataset", "build", "format"],
)
def test_folder_with_another_export_is_refused(
    change: Callable[[dict[str, Any]], object], words: str, tiny_root: Path, exported: Path, tmp_path: Path
) -> None:
    record = json.loads((exported / MARKER).read_text())
    change(record)
    (tmp_path / MARKER).write_text(json.dumps(record))
    with pytest.raises(InputError, match=words):
        export(tiny_root, tmp_path)
    assert set(content(tmp_path)) == {MARKER}


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "{}", '{"format": "rebar-depth-export-1", "configs": {"lattice": 3}, "dataset": "DIGEST"}'],
)
def test_damaged_record_is_rejected(tiny_root: Path, exported: Path, tmp_path: Path, text: str) -> None:
    digest = json.loads((exported / MARKER).read_text())["dataset"]
    (tmp_path / MARKER).write_text(text.replace("DIGEST", digest))
    with pytest.raises(InputError, match=r"export\.json: [13] problem"):
        export(tiny_root, tmp_path)


def test_fewer_views_than_exported_is_rejected(tiny_root: Path, exported: Path) -> None:
    words = "contains 2 views of lattice-orbit, 1 of which are not among the 1 requested"
    with pytest.raises(InputError, match=words):
        export(tiny_root, exported, SMALL_CONFIG, views=1)


def test_invalid_configs_roots_splits_and_view_counts_are_rejected(tiny_root: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no config 'latice', expected one of lattice, lattice-orbit"):
        export(tiny_root, tmp_path / "x", ["lattice", "latice"])
    with pytest.raises(InputError, match="--views is 0, expected 1 or more"):
        export(tiny_root, tmp_path / "x", views=0)
    with pytest.raises(DatasetError, match="expected a dataset folder on this machine"):
        export("someone/rebar", tmp_path / "x")
    with pytest.raises(DatasetError, match=r"has no manifest.json"):
        export(tmp_path, tmp_path / "x")
    with pytest.raises(DatasetError, match="no config has the split train"):
        export(tiny_root, tmp_path / "x", split="train")
    with pytest.raises(DatasetError, match="lattice has no split train"):
        export(tiny_root, tmp_path / "x", ["lattice"], split="train")
    assert not (tmp_path / "x").exists()


def test_folder_with_only_partial_record_counts_as_empty(tiny_root: Path, tmp_path: Path) -> None:
    (tmp_path / ".export.json.abcd_123.tmp").write_bytes(b"{")  # As left by a kill at the start.
    export(tiny_root, tmp_path, SMALL_CONFIG, views=1)
    assert not list(tmp_path.glob("*.tmp"))


def test_concurrent_export_to_same_folder_is_rejected(tiny_root: Path, tmp_path: Path) -> None:
    def second(*_: object) -> None:
        with pytest.raises(InputError, match="another export is using this folder"):
            export(tiny_root, tmp_path, SMALL_CONFIG)

    assert export(tiny_root, tmp_path, SMALL_CONFIG, views=1, progress=second)[0].written


def test_data_contradicting_manifest_is_not_exported(tiny_root: Path, tmp_path: Path) -> None:
    root = shutil.copytree(tiny_root, tmp_path / "root")
    change_manifest(root, lambda _, config: config["views"][1].update(right="0" * 64), "lattice-orbit")
    content = (root / "manifest.json").read_text()
    manifest = json.loads(content)
    with pytest.raises(DatasetError, match="lattice-orbit/0075: the right ground truth has digest"):
        export(root, tmp_path / "x", SMALL_CONFIG)
    manifest["configs"]["../../x"] = manifest["configs"]["lattice"]
    (root / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(DatasetError, match="expected a name of letters"):
        export(root, tmp_path / "y", ["../../x"])
    (root / "manifest.json").write_text(content)
    (root / "bars.parquet").write_bytes(b"no parquet")
    with pytest.raises(DatasetError, match=r"bars.parquet: the SHA-256 is"):
        export(root, tmp_path / "y", SMALL_CONFIG)


@pytest.mark.parametrize("link", ["lattice-orbit", "lattice-orbit/images", "lattice-orbit/sparse"])
def test_links_out_of_target_are_rejected_before_any_change(
    tiny_root: Path, exported: Path, tmp_path: Path, link: str
) -> None:
    to, outside = tmp_path / "to", tmp_path / "outside"
    shutil.copytree(exported, to)
    shutil.move(to / link, outside)
    (outside / ".image.png.abcd_123.tmp").write_text("mine")
    (to / link).symlink_to(outside)
    before = content(tmp_path)
    with pytest.raises(InputError, match=f"{link}: is a symbolic link"):
        export(tiny_root, to, SMALL_CONFIG)
    assert content(tmp_path) == before


def test_only_temporary_files_of_exports_are_deleted(tiny_root: Path, exported: Path, tmp_path: Path) -> None:
    to = tmp_path / "to"
    shutil.copytree(exported, to)
    own = [".export.json.abcd_123.tmp", "lattice-orbit/bars/.0025_right.png.abcd_123.tmp"]
    others = [".thesis.tmp", ".thesis.tex.abcd_123.tmp", "notes/.thesis.tex.abcd_123.tmp", "lattice-orbit/.a.tmp"]
    for name in (*own, *others):
        (to / name).parent.mkdir(exist_ok=True)
        (to / name).write_text("")
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked/.a.png.abcd_123.tmp").write_text("")
    (to / "elsewhere").symlink_to(tmp_path / "linked")
    export(tiny_root, to, SMALL_CONFIG)
    assert set(content(to)) == {*content(exported), *others}
    assert (tmp_path / "linked/.a.png.abcd_123.tmp").exists()


SCENES = {"a": "train", "b-1": "train", "c": "validation", "d": "test"}
FOLDERS = {scene: f"cages/{split}-{scene}" for scene, split in SCENES.items()}
VIEWS = 3


@pytest.fixture(scope="module")
def scenes_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes") / "dataset"
    write_split_dataset(folder, SCENES, VIEWS, families={"a": "wall"})
    return folder


@pytest.mark.slow
def test_plain_export_has_a_folder_for_each_scene(scenes_root: Path, tmp_path: Path) -> None:
    summary = export(scenes_root, tmp_path / "out")
    assert [(part.config, part.views) for part in summary] == [(name, VIEWS) for name in FOLDERS.values()]
    for scene, name in FOLDERS.items():
        folder = tmp_path / "out" / name
        cameras = json.loads((folder / "cameras.json").read_text())
        assert (cameras["config"], cameras["scene"], cameras["split"]) == ("cages", scene, SCENES[scene])
        assert cameras["parameters"].get("family") == ("wall" if scene == "a" else None)
        assert len(cameras["cameras"]) == 2 * VIEWS
        assert {path for path in content(folder) if path.startswith("images/")} == {
            f"images/{index:04d}_{eye}.png" for index in range(VIEWS) for eye in ("left", "right")
        }
        bar_points = (folder / "sparse/0/points3D.txt").read_text().splitlines()
        assert len(bar_points) > 100, "on the bar of the scene"
    for row in rdb.load(scenes_root, "cages", split="train", columns=["view_id", "left_mask", "scene"]):
        path = tmp_path / "out" / FOLDERS[row["scene"]] / f"masks/{row['view_id'][-4:]}_left.png"
        assert np.array_equal(np.asarray(Image.open(path)) > 0, row["left_mask"])


@pytest.mark.slow
def test_export_is_resumed_and_extended_by_splits(scenes_root: Path, tmp_path: Path) -> None:
    first = export(scenes_root, tmp_path / "out", split="validation", views=2)
    assert [(part.config, part.views) for part in first] == [(FOLDERS["c"], 2)]
    second = export(scenes_root, tmp_path / "out")
    assert {part.config: part.kept > 0 for part in second} == {
        name: name == FOLDERS["c"] for name in FOLDERS.values()
    }
    assert {path.split("/", 1)[0] for path in content(tmp_path / "out")} == {"cages", MARKER}
    export(scenes_root, tmp_path / "whole")
    assert content(tmp_path / "out").keys() == content(tmp_path / "whole").keys()


def test_link_in_place_of_the_folder_of_a_scene_is_refused(scenes_root: Path, tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "cages").symlink_to(outside)
    (tmp_path / "out" / MARKER).write_text("{}")
    with pytest.raises(InputError, match="is a symbolic link"):
        export(scenes_root, tmp_path / "out")
    assert not list(outside.iterdir())


@pytest.mark.slow
def test_command_exports_a_split(scenes_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["export", str(scenes_root), "--out", str(tmp_path / "out"), "--split", "train", "--views", "1"]
    assert main(command) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in lines[:2]] == [FOLDERS["a"], FOLDERS["b-1"]]
    with pytest.raises(SystemExit):
        main([*command[:-3], "hidden"])
