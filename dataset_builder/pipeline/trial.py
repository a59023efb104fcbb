"""Trial of a config on this machine: a few small views, rendered in a scratch folder, and what they cost.

The views have the config's own scene, sampling and device; only the images are smaller. A render process spends a
constant time on its start, the scene and the first picture, and afterwards a time per view that grows with the
number of pixels.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import sqrt
from statistics import fmean

from dataset_builder.config.specs import ConfigSpec, RigSpec
from dataset_builder.config.trajectories import subset
from dataset_builder.pipeline.blender_process import BlenderProcesses, Event, RenderTask
from dataset_builder.pipeline.plan import generator_versions
from dataset_builder.pipeline.shards import Staging
from dataset_builder.pipeline.work_units import WorkUnit
from rebar_depth_bench.atomic_io import scratch_folder

_VIEWS = 4
"""Views of a trial; the first one tells the constant time of a process from the time per view."""
_PIXELS = 240 * 135
_FULL_SIZE_SAMPLES = 64
"""Samples per pixel above which the images of a trial become smaller, so that it does not take longer."""
_MIN_SIDE = 16
_MEMORY_BYTES_PER_PIXEL = 900
"""Growth of the peak memory of a process with the image size: 880 from 320 x 180 to 640 x 360, 600-800 beyond."""


@dataclass(frozen=True)
class Trial:
    """Cost of rendering a config in one process: wall-clock seconds, processor time and memory.

    ``process_s`` is spent once per process, ``view_s_per_pixel`` on each view of both eyes. ``busy_threads`` is
    the processor time per second: the number of threads if the machine is idle, less if it is busy.
    """

    process_s: float
    view_s_per_pixel: float
    busy_threads: float
    pixels: int
    memory_bytes: int

    def unit_seconds(self, views: int, rig: RigSpec) -> float:
        """Return the seconds that a process takes for a work unit of ``views`` views."""
        return self.process_s + views * self.view_s_per_pixel * rig.width * rig.height

    def process_memory_bytes(self, rig: RigSpec) -> int:
        """Return the peak memory of a process that renders images of the size of ``rig``."""
        return self.memory_bytes + _MEMORY_BYTES_PER_PIXEL * (rig.width * rig.height - self.pixels)


def run_trial(spec: ConfigSpec, indices: Sequence[int], threads: int) -> Trial:
    """Render a few views of ``indices`` at a small size in a process of ``threads`` threads, and measure them.

    Raises what a build raises if it cannot render the config.
    """
    small = replace(spec, rig=trial_rig(spec))
    chosen = tuple(indices[place] for place in subset(len(indices), _VIEWS))
    unit = WorkUnit(small, 0, chosen, False, None, generator_versions())
    views: list[float] = []
    totals: dict[str, float] = {}

    def on_event(event: Event) -> None:
        if "view" in event:
            views.append(sum(event["seconds"].values()))
        totals.update((name, event[name]) for name in ("cpu_s", "memory_bytes") if name in event)

    start = time.perf_counter()
    with scratch_folder("rebar-trial-") as scratch, BlenderProcesses() as blender:
        staging = Staging(scratch)
        blender.run(RenderTask(unit, staging, threads), f"the trial of {spec.name}", staging.log(0), on_event)
    total_s = time.perf_counter() - start
    process_s, view_s = split_times(total_s, views[-len(chosen) :])
    pixels = small.rig.width * small.rig.height
    return Trial(process_s, view_s / pixels, totals["cpu_s"] / total_s, pixels, int(totals["memory_bytes"]))


def split_times(total_s: float, view_s: Sequence[float]) -> tuple[float, float]:
    """Return the constant time of a process and its time per view, from its total and the times of its views.

    The first view includes the transfer of the scene to Cycles. It is left out of the time per view if there are
    others.
    """
    steady_s = fmean(view_s[1:] or view_s)
    return max(0.0, total_s - len(view_s) * steady_s), steady_s


def trial_rig(spec: ConfigSpec) -> RigSpec:
    """Return the rig of a config with images small enough for a trial, of the same shape."""
    rig, samples = spec.rig, spec.colour.steel_samples if spec.colour else 1
    pixels = _PIXELS * min(1.0, _FULL_SIZE_SAMPLES / samples)
    scale = min(1.0, sqrt(pixels / (rig.width * rig.height)))
    width, height = (max(_MIN_SIDE, round(side * scale)) for side in (rig.width, rig.height))
    return replace(rig, width=width, height=height)
