"""Where the seconds of a build go, per stereo view, and the peak memory of its processes.

python -m benchmarks.build [VIEWS] [CONFIG]
"""

from __future__ import annotations

import os
import resource
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.timing import machine, print_markdown
from dataset_builder.build import build
from dataset_builder.configs import BuildRequest


def main(views: str = "8", config: str = "lattice") -> None:
    count = int(views)
    print(f"{config}, {count} stereo views at 1280 x 720, 16 samples, 1 worker; {machine()}\n")
    with tempfile.TemporaryDirectory() as scratch:
        start = time.perf_counter()
        request = BuildRequest(configs=(config,), views=count)
        summary = build(request, Path(scratch) / "dataset", workers=1, threads=os.cpu_count() or 1)
        wall_s = time.perf_counter() - start
    seconds: dict[str, float] = dict(summary.seconds)
    seconds["processes, packing, publishing"] = wall_s - sum(seconds.values())
    colour_s = seconds["colour"]
    table = [
        (stage, f"{spent / count:.2f}", f"{spent / wall_s:.1%}", f"{spent / colour_s:.3f}")
        for stage, spent in sorted(seconds.items(), key=lambda item: -item[1])
    ]
    table.append(("all", f"{wall_s / count:.2f}", "100.0%", f"{wall_s / colour_s:.3f}"))
    print_markdown(["stage", "s a stereo view", "share of the build", "times colour"], table)
    outside = wall_s - seconds["colour"] - seconds["truth"]
    peak_gb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e6
    print(f"\noutside Cycles and Embree: {outside / wall_s:.1%} of the build")
    print(f"peak memory of a render process: {peak_gb:.2f} GB")


if __name__ == "__main__":
    main(*sys.argv[1:])
