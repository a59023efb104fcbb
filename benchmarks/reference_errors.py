"""Reference errors and single-bar share of the scenes at the paper's size, from the geometry alone.

python -m benchmarks.reference_errors [CONFIG ...]

The left cameras of 72 views, spread evenly over the dome, are cast at 1280 x 720 against the steel, without
rendering. The background does not matter: all neighbours of a scored pixel are steel.
"""

from __future__ import annotations

import sys

import numpy as np

from benchmarks.steel_coverage import steel_mesh
from benchmarks.timing import print_markdown
from dataset_builder.config.catalog import BuildRequest
from dataset_builder.config.rigs import rig_cameras
from dataset_builder.config.specs import ConfigSpec
from dataset_builder.config.trajectories import poses, subset
from dataset_builder.scene.assemblies import aim_point_m, make_assembly
from dataset_builder.scene.raycast import RayCaster
from rebar_depth_bench.scoring.metrics import median
from rebar_depth_bench.scoring.protocol import scored_pixels, single_bar_pixels
from rebar_depth_bench.scoring.reference import mean_reference, view_reference

VIEWS, GRID = 72, (1280, 720)
HEADS = [
    "config",
    "scored views",
    "constant, AbsRel",
    "RMSE, cm",
    "one pixel, AbsRel",
    "RMSE, cm",
    "single-bar, %",
]


def main(*configs: str) -> None:
    specs = BuildRequest(configs or ("lattice", "pile", "pier"), None, *GRID).config_specs()
    print_markdown(HEADS, [_row(spec) for spec in specs])


def _row(spec: ConfigSpec) -> tuple[object, ...]:
    assembly = make_assembly(spec.scene.assembly)
    left_poses = poses(spec.protocol, aim_point_m(assembly), spec.rig, assembly.bars)
    caster = RayCaster(steel_mesh(assembly))
    references, shares = [], []
    for index in subset(len(left_poses), VIEWS):
        left = caster.cast(rig_cameras(spec.rig, left_poses[index])["left"])
        pixels = scored_pixels(left.mask, left.depth_m)
        if len(pixels):
            references.append(view_reference(left.depth_m, pixels, median(left.depth_m.ravel()[pixels])))
            shares.append(float(np.mean(single_bar_pixels(left.bars, pixels))))
    numbers = mean_reference(references).to_numbers()
    with_any = f"{100 * np.mean(shares):.1f} ({np.count_nonzero(shares)} views)"
    return (spec.name, len(shares), *(f"{number:.4g}" for number in numbers), with_any)


if __name__ == "__main__":
    main(*sys.argv[1:])
