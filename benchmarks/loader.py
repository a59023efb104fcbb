"""Benchmark of dataset loading: overhead of ``load`` and ``torch_loader`` over the decoders on the same bytes.

python -m benchmarks.loader ROOT [CONFIG]
"""

from __future__ import annotations

import sys
from typing import Any

import datasets

import rebar_depth_bench as rdb
from benchmarks.timing import machine_description, median_seconds, print_markdown
from rebar_depth_bench.data.columns import features
from rebar_depth_bench.data.decoding import RowDecoder
from rebar_depth_bench.data.manifest import open_folder

REPEATS = 7


def main(root: str, config: str = "lattice") -> None:
    undecoded = features(decode_images=False)
    raw: list[dict[str, Any]] = list(datasets.load_dataset(root, config, split="test").cast(undecoded))
    decoder = RowDecoder.of(open_folder(root).config(config))
    loaded = rdb.load(root, config)
    loader = rdb.torch_loader(loaded, batch_size=1)
    left = ("view_id", "left_rgb", "left_depth", "left_mask", "left_K", "left_cam_from_world")
    raw_left = [{name: row[name] for name in left} for row in raw]
    print(f"{len(raw)} views, medians of {REPEATS}, one process; {machine_description()}\n")
    timings = {
        "all columns: bare decoders": median_seconds(lambda: [decoder.row(row) for row in raw], REPEATS),
        "all columns: rdb.load": median_seconds(lambda: list(loaded), REPEATS),
        "left view: bare decoders": median_seconds(lambda: [decoder.row(row) for row in raw_left], REPEATS),
        "left view: rdb.torch_loader": median_seconds(lambda: list(loader), REPEATS),
    }
    bare = {name.partition(":")[0]: seconds for name, seconds in timings.items() if "bare" in name}
    table = [
        (name, f"{1e3 * seconds / len(raw):.1f}", f"{seconds / bare[name.partition(':')[0]]:.2f}")
        for name, seconds in timings.items()
    ]
    print_markdown(["", "ms a view", "times bare"], table)


if __name__ == "__main__":
    main(*sys.argv[1:])
