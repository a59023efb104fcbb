"""Depth check against Cycles: the depth pass is rendered from the dataset's mesh file and compared."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.audit.report import Check
from dataset_builder.audit.views import AuditedEye
from dataset_builder.pipeline.blender_process import BlenderProcesses, DepthTask
from rebar_depth_bench.atomic_io import scratch_folder

MAX_CYCLES_MEDIAN_RATIO = 5e-6
"""Largest median difference, relative to the median depth.

Cycles intersects triangles in float32. The median is 1e-7 on the lattice and 3e-6 on the pier, where the vertical
bars consist of triangles of 6.67 m by 4 mm: there Cycles' points lie up to 7 % of a radius off the bars, those of
the ray caster on the facets.
"""
MAX_CYCLES_OUTLIER_SHARE = 1e-3
"""Largest share of steel pixels that may be outliers."""
CYCLES_OUTLIER_RATIO = 1e-3
"""Difference of an outlier, relative to the depth or to 1 m, whichever is larger.

Only a different surface explains so large a difference.
"""


def cycles_difference_m(
    mesh: Path, eyes: Sequence[AuditedEye], progress: Callable[[int, int], None]
) -> Float64[ndarray, "n 2"]:
    """Return |dataset depth - Cycles depth| and the dataset depth of every steel pixel of the eyes, n x 2, metres.

    Cycles renders each eye on its own grid, including distorted grids. Blender is not started if ``eyes`` is
    empty. ``progress`` is called with the number of cameras rendered and their total.
    """
    if not eyes:
        return np.zeros((0, 2))
    cameras = tuple(eye.camera for eye in eyes)
    with scratch_folder("rebar-audit-") as folder, BlenderProcesses() as blender:
        task = DepthTask(mesh, cameras, folder, os.cpu_count() or 1)
        log = folder / "blender.log"
        blender.run(
            task, f"the audit of {mesh.name}", log, lambda event: progress(event["camera"] + 1, len(cameras))
        )
        cycles_depths_m = [np.load(folder / f"{n}.npy") for n in range(len(cameras))]
    differences = []
    for eye, cycles_m in zip(eyes, cycles_depths_m, strict=True):
        depth_m = eye.depth_m[eye.mask].astype(np.float64)
        differences.append(np.stack([np.abs(depth_m - cycles_m[eye.mask]), depth_m], axis=1))
    return np.concatenate(differences)


def cycles_verdict(config: str, difference_and_depth_m: ndarray[Any, Any], views: int) -> Check:
    """Return the check of the depth differences of ``views`` views, skipped if no views were requested."""
    name = f"{config}: depth compared with Cycles"
    if not views:
        return Check.skip(name, "no views requested")
    if not len(difference_and_depth_m):
        return Check.skip(name, f"{views} views: no steel")
    difference_m, depth_m = difference_and_depth_m.T
    median_m, share = (
        float(np.median(difference_m)),
        float(np.mean(difference_m > CYCLES_OUTLIER_RATIO * np.maximum(depth_m, 1.0))),
    )
    bound_m = MAX_CYCLES_MEDIAN_RATIO * float(np.median(depth_m))
    measured = (
        f"{views} views: median {median_m * 1e6:.3f} um, 99.9 % {np.quantile(difference_m, 0.999) * 1e6:.2f} um, "
        f"{share:.4%} over 1 mm/m"
    )
    return Check(
        name,
        measured,
        f"median {bound_m * 1e6:.3g} um, {MAX_CYCLES_OUTLIER_SHARE:.1%} over 1 mm/m",
        () if median_m <= bound_m and share <= MAX_CYCLES_OUTLIER_SHARE else (measured,),
    )
