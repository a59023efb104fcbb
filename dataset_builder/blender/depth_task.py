"""Renders Cycles' own planar depth of a dataset's mesh file: the audit's second opinion on the ground truth."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from dataset_builder.blender.render import configure_colour, render_depth
from dataset_builder.blender.scene import add_object, mesh_data
from dataset_builder.build.blender_process import DepthTask
from dataset_builder.config.specs import ColourSpec
from dataset_builder.scene.mesh_ply import read_mesh_ply
from dataset_builder.scene.model import NOT_STEEL, Mesh, Part


def run_depth_task(task: DepthTask, report: Callable[[Mapping[str, Any]], None]) -> None:
    """Write ``<n>.npy`` into ``task.out`` for camera n, and report each."""
    vertices_m, faces, _ = read_mesh_ply(task.mesh)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    part = Part("dataset", Mesh(vertices_m, faces), NOT_STEEL, "steel")
    add_object(part, mesh_data(part.name, part.mesh, part.material), np.zeros(3))
    configure_colour(ColourSpec(samples=1, denoise=False), task.threads)
    with tempfile.TemporaryDirectory(dir=task.out) as scratch:
        for n, camera in enumerate(task.cameras):
            depth_m = render_depth(camera, Path(scratch))
            np.save(task.out / f"{n}.npy", depth_m)
            report({"camera": n})
