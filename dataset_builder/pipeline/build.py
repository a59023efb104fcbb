"""Dataset build: plan, render work units locally or on a cluster, pack shards, publish configs."""

from __future__ import annotations

import os
import threading
from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import partial
from itertools import groupby
from pathlib import Path

from dataset_builder.config.catalog import BuildRequest
from dataset_builder.config.specs import SceneConfigSpec
from dataset_builder.pipeline.disk_space import check_fits_on_disk
from dataset_builder.pipeline.folder import check_folder, remove_build_folder, remove_stagings
from dataset_builder.pipeline.local_renderer import Renderer, local_processes
from dataset_builder.pipeline.notes import print_notes
from dataset_builder.pipeline.place_cameras import place_cameras
from dataset_builder.pipeline.plan import BUILD_FOLDER, ConfigPlan, plan_config
from dataset_builder.pipeline.publish import (
    build_lock,
    is_published,
    publish_config,
    remove_leftovers,
    repair_metadata,
)
from dataset_builder.pipeline.publish_scenes import publish_scenes
from dataset_builder.pipeline.retained import check_retained_configs
from dataset_builder.pipeline.work_units import UnitResult, WorkUnit, accept_result, remaining_units
from dataset_builder.scene.assemblies import check_fits
from rebar_depth_bench.progress import Progress, silent


@dataclass
class BuildSummary:
    """Summary of a build: configs built, configs already up to date, and worker seconds by stage."""

    built: list[str] = field(default_factory=list)
    up_to_date: list[str] = field(default_factory=list)
    seconds: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))


def build(
    request: BuildRequest,
    out: Path,
    *,
    workers: int = 1,
    threads: int = 1,
    devices: int = 1,
    cluster: Renderer | None = None,
    progress: Progress = silent,
) -> BuildSummary:
    """Build the requested configs in the folder ``out``, or continue an interrupted build of them.

    Rendering uses ``workers`` concurrent processes of ``threads`` threads each on this machine, for each of
    ``devices`` devices of the request's type, or the workers of ``cluster`` if it is not None. None of these
    changes the bytes of the result. Each config is published as soon as it is complete.

    Raises ``InputError`` for a request that cannot be built, ``OutputError`` if it does not fit on the disk or the
    machine cannot write, ``RenderProcessError`` if a render process dies twice, and ``BuildError`` if rendered
    data does not match its digests.
    """
    plans = plan_build(request, out)
    check_fits_on_disk(out, plans)
    plans = place_cameras(plans, out, os.cpu_count() or 1, progress)
    with build_lock(out / BUILD_FOLDER):
        try:
            check_retained_configs(out, plans)
            remove_leftovers(out)
            with nullcontext(cluster) if cluster else local_processes(workers, threads, devices) as renderer:
                return _build_plans(plans, out, renderer, progress)
        finally:
            remove_build_folder(out / BUILD_FOLDER)


def plan_build(request: BuildRequest, out: Path) -> list[ConfigPlan]:
    """Return the plans of the requested configs; nothing is written. Notes on their files go to standard error.

    Raises ``InputError`` for a request that cannot be built in the folder ``out``, such as an unusable mesh file.
    """
    plans = [plan_config(spec, request.views, out) for spec in request.config_specs()]
    # Cameras of generated scenes are placed later, so that they fit.
    with_cameras = [plan for plan in plans if not isinstance(plan.spec, SceneConfigSpec)]
    for plan in with_cameras:
        check_fits(plan.assembly, plan.spec)
    print_notes(list(dict.fromkeys(note for plan in with_cameras for note in plan.assembly.notes)))
    check_folder(out, plans)
    return plans


def _build_plans(plans: Sequence[ConfigPlan], out: Path, renderer: Renderer, progress: Progress) -> BuildSummary:
    summary = BuildSummary()
    for name, group in groupby(plans, key=lambda plan: plan.spec.name):
        plans_of_config = list(group)
        missing = [plan for plan in plans_of_config if not is_published(out, plan)]
        if not missing:
            repair_metadata(out, plans_of_config)
            summary.up_to_date.append(name)
        else:
            _render(missing, renderer, progress, summary)
            _publish(out, missing)
            summary.built.append(name)
        for plan in plans_of_config:
            remove_stagings(plan)
    return summary


def _publish(out: Path, plans: Sequence[ConfigPlan]) -> None:
    """Publish the plan of a config of one scene, or those of scenes of one config."""
    if isinstance(plans[0].spec, SceneConfigSpec):
        publish_scenes(out, plans)
    else:
        publish_config(out, plans[0])


class _ViewCount:
    """Thread-safe counter of the distinct staged views of a config, which reports to a progress callback."""

    def __init__(self, plans: Sequence[ConfigPlan], progress: Progress) -> None:
        self._name = plans[0].spec.name
        self._total = sum(len(plan.indices) for plan in plans)
        self._progress = progress
        self._done = {
            (plan.key, index) for plan in plans for index in plan.indices if plan.staging.row(index).is_file()
        }
        self._lock = threading.Lock()

    def add(self, key: str, *indices: int) -> None:
        """Mark views of the plan with a ``key`` as done and report the progress; without any, only report it."""
        with self._lock:
            self._done.update((key, index) for index in indices)
            self._progress(self._name, len(self._done), self._total)


def _render(plans: Sequence[ConfigPlan], renderer: Renderer, progress: Progress, summary: BuildSummary) -> None:
    """Render and stage the remaining work units of a config's plans; on failure, cancel those not started."""
    count = _ViewCount(plans, progress)
    count.add("")
    waiting: dict[Future[UnitResult], tuple[ConfigPlan, WorkUnit]] = {}
    for plan in plans:
        plan.staging.root.mkdir(parents=True, exist_ok=True)
        for unit in remaining_units(plan):
            waiting[renderer.submit(unit, plan.staging, partial(count.add, plan.key))] = plan, unit
    try:
        while waiting:
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                plan, unit = waiting.pop(future)  # Drop the future, which holds the rendered bytes.
                result = future.result()
                accept_result(unit, result, plan.staging)
                for stage, duration_s in result.seconds.items():
                    summary.seconds[stage] += duration_s
                count.add(plan.key, *unit.indices)
    finally:
        for future in waiting:
            future.cancel()
