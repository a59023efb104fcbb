"""Reference results of the methods that run on a CPU without downloads.

``python -m benchmarks.reference OUT SET`` renders the views of a set into OUT/dataset, writes the predictions of
each method to OUT/NAME.zip, scores them and writes ``cards/reference/SET.json``, the source of the tables in the
benchmark card. ``subset`` has all methods on a subset of every scene; ``lattice``, ``pile`` and ``pier`` have the
fast methods on all views of one scene, ``cages`` has them on 40 generated scenes. A set takes hours. After an
interruption, the same command computes only the archives that are missing or older than the dataset. OUT must not
be used for two sets.

``python -m benchmarks.reference OUT SET ROOT`` takes the views from the dataset folder ROOT and renders nothing.
The folder that ``benchmarks.learned`` needs has the views of ``subset`` and of ``cages``.
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

from benchmarks.learned import is_stale
from cards.reference import results_file
from dataset_builder.cli.main import main as rebar_build
from rebar_depth_bench import score
from rebar_depth_bench.base.names import TEST_SPLIT, config_of
from rebar_depth_bench.base.writing import write_text
from rebar_depth_bench.cli.main import main as rebar_bench
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.extended.estimates import ExtendedTable
from rebar_depth_bench.submission.declaration import METADATA_NAME


@dataclass(frozen=True)
class Renders:
    """Rendered views of each config: their number, evenly spread, image size in pixels, and colour option.

    ``scenes`` is the number of scenes of the split ``test`` in a config with splits; they share the views equally.
    """

    views: int
    colour: str
    width: int = 640
    height: int = 360
    scenes: int | None = None

    def to_dict(self) -> dict[str, int | str]:
        """Return the fields that are set, as a JSON object."""
        return {key: value for key, value in asdict(self).items() if value is not None}

    def options(self) -> list[str]:
        """Return the options of ``rebar-build``."""
        views = ["--views", self.views]
        if self.scenes is not None:
            views = [
                "--split",
                TEST_SPLIT,
                "--scenes",
                self.scenes,
                "--views-per-scene",
                self.views // self.scenes,
            ]
        size = ("--width", self.width, "--height", self.height)
        return [*map(str, (*views, *size)), *self.colour.split()]


@dataclass(frozen=True)
class ReferenceSet:
    """Set of results: renders, and the configs on which each method runs."""

    renders: Renders
    runs: Mapping[str, tuple[str, ...]]

    @property
    def configs(self) -> list[str]:
        """Return the configs of the set, in the order in which methods name them."""
        return list(dict.fromkeys(config for configs in self.runs.values() for config in configs))


WITH_BOARD = ("lattice", "pile")
ALL_SCENES = (*WITH_BOARD, "pier")

RUNS: Mapping[str, tuple[str, ...]] = {
    "sgbm": ALL_SCENES,
    "sgbm-filled": ALL_SCENES,
    "sweep-aruco": WITH_BOARD,
    "sweep-anchored": ("pier",),
    "lidar-mobile": ("pier",),
    "constant": ALL_SCENES,
    "board-plane": WITH_BOARD,
    "noisy-truth": ALL_SCENES,
    "truth": ALL_SCENES,
}
"""Configs on which each method runs.

The methods that need the marker board do not run on the pier, which has none; ``sweep-anchored``, which takes its
scale from ground truth, runs only there. The scanner methods run only on the pier, since the other scenes are
closer than the scanner's minimum range. ``lidar-survey`` is omitted because it takes about 25 core-seconds per
view.
"""

SLOW_METHODS = ("sweep-aruco", "sweep-anchored")
"""Methods that run on the subset only, because structure from motion takes up to 15 seconds a view there."""


def _all_views(scene: str) -> ReferenceSet:
    runs = {
        method: (scene,) for method, configs in RUNS.items() if scene in configs and method not in SLOW_METHODS
    }
    return ReferenceSet(Renders(504, "--quality preview"), runs)


CAGE_METHODS = ("sgbm", "sgbm-filled", "lidar-mobile", "constant", "noisy-truth", "truth")

SETS: Mapping[str, ReferenceSet] = {
    "subset": ReferenceSet(Renders(72, "--quality preview"), RUNS),
    **{scene: _all_views(scene) for scene in ALL_SCENES},
    "cages": ReferenceSet(Renders(160, "--quality preview", scenes=40), dict.fromkeys(CAGE_METHODS, ("cages",))),
}
"""Sets of results by name."""


def main(out: Path, set_name: str, given_root: Path | None = None) -> int:
    """Compute missing archives of a set and write its results; return the exit status."""
    reference = SETS[set_name]
    root = given_root or out / "dataset"
    build = ("--out", str(root), "--config", *reference.configs, *reference.renders.options())
    if given_root is None and (status := rebar_build(list(build))):
        return status
    if differing := _differing(reference, root):
        print(f"{root}: the views of {', '.join(differing)} are not those of {' '.join(build)}", file=sys.stderr)
        return 2
    out.mkdir(parents=True, exist_ok=True)
    for method, configs in reference.runs.items():
        archive = out / f"{method}.zip"
        predict = ("predict", method, "--data", root, "--out", archive, "--config", *configs)
        is_missing = any(is_stale(archive, root / config) for config in configs)
        if is_missing and (status := rebar_bench(list(map(str, predict)))):
            return status
    results = {method: _result(out / f"{method}.zip", root) for method in reference.runs}
    command = f"python -m benchmarks.reference OUT {set_name}"
    document = {"command": command, "renders": reference.renders.to_dict(), "results": results}
    write_text(results_file(set_name), json.dumps(document, indent=1, allow_nan=False) + "\n")
    return 0


def _differing(reference: ReferenceSet, root: Path) -> list[str]:
    """Return the configs of a set whose views in a folder differ from it in number, scenes or size."""
    renders, config_by_name = reference.renders, open_folder(root).config_by_name
    expected = (renders.views, renders.scenes or 1, (renders.height, renders.width))
    parts = {
        name: config_by_name[name].of_split(TEST_SPLIT) for name in reference.configs if name in config_by_name
    }
    found = {name: (len(part.views), len(part.scenes), part.grid) for name, part in parts.items()}
    return [name for name in reference.configs if found.get(name) != expected]


def _result(archive: Path, root: Path) -> dict[str, Any]:
    """Return the result of an archive as a JSON object without views, with the archive's notes and run times."""
    scored = score(archive, root, extended=True)
    assert scored.extended is not None
    result = {key: value for key, value in scored.to_dict().items() if key not in ("views", "extended")}
    with zipfile.ZipFile(archive) as source:
        metadata = json.loads(source.read(METADATA_NAME))
    seconds = metadata["runtime"]["seconds"]
    return {
        **result,
        "single_bar": {config: _single_bar(table) for config, table in scored.extended.tables.items()},
        "notes": metadata.get("notes"),
        "seconds": {
            "a_view": {config: _median(seconds, config) for config in result["tables"]},
            "preparing": metadata["runtime"].get("preparing"),
        },
    }


def _single_bar(table: ExtendedTable) -> dict[str, float | int | None]:
    """Return share and AbsRel of the single-bar interior, and AbsRel on the whole interior of the same views.

    The share is a mean over all views. The errors are means over the views with a predicted single-bar pixel.
    """
    native, scaled = table.numbers["native"], table.numbers["scaled"]
    return {
        "share": native["single_bar_share"].value,
        "views": native["single_bar_abs_rel"].samples,
        "native_abs_rel_interior": native["single_bar_views_abs_rel"].value,
        "native_abs_rel_single_bar": native["single_bar_abs_rel"].value,
        "scaled_abs_rel_interior": scaled["single_bar_views_abs_rel"].value,
        "scaled_abs_rel_single_bar": scaled["single_bar_abs_rel"].value,
    }


def _median(seconds: Mapping[str, float], config: str) -> float:
    return round(statistics.median(duration for view, duration in seconds.items() if config_of(view) == config), 3)


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4) or sys.argv[2] not in SETS:
        sys.exit(f"usage: python -m benchmarks.reference OUT {'|'.join(SETS)} [ROOT]")
    sys.exit(main(Path(sys.argv[1]), sys.argv[2], *map(Path, sys.argv[3:])))
