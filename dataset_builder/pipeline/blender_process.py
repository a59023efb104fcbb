"""Blender subprocesses: their tasks and events, the rendering of work units in them, and the choice of a device.

A task is pickled to the standard input of the process. The input then stays open, and the process exits when it is
closed, so that no render outlives its parent. Events are JSON lines on the standard output of the process. The
output of Blender and its libraries goes to a log file, whose end is shown only if the process fails.

Workers of a cluster render with ``dask_renderer``.
"""

from __future__ import annotations

import json
import pickle
import signal
import subprocess
import sys
import threading
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dataset_builder.pipeline.shards import Staging
from dataset_builder.pipeline.work_units import UnitResult, WorkUnit
from dataset_builder.specs.config_specs import CPU, GPU_TYPES
from rebar_depth_bench.base.errors import BuildError, InputError, OutputError, RebarDepthError, RenderProcessError
from rebar_depth_bench.base.writing import scratch_folder
from rebar_depth_bench.data.files import file_sha256
from rebar_depth_bench.geometry.cameras import Camera


@dataclass(frozen=True)
class RenderTask:
    """Task that renders the views of a unit into a staging folder.

    The task is idempotent: views that are already staged are skipped, and interruptions do not change the bytes.
    It fails before rendering if the unit has a ``mesh_sha256`` and the mesh of the scene has another one.
    """

    unit: WorkUnit
    staging: Staging
    threads: int


@dataclass(frozen=True)
class DepthTask:
    """Task that renders the planar depth of a mesh file with Cycles: one float32 .npy in ``out`` per camera."""

    mesh: Path
    cameras: tuple[Camera, ...]
    out: Path
    threads: int


@dataclass(frozen=True)
class DevicesTask:
    """Task that lists the devices of Cycles: one event ``devices`` with the names of the devices by type."""


Task = RenderTask | DepthTask | DevicesTask


Event = Mapping[str, Any]
ERRORS: Mapping[str, type[RebarDepthError]] = {
    "input_error": InputError,
    "build_error": BuildError,
    "output_error": OutputError,
}
"""Exception type by the key of the event that reports it; such an event ends the task."""
ATTEMPTS = 2
"""Number of times a task is started before a dying process is an error."""
_LOG_TAIL_LINES = 15


class BlenderProcesses:
    """Runner of tasks in Blender processes; leaving the context kills the processes still running."""

    def __init__(self) -> None:
        self._running: set[subprocess.Popen[bytes]] = set()
        self._lock = threading.Lock()
        self._closed = False

    def __enter__(self) -> BlenderProcesses:
        return self

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._closed = True
            for process in self._running:
                process.kill()

    def run(self, task: Task, label: str, log: Path, on_event: Callable[[Event], None]) -> None:
        """Run ``task`` in a new process and pass its events to ``on_event``.

        A process that dies is restarted once. ``label`` names the task in errors; the output of Blender is written
        to ``log``. Raises ``RenderProcessError`` if the process dies twice, and the ``InputError``, ``BuildError``
        or ``OutputError`` that the process reports.
        """
        for attempt in range(1, ATTEMPTS + 1):
            status = self._run_once(task, log, on_event)
            if status == 0:
                return
            if self._closed or attempt == ATTEMPTS:
                raise RenderProcessError(_failure_message(label, status, attempt, log))

    def _run_once(self, task: Task, log: Path, on_event: Callable[[Event], None]) -> int:
        log.parent.mkdir(parents=True, exist_ok=True)
        with self._start(log) as process:
            try:
                return _exchange(process, task, on_event)
            except BaseException:
                process.kill()
                raise
            finally:
                with self._lock:
                    self._running.discard(process)

    def _start(self, log: Path) -> subprocess.Popen[bytes]:
        with self._lock:
            if self._closed:
                raise RenderProcessError("the build is ending; no further render process is started")
            process = subprocess.Popen(
                [sys.executable, "-P", "-m", "dataset_builder.blender", str(log)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                start_new_session=True,
            )
            self._running.add(process)
            return process


def _exchange(process: subprocess.Popen[bytes], task: Task, on_event: Callable[[Event], None]) -> int:
    """Send the task, dispatch the events, and return the exit status of the process."""
    assert process.stdin is not None
    assert process.stdout is not None
    _send_task(process.stdin, task)
    for line in process.stdout:
        if not line.endswith(b"\n"):
            break  # The process died while writing an event.
        event = json.loads(line)
        for name in ERRORS.keys() & event.keys():
            raise ERRORS[name](event[name])
        on_event(event)
    return process.wait()


def _send_task(stream: Any, task: Task) -> None:
    try:
        stream.write(pickle.dumps(task))
        stream.flush()
    except BrokenPipeError:  # The process died at once; its exit status and log are reported by the caller.
        with suppress(BrokenPipeError):
            stream.close()  # Discard the unsent bytes: Popen would otherwise flush them again on exit.


def _failure_message(label: str, status: int, attempts: int, log: Path) -> str:
    reason = f"signal {signal.Signals(-status).name}" if status < 0 else f"exit status {status}"
    tail = log.read_text("utf-8", errors="replace").splitlines()[-_LOG_TAIL_LINES:] if log.is_file() else []
    log_excerpt = "\n".join(f"  | {line}" for line in tail) or "  | (no output)"
    return (
        f"the render process for {label} died {attempts} times, the last time with {reason}; "
        f"end of {log}:\n{log_excerpt}"
    )


OnViewDone = Callable[[int], None]
"""Callback with the index of each rendered view; may run in another thread, and twice for the same view."""


Submit = Callable[[WorkUnit, Staging, OnViewDone], Future[UnitResult]]
"""Function that schedules a unit to be rendered; ``staging`` is the staging folder of the config on this machine.

Leaving the context that made the function cancels unfinished units.
"""


@contextmanager
def local_processes(workers: int, threads: int) -> Iterator[Submit]:
    """Yield the function that renders in ``workers`` concurrent processes of ``threads`` threads each.

    They write directly to the staging folder: a kill loses at most one view.
    """
    with ThreadPoolExecutor(workers) as pool, BlenderProcesses() as blender:

        def submit(unit: WorkUnit, staging: Staging, on_view_done: OnViewDone) -> Future[UnitResult]:
            return pool.submit(render_unit, unit, staging, on_view_done, threads, blender, "this machine")

        yield submit


def render_unit(
    unit: WorkUnit,
    staging: Staging,
    on_view_done: OnViewDone,
    threads: int,
    blender: BlenderProcesses,
    worker: str,
) -> UnitResult:
    """Render a unit in a Blender process into ``staging`` and return its result without the content of files.

    Raises the ``InputError``, ``BuildError`` or ``OutputError`` that the process reports, and
    ``RenderProcessError`` naming the unit if the process dies twice.
    """
    seconds: defaultdict[str, float] = defaultdict(float)

    def on_event(event: Event) -> None:
        for stage, duration_s in event["seconds"].items():
            seconds[stage] += duration_s
        if "view" in event:
            on_view_done(event["view"])

    blender.run(RenderTask(unit, staging, threads), unit.label, staging.log(unit.shard), on_event)
    return UnitResult(worker, dict(seconds), file_sha256(staging.mesh))


AUTO = "auto"
"""Choice of the best type of device that the machine has."""

DeviceNames = Mapping[str, Sequence[str]]
"""Names of the devices by type, ``cpu`` or one of ``GPU_TYPES``; types without devices are absent."""


def find_device(requested: str) -> str:
    """Return the type of device for a value of ``--device`` on this machine.

    Raises what ``choose_device`` raises, and ``RenderProcessError`` if Blender fails while it lists the devices.
    """
    return CPU if requested == CPU else choose_device(requested, available_devices(), "this machine")


def available_devices() -> DeviceNames:
    """Return the devices of this machine, as Cycles lists them in a Blender process."""
    found: dict[str, list[str]] = {}

    def on_event(event: Event) -> None:
        found.update(event["devices"])

    with scratch_folder("rebar-devices-") as scratch, BlenderProcesses() as blender:
        blender.run(DevicesTask(), "the list of devices", scratch / "blender.log", on_event)
    return found


def choose_device(requested: str, available: DeviceNames, machine: str) -> str:
    """Return the type of device that is ``requested``, or the best available type for ``auto``.

    Only the type is part of a config's key, so that equal GPUs give equal keys; GPUs of different models may
    differ in the last bit of a pixel. Rendering on a GPU is untested: no machine with one was at hand.

    Raises ``InputError`` that lists the devices of ``machine`` if it has none of this type.
    """
    if requested == AUTO:
        requested = next((name for name in GPU_TYPES if available.get(name)), CPU)
    if requested != CPU and not available.get(requested):
        listed = [f"{device} ({', '.join(names)})" for device, names in available.items()]
        raise InputError(
            f"--device {requested}: {machine} has no such device, expected one of those that Cycles finds: "
            f"{'; '.join(listed) or CPU}"
        )
    return requested
