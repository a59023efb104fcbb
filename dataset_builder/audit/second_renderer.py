"""Ground truth against Cycles' own depth pass, rendered anew from the dataset's mesh file."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.blender_process import BlenderProcesses
from dataset_builder.optics import Camera
from dataset_builder.tasks import DepthTask
from rebar_depth_bench.schema import EYES


def cycles_difference_m(
    mesh: Path, rows: Sequence[Mapping[str, Any]], progress: Callable[[int, int], None]
) -> Float64[ndarray, " n"]:
    """Return |dataset depth - Cycles depth|, metres, of every steel pixel of the rows' two eyes."""
    cameras = tuple(
        Camera(
            row[f"{eye}_K"],
            row[f"{eye}_distortion"],
            row[f"{eye}_cam_from_world"],
            row[f"{eye}_depth"].shape[1],
            row[f"{eye}_depth"].shape[0],
        )
        for row in rows
        for eye in EYES
    )
    with tempfile.TemporaryDirectory() as folder, BlenderProcesses() as blender:
        task = DepthTask(mesh, cameras, Path(folder), os.cpu_count() or 1)
        log = Path(folder) / "blender.log"
        blender.run(
            task, f"the audit of {mesh.name}", log, lambda event: progress(event["camera"] + 1, len(cameras))
        )
        rendered = [np.load(Path(folder) / f"{n}.npy") for n in range(len(cameras))]
    eyes = [(row[f"{eye}_depth"], row[f"{eye}_mask"]) for row in rows for eye in EYES]
    differences = [
        np.abs(depth_m[mask].astype(np.float64) - cycles_m[mask])
        for (depth_m, mask), cycles_m in zip(eyes, rendered, strict=True)
    ]
    return np.concatenate(differences)
