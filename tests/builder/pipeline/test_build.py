"""``rebar-build`` end to end: interruption, resumption, changed parameters and byte-identical output."""

from __future__ import annotations

import json
import os
import shutil
import signal
import time
from functools import partial
from pathlib import Path

import datasets
import numpy as np
import pytest

import rebar_depth_bench as rdb
from dataset_builder.catalog.named_configs import BuildRequest
from dataset_builder.catalog.scene_file import read_scene
from dataset_builder.pipeline.build import build
from dataset_builder.pipeline.plan import BUILD_FOLDER
from dataset_builder.specs.config_specs import colour_spec
from dataset_builder.user_files.cage_file import mesh_file_spec
from rebar_depth_bench.data.bars import read_bars
from rebar_depth_bench.data.manifest import open_folder
from tests.building import (
    TINY,
    TINY_VIEWS,
    TWO_BARS,
    RunBuild,
    StartBuild,
    contents,
    progressed_or_ended,
    render_processes_of,
    staged_rows,
)
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


@pytest.fixture(scope="module", params=[SMALL, WITHOUT_COLOUR], ids=["colour", "no colour"])
def whole_build(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, run_build: RunBuild
) -> tuple[tuple[str, ...], Path]:
    """Return the options of a build, and the folder that it makes without interruption."""
    if request.param == SMALL:
        return SMALL, request.getfixturevalue("small_root")
    root = tmp_path_factory.mktemp("no-colour") / "dataset"
    process = run_build("--out", root, *WITHOUT_COLOUR)
    assert process.returncode == 0, process.stderr
    return WITHOUT_COLOUR, root


def test_killed_builds_resume_to_same_bytes(
    whole_build: tuple[tuple[str, ...], Path],
    tmp_path: Path,
    run_build: RunBuild,
    start_build: StartBuild,
    repetitions: Repetitions,
) -> None:
    options, whole_root = whole_build
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


def test_killed_build_leaves_no_render_process(tmp_path: Path, start_build: StartBuild) -> None:
    build = start_build(tmp_path / "dataset", *SMALL)
    wait_until(lambda: render_processes_of(build.pid))
    process_dirs = [Path(f"/proc/{pid}") for pid in render_processes_of(build.pid)]
    assert all(process_dir.exists() for process_dir in process_dirs)
    os.kill(build.pid, signal.SIGKILL)
    build.communicate()
    wait_until(lambda: not any(process_dir.exists() for process_dir in process_dirs))
    assert not any(process_dir.exists() for process_dir in process_dirs)


def test_worker_count_does_not_change_bytes(
    whole_build: tuple[tuple[str, ...], Path], tmp_path: Path, run_build: RunBuild
) -> None:
    options, whole_root = whole_build
    root = tmp_path / "dataset"
    process = run_build("--out", root, *options, "--workers", "2")
    assert process.returncode == 0, process.stderr
    assert contents(root) == contents(whole_root)


def test_second_build_is_up_to_date(small_root: Path, run_build: RunBuild) -> None:
    before = contents(small_root)
    mtimes_ns = {path: path.stat().st_mtime_ns for path in small_root.rglob("*.parquet")}
    process = run_build("build", "--out", small_root, *SMALL)
    assert "up to date: two-bars" in process.stdout
    assert contents(small_root) == before
    assert mtimes_ns == {path: path.stat().st_mtime_ns for path in small_root.rglob("*.parquet")}


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


def test_rebuild_with_other_size_invalidates_cache(tmp_path: Path, run_build: RunBuild) -> None:
    root = tmp_path / "dataset"
    small = ("--scene", str(TWO_BARS), "--views", "2", "--samples", "1", "--overwrite", "two-bars")
    assert run_build("--out", root, *small, "--width", "96", "--height", "54").returncode == 0
    first = datasets.load_dataset(str(root), "two-bars", split="test")
    assert first[0]["left_rgb"].size == (96, 54)
    old_shards = set(root.glob("two-bars/*.parquet"))
    assert run_build("--out", root, *small, "--width", "64", "--height", "36").returncode == 0
    second = datasets.load_dataset(str(root), "two-bars", split="test")
    assert second[0]["left_rgb"].size == (64, 36)
    assert rdb.load(root, "two-bars")[1]["left_depth"].shape == (36, 64)
    assert not old_shards & set(root.glob("two-bars/*.parquet"))


def test_mesh_import_of_lattice_reproduces_ground_truth(
    tiny_root: Path, tmp_path: Path, run_build: RunBuild
) -> None:
    mesh = tiny_root / "meshes" / "lattice.ply"
    views = ("--config", "lattice", "--views", "3", *TINY)  # Three of the nine of the sample data.
    process = run_build("--out", tmp_path / "again", *views, "--mesh", mesh, "--mesh-unit", "m")
    assert process.returncode == 0, process.stderr
    original, imported = open_folder(tiny_root), open_folder(tmp_path / "again")
    assert len(imported.config("lattice").views) == 3
    assert set(imported.config("lattice").views) <= set(original.config("lattice").views)
    assert imported.config("lattice").scene.entry["assembly"]["path"] == "lattice.ply"
    bars = (read_bars(root / "bars.parquet")["lattice"] for root in (tiny_root, tmp_path / "again"))
    for bar, imported_bar in zip(*bars, strict=True):
        assert imported_bar.bar_id == bar.bar_id
        assert imported_bar.diameter_m == pytest.approx(bar.diameter_m, rel=0.01)
        assert np.array(imported_bar.axis_m) == pytest.approx(np.array(bar.axis_m), abs=1e-4)


def test_file_of_a_scene_is_read_once(small_root: Path, tmp_path: Path) -> None:
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


def test_mesh_file_is_read_once_for_all_configs(tmp_path: Path, tiny_root: Path, blender: None) -> None:
    file = Path(shutil.copy(tiny_root / "meshes" / "lattice.ply", tmp_path))
    request = BuildRequest(("lattice", "lattice-orbit"), 1, 64, 36, None, mesh=mesh_file_spec(file, "m"))

    def remove_file(*_: object) -> None:
        file.unlink(missing_ok=True)

    summary = build(request, tmp_path / "dataset", progress=remove_file)
    assert summary.built == ["lattice", "lattice-orbit"]
    assert not file.exists()


def test_concurrent_build_is_rejected(tmp_path: Path, run_build: RunBuild, start_build: StartBuild) -> None:
    root = tmp_path / "dataset"
    build = start_build(root, *SMALL)
    try:
        wait_until(lambda: render_processes_of(build.pid))
        process = run_build("--out", root, *SMALL)
        assert process.returncode == 2
        assert "another rebar-build process is using this folder" in process.stderr
    finally:
        os.killpg(build.pid, signal.SIGKILL)
        build.communicate()


def test_config_with_other_scene_parameters_is_rejected(tiny_root: Path, run_build: RunBuild) -> None:
    process = run_build("--out", tiny_root, "--config", "lattice", *TINY, "--seed", "5", "--overwrite", "lattice")
    assert process.returncode == 2
    assert "config lattice-orbit was built with other parameters of scene 'lattice'" in process.stderr


def test_manifest_and_card_describe_dataset(tiny_root: Path) -> None:
    manifest = json.loads((tiny_root / "manifest.json").read_text())
    files = contents(tiny_root)
    del files["manifest.json"]
    assert manifest["files"] == files
    scene = manifest["configs"]["lattice"]["scenes"][0]
    assert scene["assembly"]["diameters_m"] == [0.007, 0.004]
    assert scene["generator"]["bpy"].startswith("4.5")
    assert (
        "| `lattice` | lattice | 9 of 504 | 160 x 90 | 2, 8 around steel | 0.22-0.43 m |"
        in (tiny_root / "README.md").read_text()
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--config", "latice"), "--config: got 'latice', expected one of lattice"),
        (("--views", "0"), "--views: got 0, expected 1 to"),
        (("--width", "2", "--samples", "0"), "--width: got 2, expected 16 to 8192\n  - --samples: got 0"),
        (("--quality", "high", "--samples", "4"), "--samples: not allowed with argument --quality"),
        (("--sampling", "best"), "invalid choice: 'best' (choose from 'steel-first', 'uniform')"),
        (("--workers", "0"), "--workers is 0, expected 1 or more"),
        (("--no-colour", "--samples", "4"), "--no-colour is combined with --samples 4, expected only one"),
        (
            ("--no-colour", "--quality", "high", "--sampling", "uniform", "--device", "cpu"),
            "--no-colour is combined with --sampling uniform, --quality high, --device cpu, expected only one",
        ),
        (("--config", "lattice", "audit", "ROOT"), "--config is followed by the command audit"),
        (("--views", "3", "audit", "tiny"), "unrecognized arguments: audit tiny"),
        (("--mesh", "nothing.stl"), "nothing.stl"),
        (("--mesh", __file__), "unsupported mesh file type '.py', expected"),
    ],
)
def test_invalid_options_exit_2_and_write_nothing(
    tmp_path: Path, arguments: tuple[str, ...], words: str, run_build: RunBuild
) -> None:
    root = tmp_path / "dataset"
    process = run_build("--out", root, *arguments)
    assert process.returncode == 2
    assert words in process.stderr
    assert "Traceback" not in process.stderr
    assert not root.exists()


@pytest.mark.parametrize("marker", ["notes.txt", ".build/state", "manifest.json", ".rebar-build/state"])
def test_foreign_folder_is_rejected_and_unchanged(tmp_path: Path, marker: str, run_build: RunBuild) -> None:
    foreign = [marker, "meshes/mine.ply", "lattice/test-0-of-1.parquet", ".draft.tmp"]
    for name in foreign:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("mine")
    process = run_build("--out", tmp_path, *SMALL)
    assert process.returncode == 2
    assert "Traceback" not in process.stderr
    assert sorted(
        path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()
    ) == sorted(foreign)


def test_leftovers_of_kill_after_publishing_are_repaired(small_root: Path, run_build: RunBuild) -> None:
    """Remove the staging folder of a published config and restore files that contradict the manifest."""
    before = contents(small_root)
    key = json.loads((small_root / "manifest.json").read_text())["configs"]["two-bars"]["scenes"][0]["key"]
    for name in (key[:16], "0123456789abcdef"):
        (small_root / BUILD_FOLDER / f"two-bars-{name}" / "rows").mkdir(parents=True)
    assert "up to date" in run_build("--out", small_root, *SMALL).stdout
    assert not (small_root / BUILD_FOLDER).exists()
    for name in ("README.md", "bars.parquet", "crossings.parquet"):
        (small_root / name).unlink()
        assert "up to date" in run_build("--out", small_root, *SMALL).stdout
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


def test_damaged_shard_is_rebuilt(small_root: Path, run_build: RunBuild) -> None:
    before = contents(small_root)
    shard = next(small_root.glob("two-bars/*-00001-of-*.parquet"))
    shard.write_bytes(shard.read_bytes()[:-1] + b"!")
    assert "built: two-bars" in run_build("--out", small_root, *SMALL).stdout
    assert contents(small_root) == before
