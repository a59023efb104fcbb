"""Estimates of a build: scaling of trials, workers, and ``--dry-run`` on new, resumed and finished folders."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from dataset_builder.config.catalog import BuildRequest
from dataset_builder.config.specs import QUALITIES, ColourSpec, RigSpec
from dataset_builder.pipeline.disk_space import ConfigSpace
from dataset_builder.pipeline.estimate import ConfigEstimate, makespan, of_scenes
from dataset_builder.pipeline.trial import Trial, split_times, trial_rig
from tests.building import TINY, TWO_BARS, RunBuild, contents

SMALL = ("--scene", str(TWO_BARS), "--views", "9", *TINY)


def test_trial_scales_with_pixels_and_processes() -> None:
    trial = Trial(process_s=3.0, view_s_per_pixel=1e-4, busy_threads=2.0, pixels=10_000, memory_bytes=10**9)
    rig = RigSpec(200, 100)
    assert trial.unit_seconds(8, rig) == pytest.approx(3 + 8 * 2)
    assert trial.process_memory_bytes(rig) > trial.process_memory_bytes(RigSpec(100, 100)) == 10**9
    [spec] = BuildRequest(configs=("pile",), width=200, height=100).config_specs()
    estimate = ConfigEstimate(spec, 20, (8, 8, 4), None, trial)
    assert estimate.missing == 20
    assert estimate.seconds(1) == pytest.approx(3 * 3 + 20 * 2)
    assert estimate.seconds(2) == pytest.approx(19 + 11)
    assert estimate.seconds(100) == pytest.approx(19)
    assert estimate.cpu_seconds == pytest.approx(2 * 49)


def test_scenes_of_a_config_are_one_estimate() -> None:
    trial = Trial(process_s=3.0, view_s_per_pixel=1e-4, busy_threads=2.0, pixels=10_000, memory_bytes=10**9)
    [spec] = BuildRequest(configs=("pile",), width=200, height=100).config_specs()
    rendered = [ConfigEstimate(spec, 4, (4,), ConfigSpace(0, 100 * scene, 7, 1), trial) for scene in (1, 2)]
    config = of_scenes([ConfigEstimate(spec, 4), *rendered])
    assert (config.scenes, config.views, config.missing) == (3, 12, 8)
    assert config.space == ConfigSpace(0, 300, 14, 2)
    assert config.seconds(1) == 2 * config.seconds(2) == pytest.approx(2 * (3 + 4 * 2))
    assert of_scenes([ConfigEstimate(spec, 4)] * 2).space is None


def test_makespan_gives_the_next_task_to_the_process_that_is_free_first() -> None:
    assert makespan([5, 1, 1, 1, 4], 2) == 7
    assert makespan([], 3) == 0
    assert makespan([2.0], 10**12) == 2


def test_first_view_tells_the_constant_time() -> None:
    assert split_times(20.0, [9.0, 2.0, 3.0, 1.0]) == (12.0, 2.0)
    assert split_times(20.0, [9.0]) == (11.0, 9.0)
    assert split_times(3.0, [1.0, 2.0]) == (0.0, 2.0)


@pytest.mark.parametrize("size", [(1280, 720), (640, 360), (8192, 16), (16, 8192), (20, 20)])
@pytest.mark.parametrize("samples", [1, 64, 4096, 65_536])
def test_trial_images_are_small_and_of_the_same_shape(size: tuple[int, int], samples: int) -> None:
    [spec] = BuildRequest(
        configs=("pile",), width=size[0], height=size[1], colour=ColourSpec(steel_samples=samples)
    ).config_specs()
    rig = trial_rig(spec)
    assert 16 <= rig.width <= size[0]
    assert 16 <= rig.height <= size[1]
    assert rig.width * rig.height <= max(240 * 135 * min(1, 64 / samples) * 1.1, 16 * max(rig.width, rig.height))
    assert (rig.baseline_m, rig.grid) == (spec.rig.baseline_m, spec.rig.grid)


def test_dry_run_prints_views_space_memory_and_duration(tmp_path: Path, run_build: RunBuild) -> None:
    root = tmp_path / "new" / "dataset"
    process = run_build("--out", root, *SMALL, "--dry-run")
    assert process.returncode == 0, process.stderr
    assert "two-bars: 9 views of two pictures, 160 x 90" in process.stdout
    assert "9 to render (18 pictures), 0 already staged" in process.stdout
    assert f"steel_samples {QUALITIES['preview'].steel_samples}" in process.stdout
    memory = re.search(r"memory: ([\d.]+) ([MG])B in each", process.stdout)
    assert memory
    assert 200 < float(memory[1]) * (1000 if memory[2] == "G" else 1) < 5000
    assert re.search(r"duration: \d+ s", process.stdout)
    assert re.search(r"disk space: [\d.]+ MB needed, [\d.]+ [GT]B free", process.stdout)
    assert not any(tmp_path.iterdir())


def test_dry_run_of_mesh_and_variant_writes_nothing(tiny_root: Path, tmp_path: Path, run_build: RunBuild) -> None:
    mesh = ("--mesh", tiny_root / "meshes" / "lattice.ply", "--mesh-unit", "m")
    options = ("--config", "lattice", "--variant", "dusk", "--views", "2", *TINY)
    process = run_build("--out", tmp_path / "dataset", *mesh, *options, "--dry-run", "--workers", "2")
    assert process.returncode == 0, process.stderr
    assert "lattice-dusk: 2 views" in process.stdout
    assert "render processes: 2" in process.stdout
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
        (("--cluster", "tcp://127.0.0.1:1"), "--dry-run is combined with --cluster"),
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
from dataset_builder.config.catalog import BuildRequest
from dataset_builder.pipeline.build import plan_build
from dataset_builder.pipeline.folder import check_folder
from rebar_depth_bench.errors import OutputError

# The plans are made before, because other users may not be allowed to read this package.
plans = plan_build(BuildRequest(configs=("pile",), views=1), Path(sys.argv[2]))
if os.geteuid() == 0:
    os.setgroups([])
    os.setgid(65534)
    os.setuid(65534)
try:
    check_folder(Path(sys.argv[1]), plans)
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
            [sys.executable, "-c", UNPRIVILEGED, str(root), str(tmp_path / "other")],
            capture_output=True,
            text=True,
            check=False,
        )
        assert f"{root}: cannot be written" in process.stderr
        assert "Traceback" not in process.stderr
