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
from pathlib import Path

from dataset_builder.cameras.camera_fit import check_fits
from dataset_builder.catalog.named_configs import BuildRequest
from dataset_builder.pipeline.blender_process import Submit, local_processes
from dataset_builder.pipeline.disk_space import check_readable, check_space, spaces_by_config
from dataset_builder.pipeline.folder import build_lock, check_target, remove_build_folder, remove_stagings
from dataset_builder.pipeline.plan import (
    BUILD_FOLDER,
    ConfigPlan,
    by_config,
    place_cameras,
    plan_config,
    print_notes,
)
from dataset_builder.pipeline.publish import publish_plans, remove_leftovers, repair_metadata
from dataset_builder.pipeline.retained import Finished, check_retained, kept_scenes
from dataset_builder.pipeline.work_units import UnitResult, WorkUnit, accept_result, remaining_units
from dataset_builder.scene.model import Note
from dataset_builder.specs.config_specs import SceneConfigSpec
from dataset_builder.specs.file_specs import CageFileSpec, MeshFileSpec
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.base.parallel import Progress, silent
from rebar_depth_bench.base.writing import write_bytes
from rebar_depth_bench.data.manifest import DatasetConfig

_MAX_NAMED = 10
"""Largest number of views that a note names."""


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
    submit: Submit | None = None,
    progress: Progress = silent,
) -> BuildSummary:
    """Build the requested configs in the folder ``out``, or continue an interrupted build of them.

    Rendering uses ``workers`` concurrent processes of ``threads`` threads each on this machine, or what ``submit``
    schedules if it is not None, such as workers of a cluster. None of these changes the bytes of the result. Each
    config is published as soon as it is complete.

    Raises ``InputError`` for a request that cannot be built, ``OutputError`` if it does not fit on the disk or the
    machine cannot write, ``RenderProcessError`` if a render process dies twice, and ``BuildError`` if rendered
    data does not match its digests.
    """
    plans, finished = plan_build(request, out)
    print_notes(finished.notes(plans))
    missing = [plan for plan in plans if not finished.has(plan)]
    check_space(out, spaces_by_config(missing).values())
    missing = place_cameras(missing, os.cpu_count() or 1, progress)
    check_readable(missing, finished)
    with build_lock(out / BUILD_FOLDER):
        try:
            if finished.is_outdated:
                raise InputError(f"{out}: another build has changed the folder; run the same command again")
            remove_leftovers(out, finished.folder)
            with nullcontext(submit) if submit else local_processes(workers, threads) as schedule:
                return _build_plans(out, finished, plans, missing, schedule, progress)
        finally:
            remove_build_folder(out / BUILD_FOLDER)


def plan_build(request: BuildRequest, out: Path) -> tuple[list[ConfigPlan], Finished]:
    """Return the plans of the requested configs, and what the folder ``out`` has; nothing is written.

    Files that the request has not read are read here, each once; notes on them go to standard error. Raises
    ``InputError`` for a request that cannot be built in the folder, such as an unusable mesh file or one whose
    finished views would be lost.
    """
    specs = request.config_specs()
    cages = dict(request.cages_read)
    for spec in specs:
        file = spec.scene.assembly
        if isinstance(file, CageFileSpec | MeshFileSpec) and file not in cages:
            from dataset_builder.user_files.cage_file import read_cage

            cages[file] = read_cage(file)
    plans = [plan_config(spec, request.views, out, cages.get(spec.scene.assembly)) for spec in specs]
    # Cameras of generated scenes are placed later, so that they fit.
    with_cameras = [plan for plan in plans if not isinstance(plan.spec, SceneConfigSpec)]
    for plan in with_cameras:
        check_fits(plan.assembly, plan.spec)
    notes = [note for plan in with_cameras for note in plan.assembly.notes]
    print_notes(list(dict.fromkeys((*request.notes(specs), *notes))))
    check_target(out, {spec.name for spec in specs})
    finished = Finished(out)
    check_retained(out, finished, plans, request.overwrite)
    return plans, finished


def _build_plans(
    out: Path,
    finished: Finished,
    plans: Sequence[ConfigPlan],
    missing: Sequence[ConfigPlan],
    submit: Submit,
    progress: Progress,
) -> BuildSummary:
    """Build the ``missing`` plans config by config, and repair the metadata of the others."""
    summary, folder, missing_by_name = BuildSummary(), finished.folder, by_config(missing)
    for name, plans_of_config in by_config(plans).items():
        if of_config := missing_by_name.get(name):
            for plan in of_config:
                finished.stage_views(plan)
            _render(of_config, submit, progress, summary)
            kept = kept_scenes(finished.configs.get(name), of_config)
            folder = publish_plans(out, folder, of_config, kept)
            print_notes(_steel_notes(folder.config_by_name[name]))
            summary.built.append(name)
        elif folder is not None:
            folder = repair_metadata(out, folder, plans_of_config)
            summary.up_to_date.append(name)
        remove_stagings(out, plans_of_config)
    return summary


def _steel_notes(config: DatasetConfig) -> list[Note]:
    """Return the note that names the views of a config without scored pixels, if there are any."""
    empty = [view.view_id for view in config.views if view.scored_px == 0]
    named = ", ".join(empty[:_MAX_NAMED] + ["..."] * (len(empty) > _MAX_NAMED))
    text = f"{len(empty)} of {len(config.views)} views have no scored pixel: {named}"
    return [Note(config.name, "steel", text)] if empty else []


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


def _render(plans: Sequence[ConfigPlan], submit: Submit, progress: Progress, summary: BuildSummary) -> None:
    """Render and stage the remaining work units of a config's plans; on failure, cancel those not started."""
    count = _ViewCount(plans, progress)
    count.add("")
    waiting: dict[Future[UnitResult], tuple[ConfigPlan, WorkUnit]] = {}
    for plan in plans:
        plan.staging.root.mkdir(parents=True, exist_ok=True)
        units = remaining_units(plan)
        if units and plan.cage is not None:
            from dataset_builder.scene.assemblies.cage import packed_cage

            write_bytes(plan.staging.cage, packed_cage(plan.cage))
        for unit in units:
            waiting[submit(unit, plan.staging, partial(count.add, plan.key))] = plan, unit
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
