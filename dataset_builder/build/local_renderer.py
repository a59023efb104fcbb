"""Where units are rendered: Blender processes on this machine, or on others (``cluster.py``)."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

from dataset_builder.build.blender_process import BlenderProcesses, Event
from dataset_builder.build.shards import Staging
from dataset_builder.build.blender_process import RenderTask
from dataset_builder.build.work_units import Delivery, Unit
from rebar_depth_bench.data.digests import file_sha256

OnView = Callable[[int], None]
"""Told the index of each view that is rendered; may be called in another thread, and twice for one view."""


class Renderer(Protocol):
    """Takes units; leaving the context it came from cancels and ends what is not finished."""

    def submit(self, unit: Unit, staging: Staging, on_view: OnView) -> Future[Delivery]:
        """Render ``unit`` some time; ``staging`` is the config's folder on this machine."""
        ...


@dataclass(frozen=True)
class LocalRenderer:
    """Renders units on this machine, straight into the staging folder: a kill loses one view at most."""

    pool: ThreadPoolExecutor
    blender: BlenderProcesses
    threads: int

    def submit(self, unit: Unit, staging: Staging, on_view: OnView) -> Future[Delivery]:
        """Render ``unit`` in the next free process."""
        return self.pool.submit(render_unit, unit, staging, self.threads, self.blender, on_view, "this machine")


@contextmanager
def local_processes(workers: int, threads: int) -> Iterator[LocalRenderer]:
    """Yield a renderer of ``workers`` Blender processes at once on this machine, ``threads`` threads each."""
    with ThreadPoolExecutor(workers) as pool, BlenderProcesses() as blender:
        yield LocalRenderer(pool, blender, threads)


def render_unit(
    unit: Unit,
    staging: Staging,
    threads: int,
    blender: BlenderProcesses,
    on_view: OnView,
    worker: str,
) -> Delivery:
    """Render a unit in a Blender process into ``staging`` and return its delivery, which carries no bytes.

    Raises ``InputError`` and ``BuildError`` in the process's words, ``RenderProcessError`` that names the unit
    when the process dies twice.
    """
    seconds: defaultdict[str, float] = defaultdict(float)

    def on_event(event: Event) -> None:
        for stage, spent in event["seconds"].items():
            seconds[stage] += spent
        if "view" in event:
            on_view(event["view"])

    task = RenderTask(unit.config, unit.shard, unit.indices, staging.root, threads, unit.mesh_sha256)
    blender.run(task, unit.what, staging.log(unit.shard), on_event)
    return Delivery(worker, dict(seconds), file_sha256(staging.mesh))
