"""Work units and the results that workers return, and builds on a local dask cluster of separate processes."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
import trimesh

from dataset_builder.catalog.named_configs import CONFIGS
from dataset_builder.pipeline import dask_renderer
from dataset_builder.pipeline.dask_renderer import connect_to_cluster
from dataset_builder.pipeline.plan import BUILD_FOLDER, ConfigPlan, generator_versions, plan_config
from dataset_builder.pipeline.shards import Staging
from dataset_builder.pipeline.work_units import (
    ReceivedFile,
    UnitResult,
    WorkUnit,
    accept_result,
    remaining_units,
    with_files,
)
from dataset_builder.specs.config_specs import ColourSpec
from rebar_depth_bench.base.errors import BuildError, InputError
from tests.building import TINY, TWO_BARS, RunBuild, StartBuild, contents, render_processes_of, staged_rows
from tests.dask_cluster import Cluster, NewCluster
from tests.processes import wait_until

MESH = b"ply: the mesh that rays were cast against"


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def make_row(index: int) -> ReceivedFile:
    content = f"row {index}".encode()
    return ReceivedFile(f"rows/{index:04d}.parquet", content, sha256(content))


def make_result(unit: WorkUnit) -> UnitResult:
    mesh = [ReceivedFile("mesh.ply", MESH, sha256(MESH))] if unit.with_mesh else []
    return UnitResult("tcp://far:1", {"colour": 1.0}, sha256(MESH), (*map(make_row, unit.indices), *mesh))


def staged_files(plan: ConfigPlan) -> dict[str, bytes]:
    root = plan.staging.root
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()}


@pytest.fixture
def plan(tmp_path: Path) -> ConfigPlan:
    """Return a plan of 17 views: two shards of eight and one of one."""
    return plan_config(CONFIGS["lattice"](), 17, tmp_path)


def test_units_cover_views_once_and_request_one_mesh(plan: ConfigPlan) -> None:
    units = remaining_units(plan)
    assert [len(unit.indices) for unit in units] == [8, 8, 1]
    assert sum((unit.indices for unit in units), ()) == plan.indices
    assert [unit.with_mesh for unit in units] == [True, False, False]
    assert {unit.mesh_sha256 for unit in units} == {None}


def test_units_without_colour_cover_several_shards(tmp_path: Path) -> None:
    plan = plan_config(replace(CONFIGS["lattice"](), colour=None), 70, tmp_path)
    units = remaining_units(plan)
    assert [(unit.shard, len(unit.indices)) for unit in units] == [(0, 32), (4, 32), (8, 6)]
    assert sum((unit.indices for unit in units), ()) == plan.indices


def test_staged_views_are_not_planned_again(plan: ConfigPlan) -> None:
    first, second, third = remaining_units(plan)
    accept_result(second, make_result(second), plan.staging)
    accept_result(third, make_result(third), plan.staging)
    plan.staging.row(first.indices[3]).write_bytes(b"staged before a kill")
    (remaining,) = remaining_units(plan)
    assert remaining.shard == 0
    assert remaining.indices == first.indices[:3] + first.indices[4:]
    assert remaining.with_mesh
    assert remaining.mesh_sha256 == sha256(MESH)
    accept_result(remaining, make_result(remaining), plan.staging)
    assert remaining_units(plan) == []
    assert plan.staging.mesh.read_bytes() == MESH
    assert plan.staging.row(first.indices[3]).read_bytes() == b"staged before a kill"
    assert plan.staging.row(first.indices[2]).read_bytes() == f"row {first.indices[2]}".encode()


def test_missing_mesh_is_planned_alone(plan: ConfigPlan) -> None:
    for unit in remaining_units(plan):
        accept_result(unit, make_result(unit), plan.staging)
    plan.staging.mesh.unlink()
    (unit,) = remaining_units(plan)
    assert (unit.indices, unit.with_mesh, unit.label) == ((), True, "the mesh of lattice")


Files = list[ReceivedFile]
ANOTHER = ReceivedFile("mesh.ply", b"another", sha256(b"another"))


def changed(position: int, content: bytes) -> Callable[[Files], Files]:
    """Return a function that changes the content of one of the files, but not its digest."""
    return lambda files: [replace(file, content=content) if file is files[position] else file for file in files]


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (changed(0, b"row 1!"), "rows/0014.parquet was received with sha256"),
        (changed(0, b""), f"was received with sha256 {sha256(b'')}, expected"),
        (changed(-1, MESH + b" "), "mesh.ply was received with sha256"),
        (lambda files: [*files[:-1], ANOTHER], f"its mesh has sha256 {sha256(b'another')}, expected"),
        (lambda files: files[1:], "rows/0014.parquet is missing"),
        (lambda files: files[:-1], "mesh.ply is missing"),
        (lambda files: [*files, make_row(3)], "rows/0003.parquet was not requested"),
    ],
)
def test_result_that_does_not_match_unit_is_rejected(
    plan: ConfigPlan, spoil: Callable[[Files], Files], words: str
) -> None:
    first, second, _ = remaining_units(plan)
    accept_result(second, make_result(second), plan.staging)
    before = staged_files(plan)
    result = make_result(first)
    files = tuple(spoil([*result.files]))
    mesh_sha256 = ANOTHER.sha256 if ANOTHER in files else result.mesh_sha256
    with pytest.raises(BuildError) as raised:
        accept_result(first, replace(result, files=files, mesh_sha256=mesh_sha256), plan.staging)
    message = str(raised.value)
    assert (
        f"lattice views {first.indices[0]} to {first.indices[-1]}, rendered by tcp://far:1: rejected: " in message
    )
    assert words in message
    assert staged_files(plan) == before
    accept_result(first, make_result(first), plan.staging)
    assert len(staged_files(plan)) == len(before) + 9


def test_local_result_without_payload_needs_staged_rows(plan: ConfigPlan) -> None:
    first, *_ = remaining_units(plan)
    local_result = UnitResult("this machine", {}, sha256(MESH))
    plan.staging.mesh.parent.mkdir(parents=True)
    plan.staging.mesh.write_bytes(MESH)
    with pytest.raises(BuildError, match=rf"rows/{first.indices[-1]:04d}\.parquet is missing"):
        accept_result(first, local_result, plan.staging)
    plan.staging.row(14).parent.mkdir()
    for index in first.indices:
        plan.staging.row(index).write_bytes(make_row(index).content)
    accept_result(first, local_result, plan.staging)
    assert with_files(local_result, first, plan.staging) == replace(
        make_result(first), worker="this machine", seconds={}
    )


NOWHERE = "tcp://127.0.0.1:1"
VIEWS = 9
"""Number of views: a shard of eight and one of one, that is two work units."""
SMALL = ("--scene", str(TWO_BARS), "--views", str(VIEWS), *TINY)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory, new_cluster: NewCluster) -> Iterator[Cluster]:
    with new_cluster(tmp_path_factory.mktemp("cluster")) as started:
        started.start_scheduler()
        for _ in range(2):
            started.start_worker()
        yield started


@pytest.fixture(scope="module")
def local_root(tmp_path_factory: pytest.TempPathFactory, run_build: RunBuild) -> Path:
    root = tmp_path_factory.mktemp("local") / "dataset"
    process = run_build("--out", root, *SMALL, "--workers", "2")
    assert process.returncode == 0, process.stderr
    return root


@pytest.mark.parametrize(
    ("device", "message"),
    [("auto", "--device auto is combined with --cluster"), ("hip", "--device hip: worker tcp:")],
)
def test_devices_are_those_of_the_workers(
    cluster: Cluster, tmp_path: Path, run_build: RunBuild, device: str, message: str
) -> None:
    process = run_build("--out", tmp_path / "dataset", *SMALL, "--cluster", cluster.address, "--device", device)
    assert process.returncode == 2, process.stderr
    assert message in process.stderr
    assert not any(tmp_path.iterdir())


def test_cluster_build_equals_local_build(
    cluster: Cluster, local_root: Path, tmp_path: Path, run_build: RunBuild
) -> None:
    root = tmp_path / "dataset"
    process = run_build("--out", root, *SMALL, "--cluster", cluster.address)
    assert process.returncode == 0, process.stderr
    assert contents(root) == contents(local_root)
    assert not (root / BUILD_FOLDER).exists()
    assert "two-bars: 4 of 9" in process.stderr, "no progress within a unit"


def write_two_bars(path: Path) -> None:
    """Write a mesh of two vertical rods on the board, 10 mm in diameter and 80 mm high."""
    rods = [trimesh.creation.cylinder(radius=0.005, height=0.080, sections=24) for _ in range(2)]
    for rod, x_m in zip(rods, (-0.03, 0.03), strict=True):
        rod.apply_translation((x_m, 0.0, 0.040))
    trimesh.util.concatenate(rods).export(path)


def test_local_mesh_file_is_built_without_colour_on_cluster(
    cluster: Cluster, tmp_path: Path, run_build: RunBuild
) -> None:
    mesh = tmp_path / "my cage.stl"
    write_two_bars(mesh)
    request = ("--config", "lattice", "--views", "9", *TINY[:4], "--no-colour", "--mesh", mesh, "--mesh-unit", "m")
    for out, cluster_options in (("here", ()), ("away", ("--cluster", cluster.address))):
        process = run_build("--out", tmp_path / out, *request, *cluster_options)
        assert process.returncode == 0, process.stderr
    assert contents(tmp_path / "away") == contents(tmp_path / "here")
    manifest = json.loads((tmp_path / "away" / "manifest.json").read_text())
    assert manifest["configs"]["lattice"]["scenes"][0]["assembly"]["path"] == "my cage.stl"


def test_interrupted_build_resumes_and_dead_worker_is_replaced(
    cluster: Cluster, local_root: Path, tmp_path: Path, start_build: StartBuild
) -> None:
    root = tmp_path / "dataset"
    build = start_build(root, *SMALL, "--cluster", cluster.address)
    wait_until(lambda: staged_rows(root) or build.poll() is not None)
    build.send_signal(signal.SIGINT)
    _, stderr = build.communicate(timeout=300)
    assert build.returncode == 1, stderr.decode()
    assert "run the same command again to continue" in stderr.decode()
    assert "Traceback" not in stderr.decode()
    staged_before = staged_rows(root)
    assert 0 < staged_before < VIEWS
    wait_until(lambda: not render_pids(cluster), within_s=300)  # Cancelled units end at their next view.

    build = start_build(root, *SMALL, "--cluster", cluster.address)
    wait_until(lambda: render_pids(cluster) or build.poll() is not None)
    victim = next(worker for worker in cluster.workers if render_processes_of(worker.pid))
    orphans = [Path(f"/proc/{pid}") for pid in render_processes_of(victim.pid)]
    victim.kill()
    victim.wait()
    cluster.workers.remove(victim)
    _, stderr = build.communicate(timeout=300)
    cluster.start_worker()
    assert build.returncode == 0, stderr.decode()
    assert f"two-bars: {staged_before} of {VIEWS}" in stderr.decode()
    assert contents(root) == contents(local_root)
    wait_until(lambda: not any(process_dir.exists() for process_dir in orphans))


def render_pids(cluster: Cluster) -> list[int]:
    return [pid for worker in cluster.workers for pid in render_processes_of(worker.pid)]


def test_unit_that_crashes_blender_twice_fails_build(
    cluster: Cluster, tmp_path: Path, start_build: StartBuild
) -> None:
    build = start_build(tmp_path / "dataset", *SMALL, "--cluster", cluster.address)
    deadline = time.monotonic() + 900
    while build.poll() is None:
        assert time.monotonic() < deadline, "waited too long"
        for pid in render_pids(cluster):
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        time.sleep(0.02)
    _, stderr = build.communicate(timeout=120)
    message = stderr.decode()
    assert build.returncode == 1
    assert "error: worker tcp://127.0.0.1:" in message
    assert "the render process for two-bars views" in message
    assert "died 2 times, the last time with signal SIGKILL" in message
    assert "Traceback" not in message


@pytest.fixture
def staging(tmp_path: Path) -> Staging:
    return Staging(tmp_path / "staging")


def test_input_errors_on_workers_are_raised_in_client(
    cluster: Cluster, staging: Staging, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Submit a unit for a device that the workers do not have, and one with other software versions."""
    spec = CONFIGS["lattice"]()
    units = [
        remaining_units(plan_config(replace(spec, colour=ColourSpec(device=device)), 1, tmp_path))[0]
        for device in ("hip", "cpu")
    ]
    stamp = {**generator_versions(), "embreex": "0.1"}
    with connect_to_cluster(cluster.address) as renderer:
        absent = renderer.submit(units[0], staging, lambda _: None)
        monkeypatch.setattr(dask_renderer, "generator_versions", lambda: stamp)
        outdated = renderer.submit(units[1], staging, lambda _: None)
        with pytest.raises(InputError, match=r"worker tcp://127.*: --device hip: no such device was found"):
            absent.result(timeout=120)
        with pytest.raises(InputError, match=r"worker tcp://127.*: embreex 4.*, expected 0\.1"):
            outdated.result(timeout=120)


def test_worker_with_other_software_is_rejected(
    tmp_path: Path, new_cluster: NewCluster, run_build: RunBuild
) -> None:
    dist_info = tmp_path / "site" / "embreex-0.0.1.dist-info"
    dist_info.mkdir(parents=True)
    (dist_info / "METADATA").write_text("Metadata-Version: 2.1\nName: embreex\nVersion: 0.0.1\n")
    with new_cluster(tmp_path) as started:
        started.start_scheduler()
        started.start_worker(PYTHONPATH=os.pathsep.join([str(dist_info.parent), os.environ.get("PYTHONPATH", "")]))
        process = run_build("--out", tmp_path / "dataset", *SMALL, "--cluster", started.address)
    assert process.returncode == 2, process.stderr
    assert "has other software versions than the building machine: embreex 0.0.1, expected 4" in process.stderr
    assert not (tmp_path / "dataset").exists()


def test_unusable_cluster_is_rejected_and_nothing_written(
    tmp_path: Path, new_cluster: NewCluster, start_build: StartBuild
) -> None:
    with new_cluster(tmp_path) as idle:
        idle.start_scheduler()
        expected = {
            ("nonsense",): "--cluster nonsense: is not a valid address",
            (idle.address,): f"--cluster {idle.address}: the scheduler has no workers after 10 s",
        }
        for dry_run in ((), ("--dry-run",)):
            expected[NOWHERE, *dry_run] = f"--cluster {NOWHERE}: no dask scheduler responds at this address"
        builds = {
            options: start_build(tmp_path / "dataset", *SMALL, "--cluster", *options) for options in expected
        }
        messages = {options: build.communicate(timeout=120)[1].decode() for options, build in builds.items()}
    for options, words in expected.items():
        assert words in messages[options]
        assert "Traceback" not in messages[options]
        assert builds[options].returncode == 2
    assert not (tmp_path / "dataset").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "words"),
    [(("--cluster", NOWHERE), "pip install '.[cluster]'"), (("--samples", "0"), "--samples: got 0")],
)
def test_builds_without_cluster_need_no_distributed(tmp_path: Path, options: tuple[str, str], words: str) -> None:
    """The number of samples is refused only after all modules are imported."""
    code = "import sys; sys.modules['distributed'] = None; from dataset_builder.cli.main import main; exit(main())"
    command = [sys.executable, "-c", code, "--out", str(tmp_path / "dataset"), *options]
    process = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert (process.returncode, words in process.stderr) == (2, True), process.stderr
