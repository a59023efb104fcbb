"""Renderer interface, and its implementation with Blender processes on this machine.

The implementation for clusters is ``dask_renderer``.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

from dataset_builder.pipeline.blender_process import BlenderProcesses, Event, RenderTask
from dataset_builder.pipeline.devices import DeviceShares
from dataset_builder.pipeline.shards import Staging
from dataset_builder.pipeline.work_units import UnitResult, WorkUnit
from rebar_depth_bench.data.digests import file_sha256

OnViewDone = Callable[[int], None]
"""Callback with the index of each rendered view; may run in another thread, and twice for the same view."""


class Renderer(Protocol):
    """Renderer of work units; leaving the context that created it cancels unfinished units."""

    def submit(self, unit: WorkUnit, staging: Staging, on_view_done: OnViewDone) -> Future[UnitResult]:
        """Schedule ``unit``; ``staging`` is the staging folder of the config on this machine."""
        ...


@dataclass(frozen=True)
class LocalRenderer:
    """Renderer on this machine that writes directly to the staging folder: a kill loses at most one view."""

    pool: ThreadPoolExecutor
    blender: BlenderProcesses
    threads: int
    devices: DeviceShares

    def submit(self, unit: WorkUnit, staging: Staging, on_view_done: OnViewDone) -> Future[UnitResult]:
        """Schedule ``unit`` on the next free process."""
        return self.pool.submit(self._render, unit, staging, on_view_done)

    def _render(self, unit: WorkUnit, staging: Staging, on_view_done: OnViewDone) -> UnitResult:
        with self.devices.least_busy() as index:
            return render_unit(unit, staging, self.threads, self.blender, on_view_done, "this machine", index)


@contextmanager
def local_processes(workers: int, threads: int, devices: int = 1) -> Iterator[LocalRenderer]:
    """Yield a renderer with ``workers`` concurrent Blender processes per device, of ``threads`` threads each."""
    with ThreadPoolExecutor(workers * devices) as pool, BlenderProcesses() as blender:
        yield LocalRenderer(pool, blender, threads, DeviceShares(devices))


def render_unit(
    unit: WorkUnit,
    staging: Staging,
    threads: int,
    blender: BlenderProcesses,
    on_view_done: OnViewDone,
    worker: str,
    device_index: int = 0,
) -> UnitResult:
    """Render a unit in a Blender process into ``staging`` and return its result without row and mesh bytes.

    A GPU is number ``device_index`` of the type that the config names.

    Raises the ``InputError``, ``BuildError`` or ``OutputError`` that the process reports, and
    ``RenderProcessError`` naming the unit if the process dies twice.
    """
    seconds: defaultdict[str, float] = defaultdict(float)

    def on_event(event: Event) -> None:
        for stage, duration_s in event["seconds"].items():
            seconds[stage] += duration_s
        if "view" in event:
            on_view_done(event["view"])

    blender.run(RenderTask(unit, staging, threads, device_index), unit.label, staging.log(unit.shard), on_event)
    return UnitResult(worker, dict(seconds), file_sha256(staging.mesh))
