"""Dataset build: plan, render work units locally or on a cluster, pack shards, publish configs."""

from __future__ import annotations

import os
import threading
from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import Future, as_completed
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import partial
from itertools import groupby
from pathlib import Path

from dataset_builder.config.camera_fit import check_fits
from dataset_builder.config.catalog import BuildRequest
from dataset_builder.config.specs import SceneConfigSpec
from dataset_builder.pipeline.disk_space import check_fits_on_disk, check_readable
from dataset_builder.pipeline.folder import check_folder, remove_build_folder, remove_stagings
from dataset_builder.pipeline.local_renderer import Renderer, local_processes
from dataset_builder.pipeline.notes import print_notes
from dataset_builder.pipeline.place_cameras import place_cameras
from dataset_builder.pipeline.plan import BUILD_FOLDER, ConfigPlan, plan_config
from dataset_builder.pipeline.publish import (
    build_lock,
    publish_plans,
    remove_leftovers,
    repair_metadata,
)
from dataset_builder.pipeline.retained import Finished, check_retained, kept_scenes
from dataset_builder.pipeline.work_units import UnitResult, WorkUnit, accept_result, remaining_units
from rebar_depth_bench.errors import InputError
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
    finished = Finished(out)
    check_retained(out, finished, plans, request.overwrite)
    print_notes(finished.notes(plans))
    missing = [plan for plan in plans if not finished.has(plan)]
    check_fits_on_disk(out, missing, finished)
    missing = place_cameras(missing, os.cpu_count() or 1, progress)
    check_readable(missing, finished)
    with build_lock(out / BUILD_FOLDER):
        try:
            if finished.is_outdated:
                raise InputError(f"{out}: another build has changed the folder; run the same command again")
            remove_leftovers(out, finished.folder)
            with nullcontext(cluster) if cluster else local_processes(workers, threads, devices) as renderer:
                return _build_plans(out, finished, plans, missing, renderer, progress)
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


def _build_plans(
    out: Path,
    finished: Finished,
    plans: Sequence[ConfigPlan],
    missing: Sequence[ConfigPlan],
    renderer: Renderer,
    progress: Progress,
) -> BuildSummary:
    """Build the ``missing`` plans config by config, and repair the metadata of the others."""
    summary, folder = BuildSummary(), finished.folder
    missing_by_name = {name: list(group) for name, group in groupby(missing, key=_name)}
    for name, group in groupby(plans, key=_name):
        plans_of_config = list(group)
        if of_config := missing_by_name.get(name):
            for plan in of_config:
                finished.stage_views(plan)
            _render(of_config, renderer, progress, summary)
            kept = kept_scenes(finished.configs.get(name), of_config)
            folder = publish_plans(out, folder, of_config, kept)
            summary.built.append(name)
        elif folder is not None:
            folder = repair_metadata(out, folder, plans_of_config)
            summary.up_to_date.append(name)
        remove_stagings(out, plans_of_config)
    return summary


def _name(plan: ConfigPlan) -> str:
    return plan.spec.name


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
        for future in as_completed(list(waiting)):
            plan, unit = waiting.pop(future)  # Drop the future, which holds the rendered bytes.
            result = future.result()
            accept_result(unit, result, plan.staging)
            for stage, duration_s in result.seconds.items():
                summary.seconds[stage] += duration_s
            count.add(plan.key, *unit.indices)
    finally:
        for future in waiting:
            future.cancel()
