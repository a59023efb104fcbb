"""Builds on a real dask cluster: its own processes and scratch folders, whatever happens to them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest
import trimesh

from dataset_builder.scene.assemblies.mesh_file import mesh_file_spec
from dataset_builder.build.dask_renderer import on_cluster
from dataset_builder.config.catalog import CONFIGS
from dataset_builder.build.plan import BUILD_FOLDER, generator_stamp, plan_config
from dataset_builder.build.shards import Staging
from dataset_builder.build.work_units import units_of
from rebar_depth_bench.errors import InputError
from tests.builder.build.test_build import contents, render_processes_of, staged_rows, start_build, wait_until
from tests.conftest import TINY, run_build

pytestmark = pytest.mark.render

VIEWS = 17
"""Two shards of eight and one of one: three units."""
LATTICE = ("--config", "lattice", "--views", str(VIEWS), *TINY)


@dataclass
class Cluster:
    """A scheduler and workers on this machine, started as a user starts them."""

    folder: Path
    processes: list[subprocess.Popen[bytes]] = field(default_factory=list)
    workers: list[subprocess.Popen[bytes]] = field(default_factory=list)

    @property
    def address(self) -> str:
        return str(json.loads(self._scheduler_file.read_text())["address"])

    @property
    def _scheduler_file(self) -> Path:
        return self.folder / "scheduler.json"

    def start_scheduler(self) -> None:
        file = str(self._scheduler_file)
        self._start("scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", file)
        wait_until(self._scheduler_file.is_file)

    def start_worker(self, **environment: str) -> None:
        scratch = self.folder / f"worker-{len(self.processes)}"
        scratch.mkdir()
        options = ("--nthreads", "1", "--no-nanny", "--local-directory", str(scratch))
        log = self.folder / f"worker-{len(self.processes)}.log"
        self.workers.append(self._start("worker", self.address, *options, **environment))
        wait_until(lambda: b"Registered to" in log.read_bytes())

    def _start(self, role: str, *arguments: str, **environment: str) -> subprocess.Popen[bytes]:
        with (self.folder / f"{role}-{len(self.processes)}.log").open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "dask", role, *arguments, "--no-dashboard"],
                cwd=self.folder,
                env={**os.environ, **environment},
                stdout=log,
                stderr=log,
            )
        self.processes.append(process)
        return process

    def end(self) -> None:
        for process in self.processes:
            process.kill()
            process.wait()


@contextmanager
def cluster_in(folder: Path) -> Iterator[Cluster]:
    cluster = Cluster(folder)
    try:
        cluster.start_scheduler()
        yield cluster
    finally:
        cluster.end()


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    with cluster_in(tmp_path_factory.mktemp("cluster")) as started:
        for _ in range(3):
            started.start_worker()
        yield started


@pytest.fixture(scope="module")
def local_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("local") / "dataset"
    finished = run_build("--out", root, *LATTICE, "--workers", "2")
    assert finished.returncode == 0, finished.stderr
    return root


def test_the_same_bytes_come_from_a_cluster(cluster: Cluster, local_root: Path, tmp_path: Path) -> None:
    root = tmp_path / "dataset"
    finished = run_build("--out", root, *LATTICE, "--cluster", cluster.address)
    assert finished.returncode == 0, finished.stderr
    assert contents(root) == contents(local_root)
    assert not (root / BUILD_FOLDER).exists()
    assert "lattice: 4 of 17" in finished.stderr, "no progress within a unit"


def write_two_bars(path: Path) -> None:
    """Write two upright rods of 10 mm, 80 mm high, that stand on the board."""
    rods = [trimesh.creation.cylinder(radius=0.005, height=0.080, sections=24) for _ in range(2)]
    for rod, x_m in zip(rods, (-0.03, 0.03), strict=True):
        rod.apply_translation((x_m, 0.0, 0.040))
    trimesh.util.concatenate(rods).export(path)


def test_a_mesh_file_of_this_machine_is_built_elsewhere(cluster: Cluster, tmp_path: Path) -> None:
    mesh = tmp_path / "my cage.stl"
    write_two_bars(mesh)
    request = ("--config", "lattice", "--views", "2", *TINY, "--mesh", mesh, "--mesh-unit", "m")
    for out, where in (("here", ()), ("away", ("--cluster", cluster.address))):
        finished = run_build("--out", tmp_path / out, *request, *where)
        assert finished.returncode == 0, finished.stderr
    assert contents(tmp_path / "away") == contents(tmp_path / "here")
    manifest = json.loads((tmp_path / "away" / "manifest.json").read_text())
    assert manifest["configs"]["lattice"]["scene"]["assembly"]["path"] == "my cage.stl"


def test_interrupted_it_goes_on_and_a_killed_worker_is_replaced(
    cluster: Cluster, local_root: Path, tmp_path: Path
) -> None:
    root = tmp_path / "dataset"
    build = start_build(root, *LATTICE, "--cluster", cluster.address)
    wait_until(lambda: staged_rows(root) or build.poll() is not None)
    build.send_signal(signal.SIGINT)
    _, complaint = build.communicate(timeout=300)
    assert build.returncode == 1, complaint.decode()
    assert "run the same command again to go on" in complaint.decode()
    assert "Traceback" not in complaint.decode()
    already = staged_rows(root)
    assert 0 < already < VIEWS
    wait_until(lambda: not rendering(cluster), timeout_s=300)  # nobody waits for what was under way

    build = start_build(root, *LATTICE, "--cluster", cluster.address)
    wait_until(lambda: rendering(cluster) or build.poll() is not None)
    victim = next(worker for worker in cluster.workers if render_processes_of(worker.pid))
    orphans = [Path(f"/proc/{pid}") for pid in render_processes_of(victim.pid)]
    victim.kill()
    victim.wait()
    cluster.workers.remove(victim)
    _, complaint = build.communicate(timeout=300)
    cluster.start_worker()
    assert build.returncode == 0, complaint.decode()
    assert f"lattice: {already} of {VIEWS}" in complaint.decode()
    assert contents(root) == contents(local_root)
    wait_until(lambda: not any(process.exists() for process in orphans), timeout_s=120)


def rendering(cluster: Cluster) -> list[int]:
    return [pid for worker in cluster.workers for pid in render_processes_of(worker.pid)]


def test_a_unit_that_crashes_blender_twice_ends_the_build_in_words(cluster: Cluster, tmp_path: Path) -> None:
    build = start_build(tmp_path / "dataset", *LATTICE, "--cluster", cluster.address)
    deadline = time.monotonic() + 900
    while build.poll() is None:
        assert time.monotonic() < deadline, "waited too long"
        for pid in rendering(cluster):
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        time.sleep(0.02)
    _, complaint = build.communicate(timeout=120)
    said = complaint.decode()
    assert build.returncode == 1
    assert "error: worker tcp://127.0.0.1:" in said
    assert "the render process for lattice views" in said
    assert "died 2 times, last by signal SIGKILL" in said
    assert "Traceback" not in said


@pytest.fixture
def staging(tmp_path: Path) -> Staging:
    return Staging(tmp_path / "staging")


def test_input_errors_come_back_in_their_own_words(cluster: Cluster, staging: Staging, tmp_path: Path) -> None:
    """Of a mesh file that no machine can read, and of a worker that was updated while the build ran."""
    bad = tmp_path / "bad.stl"
    bad.write_bytes(b"solid nothing\nendsolid nothing\n")
    spec = CONFIGS["lattice"]()
    bad_spec = replace(spec, scene=replace(spec.scene, assembly=mesh_file_spec(bad, "m")))
    unreadable, *_ = units_of(plan_config(bad_spec, 1, tmp_path))
    stamp = {**generator_stamp(), "embreex": "0.1"}
    outdated = replace(units_of(plan_config(spec, 1, tmp_path))[0], stamp=stamp)
    with on_cluster(cluster.address) as renderer:
        futures = [renderer.submit(unit, staging, lambda _: None) for unit in (unreadable, outdated)]
        with pytest.raises(InputError, match=r"rebar-unit-\w+/bad\.stl: "):
            futures[0].result(timeout=120)
        with pytest.raises(InputError, match=r"worker tcp://127.*: embreex 4.*, expected 0\.1"):
            futures[1].result(timeout=120)


def test_a_worker_with_other_software_is_told(tmp_path: Path) -> None:
    other = tmp_path / "site" / "embreex-0.0.1.dist-info"
    other.mkdir(parents=True)
    (other / "METADATA").write_text("Metadata-Version: 2.1\nName: embreex\nVersion: 0.0.1\n")
    with cluster_in(tmp_path) as own:
        own.start_worker(PYTHONPATH=os.pathsep.join([str(other.parent), os.environ.get("PYTHONPATH", "")]))
        refused = run_build("--out", tmp_path / "dataset", *LATTICE, "--cluster", own.address)
    assert refused.returncode == 2, refused.stderr
    assert "has other software than the machine that builds: embreex 0.0.1, expected 4" in refused.stderr
    assert not (tmp_path / "dataset").exists()


def test_a_cluster_that_cannot_render_is_told_and_nothing_written(tmp_path: Path) -> None:
    with cluster_in(tmp_path) as idle:
        asked = {
            "tcp://127.0.0.1:1": "--cluster tcp://127.0.0.1:1: no dask scheduler answers there",
            "nonsense": "--cluster nonsense: is no address (missing port number in address 'nonsense')",
            idle.address: f"--cluster {idle.address}: has no workers after 10 s",
        }
        builds = {address: start_build(tmp_path / "dataset", *LATTICE, "--cluster", address) for address in asked}
        said = {address: build.communicate(timeout=120)[1].decode() for address, build in builds.items()}
    for address, words in asked.items():
        assert words in said[address]
        assert "Traceback" not in said[address]
        assert builds[address].returncode == 2
    assert not (tmp_path / "dataset").exists()


def test_workers_beside_cluster_are_refused(tmp_path: Path) -> None:
    refused = run_build("--out", tmp_path / "dataset", "--cluster", "tcp://127.0.0.1:1", "--workers", "2")
    assert refused.returncode == 2
    assert "--workers 2 stands beside --cluster tcp://127.0.0.1:1, expected one of them" in refused.stderr


def run_cli(prepare: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    code = f"import sys; {prepare}; from dataset_builder.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_without_distributed_the_extra_is_named(tmp_path: Path) -> None:
    arguments = ("--out", str(tmp_path / "dataset"), "--cluster", "tcp://127.0.0.1:1")
    refused = run_cli("sys.modules['distributed'] = None", *arguments)
    assert refused.returncode == 2, refused.stderr
    assert "pip install 'rebar-depth-bench[cluster]'" in refused.stderr


def test_a_local_build_never_imports_distributed(tmp_path: Path) -> None:
    """``--samples 0`` is refused by ``build`` itself, so that all of its modules were imported."""
    told = "import atexit; atexit.register(lambda: print('distributed' in sys.modules, 'bpy' in sys.modules))"
    refused = run_cli(told, "--out", str(tmp_path / "dataset"), "--samples", "0")
    assert "--samples is 0" in refused.stderr
    assert refused.stdout.split() == ["False", "False"]
