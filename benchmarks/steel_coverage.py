"""Steel in the views of a dataset folder: share of the frame, depth, interior, single bars and reference errors.

python -m benchmarks.steel_coverage ROOT [JSON]

``rebar-build --no-colour --out ROOT`` builds all views of the standard configs in about a second a view. Depths
are those of the left camera; the nearest steel is the nearest point of any bar, in any direction. The numbers of
the configs of which ROOT has all views are written to JSON; the cards show those of ``cards/steel.json``.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.timing import print_markdown
from cards.steel import range_text
from dataset_builder.cameras.trajectories import Cylinders
from rebar_depth_bench.base.names import TEST_SPLIT
from rebar_depth_bench.base.writing import write_text
from rebar_depth_bench.data.bars import BARS_FILE, read_bars
from rebar_depth_bench.data.manifest import DatasetConfig, open_folder
from rebar_depth_bench.data.rows import iterate_rows
from rebar_depth_bench.data.schema import CENTRE
from rebar_depth_bench.geometry.cameras import camera_centre
from rebar_depth_bench.scoring.protocol import scored_pixels, single_bar_pixels

HEADS = ["config", "radius, m", "views", "scored", "nearest steel, m", "steel depth, m", "steel, %", "interior, %"]
NEAREST, NEAR, FAR, STEEL, INTERIOR, SINGLE = range(6)
"""Columns of ``measure_views``."""
_COLUMNS = ("left_depth", "left_mask", "left_bars", "left_cam_from_world")


def main(root: str, json_file: str | None = None) -> None:
    folder = open_folder(root)
    bars = read_bars(folder.file(BARS_FILE))
    rows, complete = [], {}
    for name, config in folder.config_by_name.items():
        views = measure_views(config, Cylinders.from_bars(bars[config.scene.name]))
        radii_m = config.scene.trajectory.distances_m if config.scene.trajectory is not None else ()
        if len(views) == config.scene.protocol_views:
            complete[name] = summary(config, views)
            shells = zip(radii_m, np.split(views, len(radii_m)), strict=True)
            rows += [(name, f"{radius_m:g}", *_cells(shell)) for radius_m, shell in shells if len(radii_m) > 1]
        rows.append((name, "all", *_cells(views)))
    print_markdown(HEADS, rows)
    if json_file is not None:
        document = {"command": "python -m benchmarks.steel_coverage ROOT cards/steel.json", "configs": complete}
        write_text(Path(json_file), json.dumps(document, indent=1, allow_nan=False) + "\n")


def measure_views(config: DatasetConfig, steel: Cylinders) -> np.ndarray:
    """Return six numbers for each left view of a config.

    They are the distance to the nearest steel, the least and largest depth of steel, metres (NaN without steel),
    the share of steel in the frame, the share of steel pixels in the interior (NaN without steel) and the share of
    single-bar pixels in the interior (NaN without interior).
    """
    views = []
    for row in iterate_rows(config, _COLUMNS):
        mask, depth_m = row["left_mask"], row["left_depth"]
        pixels = scored_pixels(mask, depth_m)
        steel_m = depth_m[mask] if mask.any() else np.array([np.nan])
        interior = len(pixels) / np.count_nonzero(mask) if mask.any() else np.nan
        single = np.mean(single_bar_pixels(row["left_bars"], pixels)) if len(pixels) else np.nan
        nearest_m = steel.distance_m(camera_centre(row["left_cam_from_world"])[None])[0]
        views.append((nearest_m, steel_m.min(), steel_m.max(), mask.mean(), interior, single))
    return np.array(views)


def summary(config: DatasetConfig, views: np.ndarray) -> Mapping[str, Any]:
    """Return the entry of a config in ``cards/steel.json``."""
    steel, single = views[:, STEEL], views[:, SINGLE]
    scored = np.isfinite(single)
    return {
        "views": len(views),
        "scored_views": int(np.count_nonzero(scored)),
        "width": config.rig.width,
        "height": config.rig.height,
        "distance_to": getattr(config.scene.trajectory, "distance_to", CENTRE),
        "coverage": {
            "mean": _rounded(steel.mean()),
            "least": _rounded(steel.min()),
            "most": _rounded(steel.max()),
        },
        "interior": _rounded(np.nanmean(views[:, INTERIOR])),
        "depth_m": [_rounded(np.nanmin(views[:, NEAR])), _rounded(np.nanmax(views[:, FAR]))],
        "reference": config.references[TEST_SPLIT].model_dump(),
        "single_bar": {"share": _rounded(single[scored].mean()), "views": int(np.count_nonzero(single[scored]))},
    }


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


def _cells(views: np.ndarray) -> tuple[object, ...]:
    steel = 100 * views[:, STEEL]
    return (
        len(views),
        int(np.count_nonzero(np.isfinite(views[:, SINGLE]))),
        range_text(views[:, NEAREST].min(), views[:, NEAREST].max(), 3),
        range_text(np.nanmin(views[:, NEAR]), np.nanmax(views[:, FAR]), 3),
        f"{steel.mean():.1f} ({range_text(steel.min(), steel.max(), 1)})",
        f"{100 * np.nanmean(views[:, INTERIOR]):.1f}",
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
