"""Ground truth against Cycles' own depth pass, rendered anew from the dataset's mesh file."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.audit.report import Check
from dataset_builder.audit.views import AuditedEye
from dataset_builder.build.blender_process import BlenderProcesses, DepthTask

MAX_CYCLES_MEDIAN = 5e-6
"""Of the depth. Cycles meets triangles in float32: 1e-7 on the lattice, 3e-6 on the pier, whose verticals are
triangles of 6.67 m by 4 mm; there its points lie up to 7 % of a radius off the bars, ours on their facets."""
MAX_CYCLES_OFF_SHARE = 1e-3
CYCLES_OFF = 1e-3
"""Of the depth, or of a metre where that is more: what only another surface explains."""


def cycles_difference_m(
    mesh: Path, eyes: Sequence[AuditedEye], progress: Callable[[int, int], None]
) -> Float64[ndarray, "n 2"]:
    """Return |dataset depth - Cycles depth| and the dataset's depth, metres, of every steel pixel of the eyes.

    Cycles renders each on its own grid, distorted ones too. No eyes, no Blender.
    """
    if not eyes:
        return np.zeros((0, 2))
    cameras = tuple(eye.camera for eye in eyes)
    with tempfile.TemporaryDirectory() as folder, BlenderProcesses() as blender:
        task = DepthTask(mesh, cameras, Path(folder), os.cpu_count() or 1)
        log = Path(folder) / "blender.log"
        blender.run(
            task, f"the audit of {mesh.name}", log, lambda event: progress(event["camera"] + 1, len(cameras))
        )
        rendered = [np.load(Path(folder) / f"{n}.npy") for n in range(len(cameras))]
    found = []
    for eye, cycles_m in zip(eyes, rendered, strict=True):
        depth_m = eye.depth_m[eye.mask].astype(np.float64)
        found.append(np.stack([np.abs(depth_m - cycles_m[eye.mask]), depth_m], axis=1))
    return np.concatenate(found)


def cycles_verdict(config: str, off_and_depth_m: ndarray[Any, Any], views: int) -> Check:
    """Hold the differences of ``views`` views against their bounds; none asked for is no failure."""
    name = f"{config}: depth against Cycles"
    if not views:
        return Check(name, "skipped", "none asked for")
    if not len(off_and_depth_m):
        return Check(name, f"{views} views: no steel", "left out")
    off_m, depth_m = off_and_depth_m.T
    median_m, share = float(np.median(off_m)), float(np.mean(off_m > CYCLES_OFF * np.maximum(depth_m, 1.0)))
    bound_m = MAX_CYCLES_MEDIAN * float(np.median(depth_m))
    found = (
        f"{views} views: median {median_m * 1e6:.3f} um, 99.9 % {np.quantile(off_m, 0.999) * 1e6:.2f} um, "
        f"{share:.4%} over 1 mm a metre"
    )
    return Check(
        name,
        found,
        f"median {bound_m * 1e6:.3g} um, {MAX_CYCLES_OFF_SHARE:.1%} over 1 mm a metre",
        () if median_m <= bound_m and share <= MAX_CYCLES_OFF_SHARE else (found,),
    )
