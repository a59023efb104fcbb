"""``rebar-build`` end to end: interruption, resumption, changed parameters and byte-identical output."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import rebar_depth_bench as rdb
from dataset_builder.catalog.named_configs import BuildRequest
from dataset_builder.catalog.scene_file import read_scene
from dataset_builder.cli.main import main
from dataset_builder.pipeline.blender_process import DepthTask, _send_task, available_devices
from dataset_builder.pipeline.build import build
from dataset_builder.pipeline.plan import BUILD_FOLDER
from dataset_builder.specs.config_specs import CPU, colour_spec
from dataset_builder.user_files.cage_file import mesh_file_spec
from rebar_depth_bench.cli.demo import SAMPLE, copy_sample
from rebar_depth_bench.data.bars import read_bars
from rebar_depth_bench.data.codecs import decode
from rebar_depth_bench.data.manifest import open_folder
from tests.building import (
    TINY,
    TINY_DATASET,
    TINY_VIEWS,
    TWO_BARS,
    RunBuild,
    StartBuild,
    contents,
    progressed_or_ended,
    render_processes_of,
    staged_rows,
)
from tests.commands import run_in_process
from tests.data import orbit
from tests.data.render import render_orbit, render_sample, render_tiny
from tests.processes import wait_until
from tests.requirements import Repetitions

VIEWS = ("--scene", str(TWO_BARS), "--views", str(TINY_VIEWS))
SMALL = (*VIEWS, *TINY)
WITHOUT_COLOUR = (*VIEWS, "--width", "640", "--height", "360", "--no-colour")


@pytest.fixture(scope="module")
def small_root(tmp_path_factory: pytest.TempPathFactory, run_build: RunBuild) -> Path:
    root = tmp_path_factory.mktemp("whole") / "dataset"
    process = run_build("--out", root, *SMALL)
    assert process.returncode == 0, process.stderr
    return root


@pytest.fixture(scope="module")
def whole_without_colour(tmp_path_factory: pytest.TempPathFactory, run_build: RunBuild) -> Path:
    root = tmp_path_factory.mktemp("no-colour") / "dataset"
    process = run_build("--out", root, *WITHOUT_COLOUR)
    assert process.returncode == 0, process.stderr
    return root


def test_views_without_scored_pixels_are_named(tmp_path: Path, run_build: RunBuild) -> None:
    size = ("--width", "24", "--height", "16", "--no-colour")
    process = run_build("--out", tmp_path, "--scene", TWO_BARS, "--views", "12", *size)
    assert process.returncode == 0, process.stderr
    [config] = open_folder(tmp_path).config_by_name.values()
    empty = [view.view_id for view in config.views if view.scored_px == 0]
    assert len(empty) > 10
    note = f"{len(empty)} of 12 views have no scored pixel: {', '.join(empty[:10])}, ..."
    assert f"note: {config.name}: {note}\n" in process.stderr


@pytest.mark.parametrize(
    ("options", "whole"),
    [(SMALL, "small_root"), (WITHOUT_COLOUR, "whole_without_colour")],
    ids=["colour", "no colour"],
)
def test_killed_builds_resume_to_same_bytes(
    request: pytest.FixtureRequest,
    tmp_path: Path,
    run_build: RunBuild,
    start_build: StartBuild,
    repetitions: Repetitions,
    options: tuple[str, ...],
    whole: str,
) -> None:
    whole_root = request.getfixturevalue(whole)
    root = tmp_path / "dataset"
    rng = np.random.default_rng(11)
    for kill in range(repetitions(1, 6)):
        build = start_build(root, *options)
        staged_before = staged_rows(root)
        wait_until(partial(progressed_or_ended, root, staged_before, build))
        time.sleep(float(rng.uniform(0, 0.4)))
        if kill % 2:
            os.kill(build.pid, signal.SIGKILL)
        else:
            os.killpg(build.pid, signal.SIGKILL)
        build.communicate()
    process = run_build("--out", root, *options)
    assert process.returncode == 0, process.stderr
    assert contents(root) == contents(whole_root)
    assert not (root / BUILD_FOLDER).exists()


def test_running_build_locks_its_folder_and_leaves_no_render_process_when_killed(
    tmp_path: Path, run_build: RunBuild, start_build: StartBuild
) -> None:
    root = tmp_path / "dataset"
    build = start_build(root, *SMALL)
    try:
        wait_until(lambda: render_processes_of(build.pid))
        second = run_build("--out", root, *SMALL)
        process_dirs = [Path(f"/proc/{pid}") for pid in render_processes_of(build.pid)]
        assert [process_dir.exists() for process_dir in process_dirs] == [True]
    finally:
        os.kill(build.pid, signal.SIGKILL)
        build.communicate()
    assert second.returncode == 2
    assert "another rebar-build process is using this folder" in second.stderr
    wait_until(lambda: not any(process_dir.exists() for process_dir in process_dirs))


def test_render_process_is_retried_once_then_reported(tmp_path: Path, start_build: StartBuild) -> None:
    root = tmp_path / "dataset"
    build = start_build(root, *SMALL)
    killed: set[int] = set()
    while len(killed) < 2:
        wait_until(lambda: set(render_processes_of(build.pid)) - killed)
        for pid in set(render_processes_of(build.pid)) - killed:
            os.kill(pid, signal.SIGKILL)
            killed.add(pid)
    _, stderr = build.communicate(timeout=120)
    assert build.returncode == 1
    message = stderr.decode()
    assert "render process for two-bars views 28 to 420 died 2 times, the last time with signal SIGKILL" in message
    assert "Traceback" not in message


def test_build_survives_single_render_crash(small_root: Path, tmp_path: Path, start_build: StartBuild) -> None:
    root = tmp_path / "dataset"
    build = start_build(root, *SMALL)
    wait_until(lambda: staged_rows(root) >= 1)
    os.kill(render_processes_of(build.pid)[0], signal.SIGKILL)
    _, stderr = build.communicate(timeout=300)
    assert build.returncode == 0, stderr.decode()
    assert contents(root) == contents(small_root)


def test_two_workers_make_the_same_bytes_from_a_scene_file_that_is_read_once(
    small_root: Path, tmp_path: Path, blender: None
) -> None:
    file = Path(shutil.copy(TWO_BARS, tmp_path))
    scene = read_scene(file)
    file.unlink()
    request = BuildRequest(
        (),
        TINY_VIEWS,
        *(160, 90),
        colour_spec(None, "preview", None),
        scenes=(scene.config,),
        cages_read={scene.config.scene.assembly: scene.cage},
    )
    build(request, tmp_path / "dataset", workers=2)
    assert contents(tmp_path / "dataset") == contents(small_root)


def test_imported_mesh_of_the_lattice_is_read_once_and_reproduces_ground_truth(
    tiny_root: Path, tmp_path: Path, blender: None
) -> None:
    file, root = Path(shutil.copy(tiny_root / "meshes" / "lattice.ply", tmp_path)), tmp_path / "again"
    # Three of the nine views and one of the two of the sample data.
    request = BuildRequest(("lattice", "lattice-orbit"), 3, 160, 90, None, mesh=mesh_file_spec(file, "m"))

    def remove_file(*_: object) -> None:
        file.unlink(missing_ok=True)

    assert build(request, root, progress=remove_file).built == ["lattice", "lattice-orbit"]
    assert not file.exists()
    original, imported = open_folder(tiny_root), open_folder(root)
    assert len(imported.config("lattice").views) == 3
    assert set(imported.config("lattice").views) <= set(original.config("lattice").views)
    assert imported.config("lattice").scene.entry["assembly"]["path"] == "lattice.ply"
    bars = (read_bars(folder / "bars.parquet")["lattice"] for folder in (tiny_root, root))
    for bar, imported_bar in zip(*bars, strict=True):
        assert imported_bar.bar_id == bar.bar_id
        assert imported_bar.diameter_m == pytest.approx(bar.diameter_m, rel=0.01)
        assert np.array(imported_bar.axis_m) == pytest.approx(np.array(bar.axis_m), abs=1e-4)


def test_config_with_other_scene_parameters_is_rejected(tiny_root: Path) -> None:
    options = ("--config", "lattice", *TINY, "--seed", "5", "--overwrite", "lattice")
    process = run_in_process(main, "--out", tiny_root, *options)
    assert process.returncode == 2
    assert "config lattice-orbit was built with other parameters of scene 'lattice'" in process.stderr


def test_manifest_describes_dataset(tiny_root: Path) -> None:
    manifest = json.loads((tiny_root / "manifest.json").read_text())
    files = contents(tiny_root)
    del files["manifest.json"]
    assert manifest["files"] == files
    scene = manifest["configs"]["lattice"]["scenes"][0]
    assert scene["assembly"]["diameters_m"] == [0.007, 0.004]
    assert scene["generator"]["bpy"].startswith("4.5")


def test_finished_folder_is_up_to_date_and_repaired(small_root: Path, run_build: RunBuild) -> None:
    """Remove the staging folder of a published config and restore files that a killed build has not written."""
    before = contents(small_root)
    mtimes_ns = {path: path.stat().st_mtime_ns for path in small_root.rglob("*.parquet")}
    dry_run = run_build("--out", small_root, *SMALL, "--dry-run").stdout
    assert "up to date" in dry_run
    assert "0 of 9 views to render" in dry_run
    assert {path.name for path in small_root.iterdir() if path.name.startswith(".")} == set()
    # Without a GPU, the device "auto" is the one of the build.
    device = ("--device", "auto") if set(available_devices()) == {CPU} else ()
    assert "up to date: two-bars" in run_build("build", "--out", small_root, *SMALL, *device).stdout
    assert contents(small_root) == before
    assert mtimes_ns == {path: path.stat().st_mtime_ns for path in small_root.rglob("*.parquet")}

    key = json.loads((small_root / "manifest.json").read_text())["configs"]["two-bars"]["scenes"][0]["key"]
    for name in (key[:16], "0123456789abcdef"):
        (small_root / BUILD_FOLDER / f"two-bars-{name}" / "rows").mkdir(parents=True)
    assert "up to date" in run_in_process(main, "--out", small_root, *SMALL).stdout
    assert not (small_root / BUILD_FOLDER).exists()
    for name in ("README.md", "bars.parquet", "crossings.parquet"):
        (small_root / name).unlink()
        assert "up to date" in run_in_process(main, "--out", small_root, *SMALL).stdout
        assert contents(small_root) == before


def test_folder_of_earlier_version_loads_and_gets_its_files(tiny_root: Path, tmp_path: Path) -> None:
    """Load and continue a folder of a version that did not write the crossings."""
    root = tmp_path / "older"
    shutil.copytree(tiny_root, root)
    before = contents(root)
    manifest = json.loads((root / "manifest.json").read_text())
    del manifest["files"]["crossings.parquet"], manifest["crossings"]
    (root / "manifest.json").write_text(json.dumps(manifest))
    (root / "crossings.parquet").unlink()
    assert len(rdb.load(root, "lattice-orbit")) == 2
    build(BuildRequest(("lattice-orbit",), 2, 160, 90, colour=colour_spec(quality="preview")), root)
    assert contents(root) == before


def test_process_exit_before_reading_task_raises_no_error() -> None:
    """Send a task to a dead process: a ``BrokenPipeError`` would end the build as if its output were closed."""
    with subprocess.Popen([sys.executable, "-c", ""], stdin=subprocess.PIPE) as process:
        process.wait()
        _send_task(process.stdin, DepthTask(Path("mesh.ply"), (), Path("out"), 1))
    assert process.returncode == 0


@pytest.mark.nightly
@pytest.mark.usefixtures("blender")
@pytest.mark.parametrize(("stored", "render"), [(SAMPLE, render_sample), (TINY_DATASET, render_tiny)])
def test_sample_data_equals_fresh_render(stored: Path, render: Callable[[Path], None], tmp_path: Path) -> None:
    copy_sample(stored, tmp_path / "stored")
    render(tmp_path / "rendered")
    assert contents(tmp_path / "rendered") == contents(tmp_path / "stored"), "run `make sample-data`"


@pytest.mark.nightly
@pytest.mark.usefixtures("blender")
def test_dataset_of_stored_images_equals_fresh_render(tiny_root: Path, tmp_path: Path) -> None:
    images = render_orbit(tmp_path / "rendered")
    assert set(images) == {path.name for path in orbit.IMAGES.iterdir()}, "run `make sample-data`"
    for name, image in images.items():
        stored_image = (orbit.IMAGES / name).read_bytes()
        rgb, stored_rgb = (decode("rgb", one, (288, 512)).astype(int) for one in (image, stored_image))
        differences = np.abs(rgb - stored_rgb)  # Between types of processors.
        assert differences.max() <= 1
        assert (differences > 0).mean() < 0.001
    orbit.write_orbit(tmp_path / "stored", tiny_root / "meshes" / "lattice.ply")
    rendered, stored = (open_folder(tmp_path / name).digest for name in ("rendered", "stored"))
    assert stored == rendered
