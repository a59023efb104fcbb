"""Builds or continues a dataset folder: plan, render in worker processes, pack, publish."""

from __future__ import annotations

import shutil
import threading
from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path

from dataset_builder.assemblies import check_fits, make_assembly
from dataset_builder.blender_process import BlenderProcesses, Event
from dataset_builder.configs import BuildRequest, check_request
from dataset_builder.lock import build_lock
from dataset_builder.plan import BUILD_FOLDER, ConfigPlan, plan_request
from dataset_builder.publish import (
    check_folder,
    check_scenes,
    is_published,
    mend_descriptions,
    publish_config,
    sweep,
)
from dataset_builder.shards import runs_of_views
from dataset_builder.tasks import RenderTask
from rebar_depth_bench.progress import Progress, silent


@dataclass
class BuildSummary:
    """What a build did: configs built, configs found up to date, and where the seconds of its workers went."""

    built: list[str] = field(default_factory=list)
    up_to_date: list[str] = field(default_factory=list)
    seconds: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))


def build(
    request: BuildRequest, out: Path, *, workers: int, threads: int, progress: Progress = silent
) -> BuildSummary:
    """Build the requested configs in ``out``, or continue an interrupted build of the same ones.

    ``workers`` render processes of ``threads`` threads each work at once; neither changes a byte of the
    result. Each config is published as soon as it is complete.

    Raises ``InputError`` for a request that cannot be built, ``RenderProcessError`` when a render process
    dies twice.
    """
    check_request(request)
    plans = plan_request(request, out)
    for plan in plans:  # a bad mesh file is told before anything is written
        check_fits(make_assembly(plan.spec.scene.assembly), plan.spec)
    check_folder(out)
    with build_lock(out / BUILD_FOLDER):
        try:
            sweep(out)
            check_scenes(out, plans)
            return _build_plans(plans, out, workers, threads, progress)
        finally:
            _remove_build_folder(out / BUILD_FOLDER)


def _build_plans(
    plans: Sequence[ConfigPlan], out: Path, workers: int, threads: int, progress: Progress
) -> BuildSummary:
    summary = BuildSummary()
    for plan in plans:
        if is_published(out, plan):
            mend_descriptions(out, plan)
            summary.up_to_date.append(plan.spec.name)
        else:
            _render(plan, workers, threads, progress, summary)
            publish_config(out, plan)
            summary.built.append(plan.spec.name)
        for staging in plan.all_stagings():
            shutil.rmtree(staging, ignore_errors=True)
    return summary


def _render(plan: ConfigPlan, workers: int, threads: int, progress: Progress, summary: BuildSummary) -> None:
    """Run the plan's shards through worker processes; on any failure or interrupt none is left running."""
    plan.staging.root.mkdir(parents=True, exist_ok=True)
    done = {index for index in plan.indices if plan.staging.row(index).is_file()}
    lock = threading.Lock()

    def on_event(event: Event) -> None:
        with lock:
            for stage, spent in event["seconds"].items():
                summary.seconds[stage] += spent
            if "view" in event:
                done.add(event["view"])
            progress(plan.spec.name, len(done), len(plan.indices))

    runs = [run for run in enumerate(runs_of_views(plan.indices)) if not _is_rendered(plan, run[1])]
    with ThreadPoolExecutor(workers) as pool, BlenderProcesses() as blender:
        futures = [
            pool.submit(
                blender.run,
                RenderTask(plan.spec, shard, indices, plan.staging.root, threads),
                f"{plan.spec.name} views {indices[0]} to {indices[-1]}",
                plan.staging.log(shard),
                on_event,
            )
            for shard, indices in runs
        ]
        finished, waiting = wait(futures, return_when=FIRST_EXCEPTION)
        for future in waiting:
            future.cancel()
        for future in finished:
            future.result()


def _is_rendered(plan: ConfigPlan, indices: tuple[int, ...]) -> bool:
    return plan.staging.mesh.is_file() and all(plan.staging.row(index).is_file() for index in indices)


def _remove_build_folder(folder: Path) -> None:
    """Remove the build folder unless unfinished pieces stand in it."""
    if not any(path.is_dir() for path in folder.iterdir()):
        shutil.rmtree(folder)
