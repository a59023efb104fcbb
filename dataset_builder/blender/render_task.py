"""Renders the views of one shard: colour by Cycles, ground truth by ray casting the meshes Cycles renders.

Where the seconds of a build go.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.blender.evaluated_mesh import evaluated_world_mesh
from dataset_builder.blender.render import configure_colour, render_colour
from dataset_builder.blender.scene import build_scene
from dataset_builder.build.blender_process import RenderTask
from dataset_builder.build.shards import Eye, Staging, View, encode_view, stage_row
from dataset_builder.config.catalog import view_id
from dataset_builder.config.rigs import rig_cameras
from dataset_builder.config.specs import ConfigSpec
from dataset_builder.config.trajectories import poses
from dataset_builder.scene.assemblies import aim_point_m, make_assembly
from dataset_builder.scene.mesh_ply import write_mesh_ply
from dataset_builder.scene.model import WorldMesh
from dataset_builder.scene.raycast import RayCaster
from rebar_depth_bench.data.digests import file_sha256
from rebar_depth_bench.errors import BuildError
from rebar_depth_bench.geometry.cameras import pixel_rays


class Stopwatch:
    """Adds up wall-clock seconds by stage until they are taken."""

    def __init__(self) -> None:
        self._seconds: defaultdict[str, float] = defaultdict(float)

    @contextmanager
    def timing(self, stage: str) -> Iterator[None]:
        """Add the time spent in the block to ``stage``."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self._seconds[stage] += time.perf_counter() - start

    def take(self) -> dict[str, float]:
        """Return the seconds since the last call, by stage, and start again from zero."""
        taken = dict(self._seconds)
        self._seconds.clear()
        return taken


def run_render_task(task: RenderTask, report: Callable[[Mapping[str, Any]], None]) -> None:
    """Stage every view of the task that is not staged yet; report each."""
    watch = Stopwatch()
    staging = Staging(task.staging)
    with watch.timing("scene"):
        assembly = make_assembly(task.config.scene.assembly)
        build_scene(assembly, task.config.scene)
        configure_colour(task.config.colour, task.threads)
        mesh = evaluated_world_mesh()
        _stage_mesh(mesh, staging.mesh, task.mesh_sha256)
        caster = RayCaster(mesh)
        left_poses = poses(task.config.protocol, aim_point_m(assembly), task.config.rig)
        cameras = rig_cameras(task.config.rig, np.eye(4))
        rays_cam = {
            eye: pixel_rays(camera.K, camera.width, camera.height, camera.distortion)
            for eye, camera in cameras.items()
        }
    report({"seconds": watch.take()})
    with tempfile.TemporaryDirectory(dir=task.staging) as scratch:
        studio = _Studio(task.config, caster, rays_cam, Path(scratch))
        for index in task.indices:
            path = staging.row(index)
            if not path.is_file():
                view = _render_view(studio, index, left_poses[index], watch)
                with watch.timing("encode"):
                    row, record = encode_view(view)
                with watch.timing("write"):
                    stage_row(path, row, record)
            report({"view": index, "seconds": watch.take()})


@dataclass(frozen=True, eq=False)
class _Studio:
    """What all views of a task share: the config, the scene's mesh, each eye's rays, a folder for pictures."""

    config: ConfigSpec
    caster: RayCaster
    rays_cam: Mapping[str, Float64[ndarray, "h w 3"]]
    scratch: Path


def _render_view(
    studio: _Studio, index: int, left_cam_from_world: Float64[ndarray, "4 4"], watch: Stopwatch
) -> View:
    config = studio.config
    eyes = {}
    for eye_index, (eye, camera) in enumerate(rig_cameras(config.rig, left_cam_from_world).items()):
        with watch.timing("colour"):
            rgb = render_colour(camera, _cycles_seed(config, index, eye_index), studio.scratch)
        with watch.timing("truth"):
            truth = studio.caster.cast(studio.rays_cam[eye], camera.cam_from_world)
        eyes[eye] = Eye(
            rgb, truth.depth_m, truth.mask, truth.bars, camera.K, camera.distortion, camera.cam_from_world
        )
    return View(view_id(config.name, index), eyes["left"], eyes["right"], config.rig.baseline_m)


def _cycles_seed(config: ConfigSpec, index: int, eye_index: int) -> int:
    """Return a seed of its own for every image, so that noise never repeats from view to view."""
    entropy = [config.scene.seed, *config.name.encode(), index, eye_index]
    return int(np.random.SeedSequence(entropy).generate_state(1)[0] >> 1)


def _stage_mesh(mesh: WorldMesh, path: Path, expected_sha256: str | None) -> None:
    """Stage the scene's mesh; every shard of a config must be cast against the very same one."""
    own = path.with_name(f"mesh-{os.getpid()}.ply")
    write_mesh_ply(own, mesh.vertices_m, mesh.faces, mesh.face_bar_id)
    expected = file_sha256(path) if path.exists() else expected_sha256
    found = file_sha256(own)
    if expected not in (None, found):
        raise BuildError(
            f"{own}: the scene's mesh has sha256 {found}, expected {expected}, which other views of the config "
            "were cast against"
        )
    own.replace(path)
