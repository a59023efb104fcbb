"""Dataset of 24 views of the lattice, 15 degrees apart, with the left images rendered beforehand.

The images are in ``tests/data/orbit``, 512 x 288 at one sample per pixel, rendered by ``make sample-data``. Depth,
masks and bar ids are cast anew against the mesh of the tiny dataset, which shows the same scene. Right images are
black: multi-view methods do not read them.
"""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dataset_builder.cameras.rigs import rig_cameras
from dataset_builder.cameras.trajectories import aim_point_m, poses
from dataset_builder.catalog.named_configs import BuildRequest
from dataset_builder.pipeline.blender_process import OnViewDone
from dataset_builder.pipeline.build import build
from dataset_builder.pipeline.shards import Staging, View, encode_view, stage_row
from dataset_builder.pipeline.work_units import UnitResult, WorkUnit
from dataset_builder.scene.mesh_ply import read_mesh_ply
from dataset_builder.scene.raycast import RayCaster
from dataset_builder.specs.config_specs import ColourSpec
from dataset_builder.user_files.make_assembly import make_assembly
from rebar_depth_bench.data.codecs import decode
from rebar_depth_bench.data.files import file_sha256

IMAGES = Path(__file__).parent / "orbit"
SAMPLES = 1
REQUEST = BuildRequest(
    configs=("lattice-orbit",), views=24, width=512, height=288, colour=ColourSpec(SAMPLES, SAMPLES)
)


@dataclass(frozen=True)
class StoredImages:
    """Renderer that takes the left images from ``IMAGES`` and casts the ground truth against ``mesh``."""

    mesh: Path

    def submit(self, unit: WorkUnit, staging: Staging, on_view_done: OnViewDone) -> Future[UnitResult]:
        """Stage the views of the unit."""
        staging.row(0).parent.mkdir(parents=True, exist_ok=True)
        staging.mesh.write_bytes(self.mesh.read_bytes())
        caster = RayCaster(read_mesh_ply(self.mesh))
        config = unit.config
        left_poses = poses(config.protocol, aim_point_m(make_assembly(config.scene.assembly)), config.rig)
        for index in unit.indices:
            eyes = {}
            for name, camera in rig_cameras(config.rig, left_poses[index]).items():
                shape = (camera.height, camera.width, 3)
                rgb = (
                    decode("rgb", _image(index).read_bytes(), shape[:2])
                    if name == "left"
                    else np.zeros(shape, np.uint8)
                )
                eyes[name] = replace(caster.cast(camera), rgb=rgb)
            row, record = encode_view(
                View(
                    config.view_id(index),
                    config.scene.name,
                    eyes["left"],
                    eyes["right"],
                    config.rig.baseline_m,
                )
            )
            stage_row(staging.row(index), row, record)
            on_view_done(index)
        finished: Future[UnitResult] = Future()
        finished.set_result(UnitResult("stored images", {}, file_sha256(staging.mesh)))
        return finished


def write_orbit(root: Path, mesh: Path) -> None:
    """Write the dataset folder ``root``; ``mesh`` is the PLY file of the lattice."""
    build(REQUEST, root, submit=StoredImages(mesh).submit)


def _image(index: int) -> Path:
    return IMAGES / f"{index:04d}.webp"
