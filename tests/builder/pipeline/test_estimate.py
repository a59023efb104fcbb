"""``--dry-run``: views, disk space and memory of a build on new, resumed and finished folders."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from dataset_builder.specs.config_specs import QUALITIES
from tests.building import TINY, TWO_BARS, RunBuild, contents

SMALL = ("--scene", str(TWO_BARS), "--views", "9", *TINY)


def test_dry_run_prints_views_space_and_memory(tmp_path: Path, run_build: RunBuild) -> None:
    root = tmp_path / "new" / "dataset"
    process = run_build("--out", root, *SMALL, "--dry-run")
    assert process.returncode == 0, process.stderr
    assert "two-bars: 9 views of two pictures, 160 x 90" in process.stdout
    assert "9 to render (18 pictures), 0 already rendered" in process.stdout
    assert f"steel_samples {QUALITIES['preview'].steel_samples}" in process.stdout
    memory = re.search(r"memory: about ([\d.]+) ([MG])B in each", process.stdout)
    assert memory
    assert 200 < float(memory[1]) * (1000 if memory[2] == "G" else 1) < 5000
    assert re.search(r"disk space: [\d.]+ MB needed, [\d.]+ [GT]B free", process.stdout)
    assert not any(tmp_path.iterdir())


def test_dry_run_of_mesh_and_variant_writes_nothing(tiny_root: Path, tmp_path: Path, run_build: RunBuild) -> None:
    mesh = ("--mesh", tiny_root / "meshes" / "lattice.ply", "--mesh-unit", "m")
    options = ("--config", "lattice", "--variant", "dusk", "--views", "2", *TINY)
    process = run_build("--out", tmp_path / "dataset", *mesh, *options, "--dry-run", "--workers", "2")
    assert process.returncode == 0, process.stderr
    assert "lattice-dusk: 2 views" in process.stdout
    assert not any(tmp_path.iterdir())


def test_dry_run_of_resumed_and_finished_builds_changes_nothing(tmp_path: Path, run_build: RunBuild) -> None:
    root = tmp_path / "dataset"
    views = ("--scene", str(TWO_BARS), "--views", "2", *TINY)
    assert run_build("--out", root, *views).returncode == 0
    before = contents(root)
    process = run_build("--out", root, *views, "--dry-run")
    assert process.returncode == 0, process.stderr
    assert "up to date" in process.stdout
    assert "0 of 2 views to render" in process.stdout
    assert contents(root) == before
    assert {path.name for path in root.iterdir() if path.name.startswith(".")} == set()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--cluster", "tcp://127.0.0.1:1"), "no dask scheduler responds"),
        (("--config", "tower"), "tower"),
        (("--scene", "missing.toml"), "missing.toml"),
        (("--width", "2"), "--width: got 2"),
    ],
)
def test_dry_run_refuses_what_a_build_refuses(
    tmp_path: Path, run_build: RunBuild, options: tuple[str, ...], message: str
) -> None:
    process = run_build("--out", tmp_path / "dataset", *options, "--dry-run")
    assert process.returncode == 2
    assert message in process.stderr
    assert "Traceback" not in process.stderr
    assert not any(tmp_path.iterdir())


def test_dry_run_refuses_a_folder_that_cannot_be_built_in(tmp_path: Path, run_build: RunBuild) -> None:
    (tmp_path / "file").write_text("mine")
    for root in (tmp_path, tmp_path / "file", tmp_path / "file" / "below"):
        process = run_build("--out", root, *SMALL, "--dry-run")
        assert process.returncode == 2, process.stdout
        assert "Traceback" not in process.stderr
        assert str(root) in process.stderr
    assert (tmp_path / "file").read_text() == "mine"


UNPRIVILEGED = """
import os, sys
from pathlib import Path
from dataset_builder.pipeline.folder import check_target
from rebar_depth_bench.base.errors import OutputError

if os.geteuid() == 0:
    os.setgroups([])
    os.setgid(65534)
    os.setuid(65534)
try:
    check_target(Path(sys.argv[1]), {"pile"})
except OutputError as error:
    sys.exit(str(error))
"""


@pytest.mark.parametrize("mode", [0o555, 0o000])
@pytest.mark.slow
def test_folder_without_permission_is_refused_before_the_start(tmp_path: Path, mode: int) -> None:
    folder = tmp_path / "folder"
    folder.mkdir(mode=mode)
    for root in (folder, folder / "a" / "dataset"):
        process = subprocess.run(
            [sys.executable, "-c", UNPRIVILEGED, str(root)],
            capture_output=True,
            text=True,
            check=False,
        )
        assert f"{root}: cannot be written" in process.stderr
        assert "Traceback" not in process.stderr
