"""``rebar-build`` as a user runs it: kill it, continue it, change it, and the bytes stay what they must be."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import datasets
import numpy as np
import pytest

import rebar_depth_bench as rdb
from dataset_builder.build.bars_table import read_bars
from dataset_builder.build.plan import BUILD_FOLDER
from rebar_depth_bench.data.manifest import open_folder
from tests.conftest import TINY, TINY_VIEWS, run_build

pytestmark = pytest.mark.render


def contents(root: Path) -> dict[str, str]:
    """Return the SHA-256 of every file of a dataset folder, the scoring cache left out."""
    files = (path for path in root.rglob("*") if path.is_file())
    named = {path.relative_to(root).as_posix(): path for path in files}
    return {
        name: hashlib.sha256(path.read_bytes()).hexdigest()
        for name, path in named.items()
        if not name.startswith(".")
    }


def start_build(root: Path, *arguments: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "dataset_builder", "--out", str(root), *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True)


def render_processes_of(pid: int) -> list[int]:
    children = [child for task in tasks_of(pid) for child in children_of(task)]
    return [int(child) for child in children if b"dataset_builder.blender" in command_line(child)]


def tasks_of(pid: int) -> list[Path]:
    try:
        return list(Path(f"/proc/{pid}/task").iterdir())
    except OSError:
        return []  # it has ended


def children_of(task: Path) -> list[str]:
    try:
        return (task / "children").read_text().split()
    except OSError:
        return []  # threads come and go


def command_line(pid: str) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""  # it has ended


def staged_rows(root: Path) -> int:
    return len(list(root.glob(f"{BUILD_FOLDER}/*/rows/????.parquet")))


def wait_until(condition: Callable[[], object], timeout_s: float = 120) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.02)


def progressed_or_ended(root: Path, already: int, build: subprocess.Popen[bytes]) -> bool:
    return staged_rows(root) > already or build.poll() is not None


LATTICE = ("--config", "lattice", "--views", str(TINY_VIEWS), *TINY)


@pytest.fixture(scope="module")
def lattice_only(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("whole") / "dataset"
    finished = run_build("--out", root, *LATTICE)
    assert finished.returncode == 0, finished.stderr
    return root


def test_killed_again_and_again_it_finishes_to_the_same_bytes(lattice_only: Path, tmp_path: Path) -> None:
    root = tmp_path / "dataset"
    rng = np.random.default_rng(11)
    for kill in range(6):
        build = start_build(root, *LATTICE)
        already = staged_rows(root)
        wait_until(partial(progressed_or_ended, root, already, build))
        time.sleep(float(rng.uniform(0, 0.4)))
        if kill % 2:
            os.kill(build.pid, signal.SIGKILL)
        else:
            os.killpg(build.pid, signal.SIGKILL)
        build.communicate()
    finished = run_build("--out", root, *LATTICE)
    assert finished.returncode == 0, finished.stderr
    assert contents(root) == contents(lattice_only)
    assert not (root / BUILD_FOLDER).exists()


def test_no_render_process_outlives_a_killed_build(tmp_path: Path) -> None:
    build = start_build(tmp_path / "dataset", *LATTICE)
    wait_until(lambda: render_processes_of(build.pid))
    rendering = [Path(f"/proc/{pid}") for pid in render_processes_of(build.pid)]
    assert all(process.exists() for process in rendering)
    os.kill(build.pid, signal.SIGKILL)
    build.communicate()
    wait_until(lambda: not any(process.exists() for process in rendering), timeout_s=120)
    assert not any(process.exists() for process in rendering)


def test_other_worker_counts_give_the_same_bytes(lattice_only: Path, tmp_path: Path) -> None:
    root = tmp_path / "dataset"
    finished = run_build("--out", root, *LATTICE, "--workers", "2")
    assert finished.returncode == 0, finished.stderr
    assert contents(root) == contents(lattice_only)


def test_run_again_it_is_up_to_date(lattice_only: Path) -> None:
    before = contents(lattice_only)
    stamps = {path: path.stat().st_mtime_ns for path in lattice_only.rglob("*.parquet")}
    finished = run_build("--out", lattice_only, *LATTICE)
    assert "up to date: lattice" in finished.stdout
    assert contents(lattice_only) == before
    assert stamps == {path: path.stat().st_mtime_ns for path in lattice_only.rglob("*.parquet")}


def test_a_crashed_render_process_is_retried_once_then_named(tmp_path: Path) -> None:
    root = tmp_path / "dataset"
    build = start_build(root, *LATTICE)
    killed: set[int] = set()
    while len(killed) < 2:
        wait_until(lambda: set(render_processes_of(build.pid)) - killed)
        for pid in set(render_processes_of(build.pid)) - killed:
            os.kill(pid, signal.SIGKILL)
            killed.add(pid)
    _, complaint = build.communicate(timeout=120)
    assert build.returncode == 1
    said = complaint.decode()
    assert "render process for lattice views 28 to 420 died 2 times, last by signal SIGKILL" in said
    assert "Traceback" not in said


def test_one_crash_alone_is_survived(lattice_only: Path, tmp_path: Path) -> None:
    root = tmp_path / "dataset"
    build = start_build(root, *LATTICE)
    wait_until(lambda: staged_rows(root) >= 1)
    os.kill(render_processes_of(build.pid)[0], signal.SIGKILL)
    _, complaint = build.communicate(timeout=300)
    assert build.returncode == 0, complaint.decode()
    assert contents(root) == contents(lattice_only)


def test_a_rebuild_with_other_parameters_is_never_served_stale(tmp_path: Path) -> None:
    root = tmp_path / "dataset"
    small = ("--config", "lattice", "--views", "2", "--samples", "1")
    assert run_build("--out", root, *small, "--width", "96", "--height", "54").returncode == 0
    first = datasets.load_dataset(str(root), "lattice", split="test")
    assert first[0]["left_rgb"].size == (96, 54)
    old_shards = set(root.glob("lattice/*.parquet"))
    assert run_build("--out", root, *small, "--width", "64", "--height", "36").returncode == 0
    again = datasets.load_dataset(str(root), "lattice", split="test")
    assert again[0]["left_rgb"].size == (64, 36)
    assert rdb.load(root, "lattice")[1]["left_depth"].shape == (36, 64)
    assert not old_shards & set(root.glob("lattice/*.parquet"))


def test_the_lattices_own_mesh_goes_in_through_the_mesh_door_to_the_same_ground_truth(
    tiny_root: Path, tmp_path: Path
) -> None:
    mesh = tiny_root / "meshes" / "lattice.ply"
    finished = run_build("--out", tmp_path / "again", *LATTICE, "--mesh", mesh, "--mesh-unit", "m")
    assert finished.returncode == 0, finished.stderr
    first, again = open_folder(tiny_root), open_folder(tmp_path / "again")
    assert first.config("lattice")["ground_truth_digest"] == again.config("lattice")["ground_truth_digest"]
    assert again.config("lattice")["scene"]["assembly"]["path"] == "lattice.ply"
    bars = (read_bars(root / "bars.parquet")["lattice"] for root in (tiny_root, tmp_path / "again"))
    for drawn, estimated in zip(*bars, strict=True):
        assert estimated.bar_id == drawn.bar_id
        assert estimated.diameter_m == pytest.approx(drawn.diameter_m, rel=0.01)
        assert np.array(estimated.axis_m) == pytest.approx(np.array(drawn.axis_m), abs=1e-4)


def test_a_second_build_at_once_is_refused_in_words(tmp_path: Path) -> None:
    root = tmp_path / "dataset"
    build = start_build(root, *LATTICE)
    try:
        wait_until(lambda: render_processes_of(build.pid))
        refused = run_build("--out", root, *LATTICE)
        assert refused.returncode == 2
        assert "another rebar-build is at work there" in refused.stderr
    finally:
        os.killpg(build.pid, signal.SIGKILL)
        build.communicate()


def test_a_config_on_another_version_of_its_scene_is_refused(tiny_root: Path) -> None:
    refused = run_build("--out", tiny_root, *LATTICE, "--seed", "5")
    assert refused.returncode == 2
    assert "config lattice-orbit was built on scene 'lattice' with other parameters" in refused.stderr


def test_manifest_and_card_describe_the_folder(lattice_only: Path) -> None:
    manifest = json.loads((lattice_only / "manifest.json").read_text())
    found = contents(lattice_only)
    del found["manifest.json"]
    assert manifest["files"] == found
    scene = manifest["configs"]["lattice"]["scene"]
    assert scene["assembly"]["diameters_m"] == [0.007, 0.004]
    assert manifest["configs"]["lattice"]["generator"]["bpy"].startswith("4.5")
    assert (
        "| `lattice` | lattice | 9 of 504 | 160 x 90 | 1 | 0.22-0.43 m |"
        in (lattice_only / "README.md").read_text()
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--config", "latice"), "no config 'latice', expected one of lattice"),
        (("--views", "0"), "--views is 0, expected 1 to"),
        (("--width", "2", "--samples", "0"), "--width is 2, expected 16 to 8192; --samples is 0"),
        (("--workers", "0"), "--workers is 0, expected 1 or more"),
        (("--mesh", "nothing.stl"), "nothing.stl"),
        (("--mesh", __file__), "mesh files of kind '.py' are not read, expected"),
    ],
)
def test_bad_requests_end_in_words_and_write_nothing(
    tmp_path: Path, arguments: tuple[str, ...], words: str
) -> None:
    root = tmp_path / "dataset"
    refused = run_build("--out", root, *arguments)
    assert refused.returncode == 2
    assert words in refused.stderr
    assert "Traceback" not in refused.stderr
    assert not root.exists()


@pytest.mark.parametrize("marker", ["notes.txt", ".build/state", "manifest.json", ".rebar-build/state"])
def test_a_foreign_folder_is_left_alone(tmp_path: Path, marker: str) -> None:
    foreign = [marker, "meshes/mine.ply", "lattice/test-0-of-1.parquet", ".draft.tmp"]
    for name in foreign:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("mine")
    refused = run_build("--out", tmp_path, *LATTICE)
    assert refused.returncode == 2
    assert "Traceback" not in refused.stderr
    assert sorted(
        path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()
    ) == sorted(foreign)


def test_what_a_kill_between_publishing_and_tidying_leaves_is_mended(lattice_only: Path) -> None:
    """The staging of a published config, and a card that is not the manifest's."""
    before = contents(lattice_only)
    key = json.loads((lattice_only / "manifest.json").read_text())["configs"]["lattice"]["key"]
    for name in (key[:16], "0123456789abcdef"):
        (lattice_only / BUILD_FOLDER / f"lattice-{name}" / "rows").mkdir(parents=True)
    assert "up to date" in run_build("--out", lattice_only, *LATTICE).stdout
    assert not (lattice_only / BUILD_FOLDER).exists()
    for name in ("README.md", "bars.parquet"):
        (lattice_only / name).unlink()
        assert "up to date" in run_build("--out", lattice_only, *LATTICE).stdout
        assert contents(lattice_only) == before


def test_a_damaged_shard_is_built_again(lattice_only: Path) -> None:
    before = contents(lattice_only)
    shard = next(lattice_only.glob("lattice/*-00001-of-*.parquet"))
    shard.write_bytes(shard.read_bytes()[:-1] + b"!")
    assert "built: lattice" in run_build("--out", lattice_only, *LATTICE).stdout
    assert contents(lattice_only) == before
