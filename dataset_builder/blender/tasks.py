"""Tasks of the Blender process: views of a work unit, Cycles depth of a mesh file, and the list of devices.

Colour is rendered by Cycles; ground truth is ray cast against the meshes that Cycles renders. Cycles' planar depth
is an independent check of the ground truth.
"""

from __future__ import annotations

import io
import os
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.blender.colour import configure_colour, render_colour
from dataset_builder.blender.render import render_depth, use_cycles
from dataset_builder.blender.scene import add_object, build_scene, evaluated_world_mesh, mesh_data
from dataset_builder.cameras.rigs import rig_cameras
from dataset_builder.cameras.trajectories import aim_point_m, poses
from dataset_builder.pipeline.blender_process import DepthTask, DevicesTask, RenderTask
from dataset_builder.pipeline.shards import View, encode_view, stage_row
from dataset_builder.scene.assemblies.cage import unpacked_cage
from dataset_builder.scene.mesh_ply import read_mesh_ply, write_mesh_ply
from dataset_builder.scene.model import WorldMesh, surface
from dataset_builder.scene.raycast import RayCaster
from dataset_builder.scene.variants.sensor import recorded
from dataset_builder.specs.config_specs import CPU, GPU_TYPES, ConfigSpec
from dataset_builder.specs.file_specs import PinnedFile
from dataset_builder.user_files.make_assembly import make_assembly
from rebar_depth_bench.base.errors import BuildError, InputError
from rebar_depth_bench.base.writing import write_bytes
from rebar_depth_bench.data.files import file_sha256

Seconds = defaultdict[str, float]
"""Wall-clock seconds by stage."""


@contextmanager
def _timed(seconds: Seconds, stage: str) -> Iterator[None]:
    """Add the time spent in the block to ``stage``."""
    start = time.perf_counter()
    try:
        yield
    finally:
        seconds[stage] += time.perf_counter() - start


def run_render_task(task: RenderTask, report: Callable[[Mapping[str, Any]], None]) -> None:
    """Render and stage each view of the task that is not staged yet, and report each view.

    Raises ``BuildError`` if the scene's mesh differs from the one of other shards or Blender fails.
    """
    seconds = Seconds(float)
    unit, staging = task.unit, task.staging
    config = unit.config
    with _timed(seconds, "scene"):
        of_file = isinstance(config.scene.assembly, PinnedFile)
        cage = unpacked_cage(staging.cage.read_bytes()) if of_file else None
        assembly = make_assembly(config.scene.assembly, cage)
        build_scene(assembly, config.scene, colour=config.colour is not None)
        if config.colour is not None:
            configure_colour(task.threads)
            select_device(config.colour.device)
        mesh = evaluated_world_mesh()
        _stage_mesh(mesh, staging.mesh, unit.mesh_sha256)
        caster = RayCaster(mesh)
        left_poses = poses(config.protocol, aim_point_m(assembly), config.rig, assembly.bars)
        rays_cam = {eye: camera.rays() for eye, camera in rig_cameras(config.rig, np.eye(4)).items()}
    report({"seconds": seconds})
    with tempfile.TemporaryDirectory(dir=staging.root) as scratch:
        context = _RenderContext(config, caster, rays_cam, Path(scratch))
        for index in unit.indices:
            path, seconds = staging.row(index), Seconds(float)
            if not path.is_file():
                view = _render_view(context, index, left_poses[index], seconds)
                with _timed(seconds, "encode"):
                    row, record = encode_view(view)
                with _timed(seconds, "write"):
                    stage_row(path, row, record)
            report({"view": index, "seconds": seconds})


@dataclass(frozen=True, eq=False)
class _RenderContext:
    """Data that all views of a task share: config, ray caster, rays of each eye and a scratch folder."""

    config: ConfigSpec
    caster: RayCaster
    rays_cam: Mapping[str, Float64[ndarray, "h w 3"]]
    scratch: Path


def _render_view(
    context: _RenderContext, index: int, left_cam_from_world: Float64[ndarray, "4 4"], seconds: Seconds
) -> View:
    """Render colour, if the config has it, and ray cast ground truth of both eyes of one view."""
    config = context.config
    eyes, rgb = {}, None
    for eye_index, (eye, camera) in enumerate(rig_cameras(config.rig, left_cam_from_world).items()):
        with _timed(seconds, "truth"):
            truth = context.caster.cast(camera, context.rays_cam[eye])
        if config.colour is not None:
            with _timed(seconds, "colour"):
                seed = _cycles_seed(config, index, eye_index)
                rgb = render_colour(camera, truth.mask, config.colour, seed, context.scratch)
                rgb = recorded(rgb, config.scene, seed)
        eyes[eye] = replace(truth, rgb=rgb)
    return View(config.view_id(index), config.scene.name, eyes["left"], eyes["right"], config.rig.baseline_m)


def _cycles_seed(config: ConfigSpec, index: int, eye_index: int) -> int:
    """Return a separate seed for each image, so that noise does not repeat from view to view."""
    entropy = [config.scene.seed, *config.label.encode(), index, eye_index]
    return int(np.random.SeedSequence(entropy).generate_state(1)[0] >> 1)


def _stage_mesh(mesh: WorldMesh, path: Path, expected_sha256: str | None) -> None:
    """Stage the scene's mesh as a PLY file.

    Raises ``BuildError`` if its SHA-256 differs from the mesh of other shards of the config: all of them must be
    cast against the same mesh.
    """
    own_path = path.with_name(f"mesh-{os.getpid()}.ply")
    write_mesh_ply(own_path, mesh)
    expected = file_sha256(path) if path.exists() else expected_sha256
    actual = file_sha256(own_path)
    if expected not in (None, actual):
        raise BuildError(
            f"{own_path}: the scene's mesh has sha256 {actual}, expected {expected} as for the scene's other views"
        )
    own_path.replace(path)


def run_depth_task(task: DepthTask, report: Callable[[Mapping[str, Any]], None]) -> None:
    """Render the planar depth of a mesh for each camera of a task into ``task.out``, and report each camera.

    The file ``<n>.npy`` of camera n holds float32 depth in metres, (H, W); pixels without a surface are 0.0.
    """
    mesh = read_mesh_ply(task.mesh)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    part = surface("dataset", mesh, "steel")
    add_object(part, mesh_data(part.name, part.mesh, part.material), np.zeros(3))
    use_cycles(bpy.context.scene, task.threads)
    with tempfile.TemporaryDirectory(dir=task.out) as scratch:
        for n, camera in enumerate(task.cameras):
            depth_m = render_depth(camera, Path(scratch))
            content = io.BytesIO()
            np.save(content, depth_m)
            write_bytes(task.out / f"{n}.npy", content.getvalue())
            report({"camera": n})


def run_devices_task(task: DevicesTask, report: Callable[[Mapping[str, Any]], None]) -> None:  # noqa: ARG001
    """Report the devices of this machine."""
    report({"devices": available_devices()})


def available_devices() -> dict[str, list[str]]:
    """Return the names of the devices by type; types without devices are absent."""
    supported = {entry[0].lower() for entry in _preferences().get_device_types(bpy.context)}
    found = {device: [entry.name for entry in _entries(device)] for device in (CPU, *GPU_TYPES)}
    return {device: names for device, names in found.items() if names and device in (CPU, *supported)}


def select_device(device: str) -> None:
    """Let Cycles render the open scene on all devices of a type, and on no other device.

    Required after ``configure_colour``. The compositor denoises on the CPU in any case: images are then denoised
    in the same way on all devices, and the GPU's memory holds only the scene. Ground truth is ray cast on the CPU
    and does not depend on the device. Rendering on a GPU is untested, since no machine with one was at hand.

    Raises ``InputError`` if there is no such device.
    """
    cycles = bpy.context.scene.cycles
    if device == CPU:
        cycles.device = "CPU"
        return
    if not _entries(device):
        listed = ", ".join(f"{name} ({len(names)})" for name, names in available_devices().items())
        raise InputError(f"--device {device}: no such device was found, only: {listed}")
    preferences = _preferences()
    preferences.compute_device_type = device.upper()
    for entry in preferences.devices:
        entry.use = entry.type == device.upper()
    cycles.device = "GPU"


def _preferences() -> Any:
    """Return the preferences of Cycles; ``read_factory_settings`` replaces them."""
    return bpy.context.preferences.addons["cycles"].preferences


def _entries(device: str) -> list[Any]:
    """Return Cycles' entries of the devices of a type."""
    return [entry for entry in _preferences().get_devices_for_type(device.upper()) if entry.type == device.upper()]
