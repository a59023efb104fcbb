"""Builds on a local dask cluster with separate processes and scratch folders."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
import trimesh

from dataset_builder.catalog.named_configs import CONFIGS
from dataset_builder.pipeline import dask_renderer
from dataset_builder.pipeline.dask_renderer import check_software_versions, connect_to_cluster
from dataset_builder.pipeline.plan import BUILD_FOLDER, generator_versions, plan_config
from dataset_builder.pipeline.shards import Staging
from dataset_builder.pipeline.work_units import remaining_units
from dataset_builder.specs.config_specs import ColourSpec
from rebar_depth_bench.base.errors import InputError
from tests.building import (
    TINY,
    TWO_BARS,
    RunBuild,
    StartBuild,
    contents,
    render_processes_of,
    staged_rows,
)
from tests.dask_cluster import Cluster, NewCluster
from tests.processes import wait_until

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


def test_cluster_build_without_colour_equals_local_build(
    cluster: Cluster, tmp_path: Path, run_build: RunBuild
) -> None:
    request = (*SMALL[:-2], "--no-colour")
    for out, options in (("here", ()), ("away", ("--cluster", cluster.address))):
        process = run_build("--out", tmp_path / out, *request, *options)
        assert process.returncode == 0, process.stderr
    assert contents(tmp_path / "away") == contents(tmp_path / "here")


def write_two_bars(path: Path) -> None:
    """Write a mesh of two vertical rods on the board, 10 mm in diameter and 80 mm high."""
    rods = [trimesh.creation.cylinder(radius=0.005, height=0.080, sections=24) for _ in range(2)]
    for rod, x_m in zip(rods, (-0.03, 0.03), strict=True):
        rod.apply_translation((x_m, 0.0, 0.040))
    trimesh.util.concatenate(rods).export(path)


def test_local_mesh_file_is_built_on_cluster(cluster: Cluster, tmp_path: Path, run_build: RunBuild) -> None:
    mesh = tmp_path / "my cage.stl"
    write_two_bars(mesh)
    request = ("--config", "lattice", "--views", "2", *TINY, "--mesh", mesh, "--mesh-unit", "m")
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


def test_other_software_versions_are_rejected_by_name() -> None:
    local_versions = dict(generator_versions())
    check_software_versions(local_versions, "tcp://far:1", dict(local_versions))
    worker_versions = {**local_versions, "embreex": "4.3.0"}
    del worker_versions["pillow"]
    with pytest.raises(InputError) as raised:
        check_software_versions(local_versions, "tcp://far:1", worker_versions)
    message = str(raised.value)
    assert message.startswith("worker tcp://far:1 has other software")
    assert (
        f"embreex 4.3.0, expected {local_versions['embreex']}; pillow missing, expected {local_versions['pillow']}"
        in message
    )
    assert "numpy" not in message


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
        expected_messages = {
            "tcp://127.0.0.1:1": "--cluster tcp://127.0.0.1:1: no dask scheduler responds at this address",
            "nonsense": "--cluster nonsense: is not a valid address (missing port number in address 'nonsense')",
            idle.address: f"--cluster {idle.address}: the scheduler has no workers after 10 s",
        }
        builds = {
            address: start_build(tmp_path / "dataset", *SMALL, "--cluster", address)
            for address in expected_messages
        }
        stderr_by_address = {
            address: build.communicate(timeout=120)[1].decode() for address, build in builds.items()
        }
    for address, words in expected_messages.items():
        assert words in stderr_by_address[address]
        assert "Traceback" not in stderr_by_address[address]
        assert builds[address].returncode == 2
    assert not (tmp_path / "dataset").exists()


def test_workers_with_cluster_is_rejected(tmp_path: Path, run_build: RunBuild) -> None:
    process = run_build("--out", tmp_path / "dataset", "--cluster", "tcp://127.0.0.1:1", "--workers", "2")
    assert process.returncode == 2
    assert "--workers 2 is combined with --cluster tcp://127.0.0.1:1, expected only one of them" in process.stderr


def run_cli(prepare: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    code = f"import sys; {prepare}; from dataset_builder.cli.main import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.slow
def test_missing_distributed_names_pip_extra(tmp_path: Path) -> None:
    arguments = ("--out", str(tmp_path / "dataset"), "--cluster", "tcp://127.0.0.1:1")
    process = run_cli("sys.modules['distributed'] = None", *arguments)
    assert process.returncode == 2, process.stderr
    assert "pip install 'rebar-depth-bench[cluster]'" in process.stderr


@pytest.mark.slow
def test_local_build_does_not_import_distributed(tmp_path: Path) -> None:
    """Check ``sys.modules`` after ``--samples 0``, which is rejected only after all modules are imported."""
    prepare = "import atexit; atexit.register(lambda: print('distributed' in sys.modules, 'bpy' in sys.modules))"
    process = run_cli(prepare, "--out", str(tmp_path / "dataset"), "--samples", "0")
    assert "--samples: got 0" in process.stderr
    assert process.stdout.split() == ["False", "False"]
