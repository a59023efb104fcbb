"""Benchmark of dataset loading: overhead over the decoders, and views per second of training batches.

python -m benchmarks.loader ROOT [CONFIG [SPLIT]]

``load`` and ``torch_loader`` are compared with the bare decoders on the same bytes. Then ``torch_loader`` loads
left views with several workers, streaming or not, with and without crops and flips. The time of the processor
includes that of the workers, and shows the cost where other programs use the processor too.
"""

from __future__ import annotations

import statistics
import sys
import time
from itertools import product
from os import times
from typing import Any

import rebar_depth_bench as rdb
from benchmarks.timing import machine_description, median_seconds, print_markdown
from rebar_depth_bench.base.names import TEST_SPLIT
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.rows import decode_row
from rebar_depth_bench.data.schema import COLUMNS
from rebar_depth_bench.data.shards import encoded_rows

REPEATS = 7
WORKERS = (0, 1, 2)
BATCH = 4
LEFT = ("view_id", "left_rgb", "left_depth", "left_mask", "left_K", "left_cam_from_world")


def main(root: str, config: str = "lattice", split: str = TEST_SPLIT) -> None:
    print(f"{machine_description()}; medians of {REPEATS}\n")
    print_overhead(root, config, split)
    print()
    print_throughput(root, config, split)


def print_overhead(root: str, config: str, split: str) -> None:
    located = open_folder(root).config(config).of_split(split)
    raw = list(encoded_rows(located, COLUMNS))
    loaded = rdb.load(root, config, split=split)
    loader = rdb.torch_loader(loaded, batch_size=1)
    raw_left = [{name: row[name] for name in LEFT} for row in raw]
    print(f"{len(raw)} views, one process\n")
    timings = {
        "all columns: bare decoders": median_seconds(lambda: [decode_row(located, row) for row in raw], REPEATS),
        "all columns: rdb.load": median_seconds(lambda: list(loaded), REPEATS),
        "left view: bare decoders": median_seconds(
            lambda: [decode_row(located, row) for row in raw_left], REPEATS
        ),
        "left view: rdb.torch_loader": median_seconds(lambda: list(loader), REPEATS),
    }
    bare = {name.partition(":")[0]: seconds for name, seconds in timings.items() if "bare" in name}
    table = [
        (name, f"{1e3 * seconds / len(raw):.1f}", f"{seconds / bare[name.partition(':')[0]]:.2f}")
        for name, seconds in timings.items()
    ]
    print_markdown(["", "ms a view", "times bare"], table)


def print_throughput(root: str, config: str, split: str) -> None:
    """Print the speed of shuffled epochs; the repetitions of all cases take turns."""
    height, width = open_folder(root).config(config).grid
    crop = (height * 3 // 4, width * 3 // 4)
    loaders = {
        (streaming, changed, workers): rdb.torch_loader(
            rdb.load(root, config, split=split, streaming=streaming, columns=LEFT),
            BATCH,
            workers,
            shuffle=True,
            crop=crop if changed else None,
            flip=changed,
        )
        for streaming, changed, workers in product((False, True), (False, True), WORKERS)
    }
    views = len(open_folder(root).config(config).of_split(split).views)
    measured: dict[Any, list[tuple[float, float]]] = {case: [] for case in loaders}
    for _ in range(REPEATS + 1):
        for case, loader in loaders.items():
            measured[case].append(epoch_seconds(loader))
    print(
        f"{views} left views of {width} x {height}, batches of {BATCH}, shuffled; crops of {crop[1]} x {crop[0]}\n"
    )
    table = []
    for (streaming, changed, workers), seconds in measured.items():
        wall_s, processor_s = (statistics.median(values) for values in zip(*seconds[1:], strict=True))
        table.append(
            (
                "streaming" if streaming else "from the cache",
                "crop and flip" if changed else "whole views",
                workers,
                f"{views / wall_s:.0f}",
                f"{1e3 * processor_s / views:.1f}",
            )
        )
    print_markdown(["", "", "workers", "views a second", "processor, ms a view"], table)


def epoch_seconds(loader: Any) -> tuple[float, float]:
    """Return the wall-clock and processor seconds of an epoch, with those of the workers, which have ended."""
    before, start = sum(times()[:4]), time.perf_counter()
    for _ in loader:
        pass
    return time.perf_counter() - start, sum(times()[:4]) - before


if __name__ == "__main__":
    main(*sys.argv[1:])
