"""Builds or continues a dataset folder: plan, render units of work here or elsewhere, pack, publish."""

from __future__ import annotations

import shutil
import threading
from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path

from dataset_builder.scene.assemblies import check_fits, make_assembly
from dataset_builder.config.catalog import BuildRequest, check_request
from dataset_builder.build.publish import build_lock
from dataset_builder.build.plan import BUILD_FOLDER, ConfigPlan, plan_request
from dataset_builder.build.publish import check_folder, check_kept_files, check_scenes, is_published, mend_descriptions, publish_config, sweep
from dataset_builder.build.local_renderer import Renderer, local_processes
from dataset_builder.build.work_units import receive, units_of
from rebar_depth_bench.progress import Progress, silent


@dataclass
class BuildSummary:
    """What a build did: configs built, configs found up to date, and where the seconds of its workers went."""

    built: list[str] = field(default_factory=list)
    up_to_date: list[str] = field(default_factory=list)
    seconds: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))


def build(
    request: BuildRequest,
    out: Path,
    *,
    workers: int = 1,
    threads: int = 1,
    cluster: Renderer | None = None,
    progress: Progress = silent,
) -> BuildSummary:
    """Build the requested configs in ``out``, or continue an interrupted build of the same ones.

    ``workers`` render processes of ``threads`` threads each work at once on this machine, or the machines of a
    ``cluster`` do; none of them changes a byte of the result. Each config is published as soon as it is complete.

    Raises ``InputError`` for a request that cannot be built, ``RenderProcessError`` when a render process
    dies twice, ``BuildError`` where what came back does not match.
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
            check_kept_files(out, plans)
            with nullcontext(cluster) if cluster else local_processes(workers, threads) as renderer:
                return _build_plans(plans, out, renderer, progress)
        finally:
            _remove_build_folder(out / BUILD_FOLDER)


def _build_plans(plans: Sequence[ConfigPlan], out: Path, renderer: Renderer, progress: Progress) -> BuildSummary:
    summary = BuildSummary()
    for plan in plans:
        if is_published(out, plan):
            mend_descriptions(out, plan)
            summary.up_to_date.append(plan.spec.name)
        else:
            _render(plan, renderer, progress, summary)
            publish_config(out, plan)
            summary.built.append(plan.spec.name)
        for staging in plan.all_stagings():
            shutil.rmtree(staging, ignore_errors=True)
    return summary


class _ViewCount:
    """Counts a plan's staged views, each once, and tells the progress. Safe to call from any thread."""

    def __init__(self, plan: ConfigPlan, progress: Progress) -> None:
        self._plan = plan
        self._progress = progress
        self._done = {index for index in plan.indices if plan.staging.row(index).is_file()}
        self._lock = threading.Lock()

    def add(self, *indices: int) -> None:
        """Count views as done; with none, tell how far the build is."""
        with self._lock:
            self._done.update(indices)
            self._progress(self._plan.spec.name, len(self._done), len(self._plan.indices))


def _render(plan: ConfigPlan, renderer: Renderer, progress: Progress, summary: BuildSummary) -> None:
    """Render and stage what is left of the plan; on any failure or interrupt nothing more is started."""
    plan.staging.root.mkdir(parents=True, exist_ok=True)
    count = _ViewCount(plan, progress)
    count.add()
    waiting = {renderer.submit(unit, plan.staging, count.add): unit for unit in units_of(plan)}
    try:
        while waiting:
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                unit = waiting.pop(future)  # and with it its bytes, which may be many
                delivery = future.result()
                receive(unit, delivery, plan.staging)
                for stage, spent in delivery.seconds.items():
                    summary.seconds[stage] += spent
                count.add(*unit.indices)
    finally:
        for future in waiting:
            future.cancel()


def _remove_build_folder(folder: Path) -> None:
    """Remove the build folder unless unfinished pieces stand in it."""
    if not any(path.is_dir() for path in folder.iterdir()):
        shutil.rmtree(folder)
