"""Reference results: every method that runs on a plain CPU with nothing fetched, on a subset of every scene.

``python -m benchmarks.reference OUT`` renders the subset into OUT/dataset, runs the methods into OUT/NAME.zip,
scores them and writes ``cards/reference.json``, from which the benchmark card's table is made. It takes hours;
stopped and run again, it goes on with the archives that are missing or older than the dataset.
"""

from __future__ import annotations

import json
import statistics
import sys
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from cards.benchmark import RESULTS
from dataset_builder.cli import main as rebar_build
from rebar_depth_bench import score
from rebar_depth_bench.atomic_io import write_text
from rebar_depth_bench.cli.main import main as rebar_bench
from rebar_depth_bench.submission import config_of
from rebar_depth_bench.submission.metadata import METADATA_NAME


@dataclass(frozen=True)
class Subset:
    """What is rendered of each config: so many of its views, spread evenly, so large, with so many samples."""

    views: int = 72
    width: int = 640
    height: int = 360
    samples: int = 4


SUBSET = Subset()
WITH_BOARD = ("lattice", "pile")
ALL = (*WITH_BOARD, "pier")

RUNS: Mapping[str, tuple[str, ...]] = {
    "sgbm": ALL,
    "sgbm-filled": ALL,
    "sweep-aruco": WITH_BOARD,
    "sweep-anchored": ("pier",),
    "lidar-mobile": ("pier",),
    "constant": ALL,
    "board-plane": WITH_BOARD,
    "noisy-truth": ALL,
    "truth": ALL,
}
"""Which method runs on which configs. The pier has no board: only there the truth anchors. The others are nearer
than the scanner's least range. ``lidar-survey`` is left out: it takes about 25 s of a core for each view."""


def main(out: Path) -> int:
    """Make what is missing and write the results; return the exit status."""
    root = out / "dataset"
    size = ("--width", SUBSET.width, "--height", SUBSET.height, "--samples", SUBSET.samples)
    build = ("--out", root, "--config", *ALL, "--views", SUBSET.views, *size)
    if status := rebar_build(list(map(str, build))):
        return status
    for method, configs in RUNS.items():
        archive = out / f"{method}.zip"
        predict = ("predict", method, "--data", root, "--out", archive, "--config", *configs)
        if _is_stale(archive, root) and (status := rebar_bench(list(map(str, predict)))):
            return status
    results = {method: _result(out / f"{method}.zip", root) for method in RUNS}
    found = {"command": "python -m benchmarks.reference OUT", "subset": asdict(SUBSET), "results": results}
    write_text(RESULTS, json.dumps(found, indent=1, allow_nan=False) + "\n")
    return 0


def _is_stale(archive: Path, root: Path) -> bool:
    return not archive.is_file() or archive.stat().st_mtime < (root / "manifest.json").stat().st_mtime


def _result(archive: Path, root: Path) -> dict[str, Any]:
    """Return a result's JSON without its views, and the archive's own account of time and cameras."""
    result = {key: value for key, value in score(archive, root).to_dict().items() if key != "views"}
    with zipfile.ZipFile(archive) as source:
        told = json.loads(source.read(METADATA_NAME))
    seconds = told["runtime"]["seconds"]
    return {
        **result,
        "notes": told.get("notes"),
        "seconds": {
            "a_view": {config: _median(seconds, config) for config in result["tables"]},
            "preparing": told["runtime"].get("preparing"),
        },
    }


def _median(seconds: Mapping[str, float], config: str) -> float:
    return round(statistics.median(spent for view, spent in seconds.items() if config_of(view) == config), 3)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python -m benchmarks.reference OUT")
    sys.exit(main(Path(sys.argv[1])))
