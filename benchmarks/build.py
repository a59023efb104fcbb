"""Where the seconds of a build go in each scene, what a second worker brings, and what the full set would take.

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

from benchmarks.timing import machine, print_markdown
from dataset_builder.build.build import build
from dataset_builder.build.shards import VIEWS_PER_SHARD
from dataset_builder.config.catalog import CONFIGS, BuildRequest
from dataset_builder.config.trajectories import offsets_m

SCENES = ("lattice", "pile", "pier")
STAGES = ("colour", "truth", "encode", "scene", "write")
CORES = os.cpu_count() or 1
SCALING = BuildRequest(("lattice",), views=2 * VIEWS_PER_SHARD, width=320, height=180)
"""Two units of work, one a worker; small, since one thread is slow."""


@dataclass(frozen=True)
class Run:
    """One build: its wall-clock seconds, and its workers' seconds by stage."""

    views: int
    workers: int
    wall_s: float
    seconds: dict[str, float]

    @property
    def waiting_s(self) -> float:
        """Seconds in which a worker's time was spent on no stage: starting, packing, publishing, idling."""
        return self.wall_s * self.workers - sum(self.seconds.values())


def main(views: str = "8", *configs: str) -> None:
    count = int(views)
    print(f"{count} stereo views at 1280 x 720 of each; {machine()}\n")
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
    one, two = (_run(SCALING, workers, threads=1) for workers in (1, 2))
    print(
        f"{SCALING.views} views of {SCALING.width} x {SCALING.height}: "
        f"2 single-threaded workers are {one.wall_s / two.wall_s:.2f} times as fast as 1"
    )
    print(f"\n{_full_set(runs)}")


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


def _full_set(runs: dict[str, Run]) -> str:
    """Return the estimate for all configs: each takes as long a view as its scene's benchmarked config."""
    known = {CONFIGS[config]().scene.assembly.kind: run.wall_s / run.views for config, run in runs.items()}
    specs = [make() for make in CONFIGS.values()]
    missing = sorted({spec.scene.assembly.kind for spec in specs} - set(known))
    if missing:
        return f"no estimate for the full set: {', '.join(missing)} not measured"
    views = {spec.name: len(offsets_m(spec.protocol)) for spec in specs}
    hours = sum(views[spec.name] * known[spec.scene.assembly.kind] for spec in specs) / 3600
    return f"the full set, {len(specs)} configs of {sum(views.values())} views: {hours:.0f} hours on this machine"


if __name__ == "__main__":
    main(*sys.argv[1:])
