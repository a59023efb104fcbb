"""Benchmark of dataset builds: time per stage and scene, speed-up by a second worker, estimate for all configs.

python -m benchmarks.build [VIEWS] [CONFIG ...]
"""

from __future__ import annotations

import os
import resource
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from benchmarks.timing import machine_description, print_markdown
from dataset_builder.cameras.trajectories import view_count
from dataset_builder.catalog.named_configs import CONFIGS, BuildRequest
from dataset_builder.pipeline.build import build
from dataset_builder.pipeline.shards import VIEWS_PER_SHARD

SCENES = ("lattice", "pile", "pier")
STAGES = ("colour", "truth", "encode", "scene", "write")
CORES = os.cpu_count() or 1
SCALING = BuildRequest(("lattice",), views=2 * VIEWS_PER_SHARD, width=320, height=180)
"""Two work units, one per worker; small views, since each worker has only one thread."""


@dataclass(frozen=True)
class Run:
    """Timing of one build: wall-clock seconds, and seconds of all workers by stage."""

    views: int
    workers: int
    wall_s: float
    seconds: dict[str, float]

    @property
    def waiting_s(self) -> float:
        """Worker seconds outside all stages: process start, packing, publishing and idle time."""
        return self.wall_s * self.workers - sum(self.seconds.values())


def main(views: str = "8", *configs: str) -> None:
    count = int(views)
    print(f"{count} stereo views at 1280 x 720 of each; {machine_description()}\n")
    runs = {config: _run(BuildRequest((config,), count), 1, CORES) for config in configs or SCENES}
    headings = [
        "scene",
        *(f"{stage}, s a view" for stage in STAGES),
        "waiting",
        "all",
        "outside Cycles and Embree",
    ]
    print_markdown(headings, [_row(config, run) for config, run in runs.items()])
    peak_gb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e6
    print(f"\npeak memory of a render process: {peak_gb:.2f} GB")
    one_worker, two_workers = (_run(SCALING, workers, threads=1) for workers in (1, 2))
    print(
        f"{SCALING.views} views of {SCALING.width} x {SCALING.height}: "
        f"2 single-threaded workers are {one_worker.wall_s / two_workers.wall_s:.2f} times as fast as 1"
    )
    print(f"\n{_full_set_estimate(runs)}")


def _run(request: BuildRequest, workers: int, threads: int) -> Run:
    with tempfile.TemporaryDirectory() as scratch:
        start = time.perf_counter()
        summary = build(request, Path(scratch) / "dataset", workers=workers, threads=threads)
        return Run(request.views or 0, workers, time.perf_counter() - start, dict(summary.seconds))


def _row(config: str, run: Run) -> list[str]:
    outside = 1 - (run.seconds["colour"] + run.seconds["truth"]) / run.wall_s
    cells = [f"{seconds / run.views:.2f}" for seconds in _by_stage(run)]
    return [f"`{config}`", *cells, f"{run.wall_s / run.views:.2f}", f"{outside:.1%}"]


def _by_stage(run: Run) -> list[float]:
    return [*(run.seconds[stage] for stage in STAGES), run.waiting_s]


def _full_set_estimate(runs: dict[str, Run]) -> str:
    """Return the time estimate for all configs, assuming the measured seconds per view of each scene."""
    seconds_per_view = {
        CONFIGS[config]().scene.assembly.kind: run.wall_s / run.views for config, run in runs.items()
    }
    specs = [make() for make in CONFIGS.values()]
    missing = sorted({spec.scene.assembly.kind for spec in specs} - set(seconds_per_view))
    if missing:
        return f"no estimate for the full set: {', '.join(missing)} not measured"
    views = {spec.name: view_count(spec.protocol) for spec in specs}
    hours = sum(views[spec.name] * seconds_per_view[spec.scene.assembly.kind] for spec in specs) / 3600
    return f"the full set, {len(specs)} configs of {sum(views.values())} views: {hours:.0f} hours on this machine"


if __name__ == "__main__":
    main(*sys.argv[1:])
