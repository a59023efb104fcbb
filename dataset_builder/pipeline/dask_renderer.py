"""Renderer on the workers of a dask cluster. The only module that imports ``distributed``.

No shared file system is required: a unit is sent to a worker as a plain value, is rendered by a Blender process in
the worker's scratch folder, and is returned as bytes with their digests. The units of a lost worker are rendered
by other workers, with the same bytes. The staged cage of a user's file is uploaded once and passed on between the
workers.

A render process uses all devices of its machine that have the requested type. To render in several processes on a
machine with several GPUs, start one worker per GPU and let it see only this one, for example with
``CUDA_VISIBLE_DEVICES``.
"""

from __future__ import annotations

import logging
import os
import tempfile
import uuid
import warnings
from collections.abc import Iterator, Mapping
from concurrent.futures import CancelledError, Future
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import distributed
from distributed.comm import get_address_host_port
from distributed.scheduler import KilledWorker

from dataset_builder.pipeline.blender_process import (
    AUTO,
    BlenderProcesses,
    OnViewDone,
    available_devices,
    choose_device,
    render_unit,
)
from dataset_builder.pipeline.plan import generator_versions
from dataset_builder.pipeline.shards import Staging
from dataset_builder.pipeline.work_units import UnitResult, WorkUnit, with_files
from dataset_builder.specs.config_specs import CPU
from rebar_depth_bench.base.errors import BuildError, InputError, RenderProcessError

_CONNECT_S = 10


@dataclass
class ClusterRenderer:
    """Renderer on the workers connected to the scheduler of ``client``."""

    client: distributed.Client
    keys: dict[str, WorkUnit] = field(default_factory=dict)
    """Units by their dask key."""
    cages: dict[Staging, distributed.Future] = field(default_factory=dict)
    """Staged cages on the cluster. A lost one is recreated from the task kept by the scheduler."""

    def submit(self, unit: WorkUnit, staging: Staging, on_view_done: OnViewDone) -> Future[UnitResult]:
        """Schedule ``unit`` on the next free worker.

        The worker reports rendered views in a dask topic named by the key of the unit.
        """
        key = f"render-{unit.config.label}-{uuid.uuid4().hex}"
        self.keys[key] = unit
        self.client.subscribe_topic(key, lambda event: on_view_done(event[1]))
        future: Future[UnitResult] = self.client.get_executor(pure=False).submit(
            render_on_worker, unit, generator_versions(), self._cage(staging), key=key
        )
        return future

    def check_device(self, device: str) -> None:
        """Raise ``InputError`` if a connected worker has no device of a type, or if the type is ``auto``.

        The type would otherwise depend on the workers that are connected when a build is started or continued.
        """
        if device == AUTO:
            raise InputError(f"--device {AUTO} is combined with --cluster, expected the name of a device type")
        if device != CPU:
            for worker, available in self.client.run(available_devices).items():
                choose_device(device, available, f"worker {worker}")

    def _cage(self, staging: Staging) -> distributed.Future | None:
        """Return the content of the staged cage, sent through the scheduler once; None if there is none."""
        if not staging.cage.is_file():
            return None
        if staging not in self.cages:
            key = f"cage-{uuid.uuid4().hex}"
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "Sending large graph", UserWarning)
                self.cages[staging] = self.client.submit(bytes, staging.cage.read_bytes(), key=key, pure=False)
        return self.cages[staging]


@contextmanager
def connect_to_cluster(address: str) -> Iterator[ClusterRenderer]:
    """Yield a renderer on the dask scheduler at ``address``; leaving the context cancels the queued units.

    Raises ``InputError`` if no scheduler answers within 10 s, if it has no worker 10 s later, or if software is
    missing or has another version on the cluster; ``RenderProcessError`` if several workers died while rendering
    the same unit; ``BuildError`` if the scheduler is lost.
    """
    logger = logging.getLogger("distributed.client")
    level = logger.level
    logger.setLevel(logging.CRITICAL)  # dask would log tracebacks of errors that are reported to the user.
    try:
        with closing(_connect(address)) as client:
            renderer = ClusterRenderer(client)
            _check_workers(client, address)
            yield renderer
    except KilledWorker as error:
        unit = renderer.keys.get(str(error.task))
        label = "a staged cage" if unit is None else unit.label
        raise RenderProcessError(
            f"{label}: {error.allowed_failures + 1} workers died while rendering "
            f"it, the last at {error.last_worker.address}; see the logs of these workers for the reason"
        ) from None
    except CancelledError:
        raise BuildError(
            f"the dask scheduler at {address} was lost; run the same command again to continue "
            "when the scheduler is running"
        ) from None
    finally:
        logger.setLevel(level)


def _connect(address: str) -> distributed.Client:
    expected = "expected the address that `dask scheduler` printed, such as tcp://host:8786"
    try:
        get_address_host_port(address)  # A client that fails on an invalid address does not close cleanly.
    except ValueError as error:
        raise InputError(
            f"--cluster {address}: is not a valid address ({_first_line(error)}), {expected}"
        ) from None
    try:
        return distributed.Client(address, timeout=_CONNECT_S, set_as_default=False, name="rebar-build")
    except (OSError, ImportError) as error:
        raise InputError(
            f"--cluster {address}: no dask scheduler responds at this address ({_first_line(error)}), {expected}"
        ) from None


def _check_workers(client: distributed.Client, address: str) -> None:
    """Raise ``InputError`` if there are no workers, or if software versions of scheduler or workers differ."""
    try:
        client.wait_for_workers(1, timeout=_CONNECT_S)
    except TimeoutError:
        raise InputError(
            f"--cluster {address}: the scheduler has no workers after {_CONNECT_S} s, expected at least one: "
            f"on each machine that renders, run: dask worker {address} --nthreads 1"
        ) from None
    expected_versions = generator_versions()
    for worker, software_versions in client.run(generator_versions, on_error="return").items():
        if isinstance(software_versions, Mapping):
            check_software_versions(expected_versions, worker, software_versions)
        else:
            raise _software_error(f"worker {worker}", software_versions)
    try:
        client.run_on_scheduler(generator_versions)
    except ImportError as error:
        raise _software_error(f"the scheduler {address}", error) from None


def check_software_versions(expected: Mapping[str, str], worker: str, actual: Mapping[str, str]) -> None:
    """Raise ``InputError`` if the software versions ``actual`` on ``worker`` differ from ``expected``."""
    different = [
        f"{name} {actual.get(name, 'missing')}, expected {expected.get(name, 'none')}"
        for name in sorted({*actual, *expected})
        if actual.get(name) != expected.get(name)
    ]
    if different:
        raise InputError(
            f"worker {worker} has other software versions than the building machine: {'; '.join(different)}"
        )


def _software_error(machine: str, error: object) -> InputError:
    software_versions = generator_versions()
    return InputError(
        f"{machine} cannot run this software ({_first_line(error)}), expected "
        f"rebar-depth-bench[build,cluster] {software_versions['rebar-depth-bench']} there"
    )


def _first_line(error: object) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def render_on_worker(unit: WorkUnit, software_versions: Mapping[str, str], cage: bytes | None) -> UnitResult:
    """Render a unit in the scratch folder of this dask worker, and return the result with its files.

    ``cage`` is the content of the staged cage. Raises ``InputError`` if the software versions of the worker are
    not ``software_versions``, and ``BuildError`` or ``InputError`` naming the worker if rendering fails.
    """
    worker = distributed.get_worker()
    check_software_versions(software_versions, worker.address, generator_versions())
    threads = max(1, (os.cpu_count() or 1) // worker.state.nthreads)
    with (
        tempfile.TemporaryDirectory(prefix="rebar-unit-", dir=worker.local_directory) as scratch,
        BlenderProcesses() as blender,
    ):
        staging = Staging(Path(scratch))
        if cage is not None:
            staging.cage.write_bytes(cage)
        try:
            result = render_unit(unit, staging, _make_progress_reporter(worker), threads, blender, worker.address)
        except BuildError as error:
            raise type(error)(f"worker {worker.address}: {error}") from None
        except InputError as error:
            raise InputError(f"worker {worker.address}: {error}") from None
        return with_files(result, unit, staging)


def _make_progress_reporter(worker: Any) -> OnViewDone:
    """Return a callback that reports each view to the parent and raises ``BuildError`` for a cancelled unit."""
    key = worker.get_current_task()

    def report_view(index: int) -> None:
        task = worker.state.tasks.get(key)
        if task is None or task.state == "cancelled":
            raise BuildError("the build that requested this unit has ended")
        worker.log_event(key, index)

    return report_view
