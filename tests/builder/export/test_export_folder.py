"""The folder an export goes to: stopped and gone on with, grown, and refused in words."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dataset_builder.export import ExportSummary, export
from rebar_depth_bench.errors import DatasetError, InputError

ORBIT = ("lattice-orbit",)
"""Two views: quick to export."""
PICTURES_A_VIEW = 10
MARKER = "export.json"


@pytest.fixture(scope="module")
def exported(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small config, exported in one go."""
    return export(tiny_root, tmp_path_factory.mktemp("export") / "all", ORBIT).folder


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def run_export(root: Path, to: Path, body: str) -> subprocess.CompletedProcess[str]:
    """Export in a process of its own; ``body`` runs after each view."""
    code = f"""
import os, resource, signal
from dataset_builder.export import export
def progress(what, done, total):
    {body}
export({str(root)!r}, {str(to)!r}, {ORBIT!r}, progress=progress)
"""
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)


def test_a_killed_export_goes_on_to_the_same_bytes(tiny_root: Path, exported: Path, tmp_path: Path) -> None:
    to = tmp_path / "export"
    finished = run_export(tiny_root, to, "os.kill(os.getpid(), signal.SIGKILL)")
    assert finished.returncode == -signal.SIGKILL, finished.stderr
    (to / "lattice-orbit/depth/.0075_left.exr.abc.tmp").write_bytes(b"half")  # as a kill within a file leaves
    (to / "lattice-orbit/bars/0025_right.png").unlink()
    (summary,) = export(tiny_root, to, ORBIT).configs
    assert (summary.kept, summary.written) == (PICTURES_A_VIEW - 1, PICTURES_A_VIEW + 1)
    assert content(to) == content(exported)


def test_a_disk_that_takes_no_more_is_told_in_words(tiny_root: Path, tmp_path: Path) -> None:
    finished = run_export(tiny_root, tmp_path / "x", "resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))")
    last = finished.stderr.splitlines()[-1]
    assert last.startswith(f"rebar_depth_bench.errors.InputError: {tmp_path / 'x'}: cannot be written: ")
    assert "File too large" in last
    assert not list((tmp_path / "x").rglob("*.tmp"))


def test_an_interrupt_leaves_no_half_file(tiny_root: Path, tmp_path: Path) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export(tiny_root, tmp_path / "x", ORBIT, progress=interrupt)
    assert not list((tmp_path / "x").rglob("*.tmp"))
    assert export(tiny_root, tmp_path / "x", ORBIT).configs[0].kept == PICTURES_A_VIEW


def test_an_export_grows_by_views_and_configs(tiny_root: Path, exported: Path, tmp_path: Path) -> None:
    to = tmp_path / "grown"
    told: list[tuple[object, ...]] = []
    few = export(tiny_root, to, ORBIT, views=1, progress=lambda *step: told.append(step))
    assert isinstance(few, ExportSummary)
    assert few.folder == to
    (summary,) = few.configs
    assert (summary.config, summary.views, summary.written) == ("lattice-orbit", 1, PICTURES_A_VIEW)
    assert told == [("export of lattice-orbit", 1, 1)]
    assert {path.stem[:4] for path in (to / "lattice-orbit/images").iterdir()} == {"0075"}
    export(tiny_root, to, ORBIT)
    assert content(to) == content(exported)
    export(tiny_root, to, ["lattice"], views=2)
    assert {path.stem[:4] for path in (to / "lattice/images").iterdir()} == {"0140", "0364"}
    whole = {name: data for name, data in content(to).items() if name.startswith("lattice-orbit/")}
    assert whole == {name: data for name, data in content(exported).items() if name != MARKER}


def edited(exported: Path, to: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """A folder that holds nothing but the changed record of an export."""
    marker = json.loads((exported / MARKER).read_text())
    change(marker)
    to.mkdir()
    (to / MARKER).write_text(json.dumps(marker))
    return to


def test_a_foreign_folder_is_left_alone(tiny_root: Path, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match=r"not empty \(it holds thesis.tex\) and has no export.json"):
        export(tiny_root, tmp_path)
    assert content(tmp_path) == {"thesis.tex": b"years of work"}
    with pytest.raises(InputError, match="is a file, expected a folder"):
        export(tiny_root, tmp_path / "thesis.tex")
    with pytest.raises(InputError, match="lies in the dataset folder"):
        export(tiny_root, tiny_root / "raw")
    assert not (tiny_root / "raw").exists()


def test_a_folder_with_half_a_record_alone_is_as_good_as_empty(tiny_root: Path, tmp_path: Path) -> None:
    (tmp_path / ".export.json.abc.tmp").write_bytes(b"{")  # as a kill at the very start leaves
    export(tiny_root, tmp_path, ORBIT, views=1)
    assert not list(tmp_path.glob("*.tmp"))


def test_the_export_needs_no_renderer() -> None:
    code = "import sys, dataset_builder.export; print(*sys.modules)"
    finished = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "dataset_builder.export.run" in finished.stdout.split()
    assert not {"bpy", "embreex", "trimesh", "pycolmap", "torch"} & set(finished.stdout.split())


def test_the_export_of_other_data_is_refused(tiny_root: Path, exported: Path, tmp_path: Path) -> None:
    other = edited(exported, tmp_path / "other", lambda marker: marker.update(dataset="sha256:00"))
    with pytest.raises(InputError, match=r"holds an export of dataset sha256:00, but .* is sha256:"):
        export(tiny_root, other)
    build = edited(
        exported, tmp_path / "b", lambda marker: marker["configs"]["lattice-orbit"].update(key="0" * 64)
    )
    with pytest.raises(InputError, match="holds config lattice-orbit of another build"):
        export(tiny_root, build)
    future = edited(exported, tmp_path / "future", lambda marker: marker.update(format="rebar-depth-export-9"))
    with pytest.raises(InputError, match="format is 'rebar-depth-export-9', expected 'rebar-depth-export-1'"):
        export(tiny_root, future)
    assert all(set(content(to)) == {MARKER} for to in (other, build, future))


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "{}", '{"format": "rebar-depth-export-1", "configs": {"lattice": 3}, "dataset": "DIGEST"}'],
)
def test_a_damaged_record_is_told_in_words(tiny_root: Path, exported: Path, tmp_path: Path, text: str) -> None:
    digest = json.loads((exported / MARKER).read_text())["dataset"]
    (tmp_path / MARKER).write_text(text.replace("DIGEST", digest))
    with pytest.raises(InputError, match="cannot be read as the record of an export"):
        export(tiny_root, tmp_path)


def test_fewer_views_than_are_there_are_refused(tiny_root: Path, exported: Path) -> None:
    with pytest.raises(
        InputError, match="holds 2 views of lattice-orbit, 1 of which are not among the 1 asked for"
    ):
        export(tiny_root, exported, ORBIT, views=1)


def test_unknown_configs_roots_and_numbers_are_told_in_words(tiny_root: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no config 'latice', expected one of lattice, lattice-orbit"):
        export(tiny_root, tmp_path / "x", ["lattice", "latice"])
    with pytest.raises(InputError, match="--views is 0, expected 1 or more"):
        export(tiny_root, tmp_path / "x", views=0)
    with pytest.raises(DatasetError, match="expected a dataset folder on this machine"):
        export("someone/rebar", tmp_path / "x")
    with pytest.raises(DatasetError, match=r"has no manifest.json"):
        export(tmp_path, tmp_path / "x")
    assert not (tmp_path / "x").exists()


def test_two_exports_do_not_share_a_folder(tiny_root: Path, tmp_path: Path) -> None:
    def second(*_: object) -> None:
        with pytest.raises(InputError, match="another export is at work there"):
            export(tiny_root, tmp_path / "x", ORBIT)

    assert export(tiny_root, tmp_path / "x", ORBIT, views=1, progress=second).configs[0].written


def test_data_that_contradict_the_manifest_are_not_exported(tiny_root: Path, tmp_path: Path) -> None:
    root = shutil.copytree(tiny_root, tmp_path / "root")
    manifest = json.loads((root / "manifest.json").read_text())
    manifest["configs"]["lattice-orbit"]["views"][1]["right"] = "0" * 64
    (root / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(DatasetError, match="lattice-orbit/0075: the right ground truth has digest"):
        export(root, tmp_path / "x", ORBIT)
    manifest["configs"]["../../x"] = manifest["configs"]["lattice"]
    (root / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(DatasetError, match="cannot be a folder's name"):
        export(root, tmp_path / "y", ["../../x"])
    (root / "bars.parquet").write_bytes(b"no parquet")
    with pytest.raises(DatasetError, match=r"bars.parquet: cannot be read"):
        export(root, tmp_path / "y", ORBIT)
