"""Builds, exports and audits on a full disk: reported with exit status 1, and finished by a later run."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from dataset_builder.cli.main import main
from dataset_builder.pipeline import build as build_module
from tests.building import TWO_BARS, contents
from tests.commands import run_in_process
from tests.small_disks import NewDisk

KIB = 1024
BUILD = ("--scene", TWO_BARS, "--views", "3", "--width", "64", "--height", "36")
MESH_KIB = 764
"""The mesh is the largest file of this build: 779 kB, which is written twice."""


@pytest.fixture(autouse=True)
def no_estimate(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let builds start on disks that are too small for them, as on one that another program fills."""
    monkeypatch.setattr(build_module, "check_space", lambda *_: None)


def _refused(finished: subprocess.CompletedProcess[str], reason: str, path: str = "") -> None:
    last = finished.stderr.splitlines()[-1]
    assert finished.returncode == 1, finished.stderr
    assert last.startswith("error: /")
    assert path in last
    assert reason in last
    assert "Traceback" not in finished.stderr
    assert "render process" not in last


@pytest.mark.usefixtures("blender")
def test_build_on_a_full_disk_is_finished_by_a_later_run(new_disk: NewDisk, tmp_path: Path) -> None:
    disk = new_disk(64 * KIB)
    root = disk.root / "dataset"
    build = ("--out", root, *BUILD, "--samples", "1")
    for size_kib, path, rows in (
        (64, "/mesh-", 0),  # the mesh
        (MESH_KIB + 60, "/passes.exr", 0),  # what Blender writes: it reports such a picture as finished
        (2 * MESH_KIB + 64, "/meshes/two-bars.ply", 3),  # publishing
    ):
        disk.resize(size_kib * KIB)
        _refused(run_in_process(main, *build), "No space left on device", path)
        assert sum("/rows/" in name for name in disk.files()) == rows
        assert not {name for name in disk.files() if name.endswith((".tmp", ".exr", "manifest.json"))}
    disk.resize(4000 * KIB)
    assert run_in_process(main, *build).returncode == 0
    assert run_in_process(main, "--out", tmp_path / "other", *BUILD, "--samples", "1").returncode == 0
    assert contents(root) == contents(tmp_path / "other")
    assert disk.files() == {f"dataset/{name}" for name in contents(root)}


def test_build_on_a_read_only_disk_is_refused(new_disk: NewDisk) -> None:
    disk = new_disk(64 * KIB)
    disk.make_read_only()
    _refused(run_in_process(main, "--out", disk.root / "dataset", *BUILD), "cannot be written")


@pytest.mark.slow
def test_export_on_a_full_disk_is_finished_by_a_later_run(
    new_disk: NewDisk, tiny_root: Path, tmp_path: Path
) -> None:
    disk = new_disk(8 * KIB)
    to = disk.root / "export"
    export = ("export", tiny_root, "--config", "lattice-orbit", "--out", to)
    for size_kib in (8, 200):
        disk.resize(size_kib * KIB)
        _refused(run_in_process(main, *export), "No space left on device", str(to))
        assert not {name for name in disk.files() if name.endswith((".tmp", "cameras.json"))}
    disk.resize(4000 * KIB)
    assert run_in_process(main, *export).returncode == 0
    assert run_in_process(main, *export[:-1], tmp_path / "other").returncode == 0
    assert contents(to) == contents(tmp_path / "other")
    disk.make_read_only()
    _refused(run_in_process(main, *export[:-1], disk.root / "new"), "Read-only file system")


@pytest.mark.usefixtures("blender")
def test_audit_on_a_full_disk_is_told_in_words(
    new_disk: NewDisk, tiny_root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = new_disk(40 * KIB)
    monkeypatch.setattr("tempfile.tempdir", str(disk.root))
    _refused(run_in_process(main, "audit", tiny_root, "--depth-views", "1"), "No space left on device")
    assert disk.files() == set()
