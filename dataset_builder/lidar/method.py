"""Laser scanner methods: a simulated scanner above the left camera, cast against the scene's mesh."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from jaxtyping import Float32
from numpy import ndarray

from dataset_builder.lidar.beams import visible_sector
from dataset_builder.lidar.project import LeftCamera, left_depth_m
from dataset_builder.lidar.scanner import MOBILE, SURVEY, ScannerSpec
from dataset_builder.lidar.simulate import noise_generator, simulate_scan
from dataset_builder.scene.mesh_ply import read_mesh_ply
from dataset_builder.scene.model import WorldMesh
from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.geometry.cameras import pixel_rays
from rebar_depth_bench.methods import MethodInfo, MultiViewMethod, Prepared, Views
from rebar_depth_bench.progress import Progress

_DIGITS = 12
"""Hexadecimal digits of a scanner's digest."""

_COLUMNS = ("left_K", "left_distortion", "left_cam_from_world")
"""Dataset columns that the method reads."""


def lidar_method(name: str, spec: ScannerSpec, what: str) -> MultiViewMethod:
    """Return the method of a scanner; ``what`` describes it in the summary.

    The method reads the scene's mesh, which is ground truth, and the scanner's pose is known exactly: it
    simulates what such an instrument could measure and uses no images.
    """

    def check(_: Views) -> None:
        if find_spec("embreex") is None:
            raise MethodError(f"{name} requires embreex for ray casting: pip install 'rebar-depth-bench[build]'")

    def prepare(views: Views, _: Path, progress: Progress) -> Prepared:
        from dataset_builder.scene.raycast import RayCaster

        progress(f"{name}: the mesh of {views.config}", 0, 1)
        caster = RayCaster(WorldMesh(*read_mesh_ply(views.mesh)))
        progress(f"{name}: the mesh of {views.config}", 1, 1)
        height, width = views.grid

        def run(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
            K, distortion = row["left_K"], row["left_distortion"]
            camera = LeftCamera(K, distortion, pixel_rays(K, width, height, distortion))
            sector = visible_sector(spec, camera.rays)
            lidar_from_world = spec.lidar_from_left @ row["left_cam_from_world"]
            range_m = simulate_scan(caster, spec, sector, lidar_from_world, noise_generator(row["view_id"]))
            return left_depth_m(spec, sector, range_m, camera)

        return Prepared(run, {"scanner": spec.to_dict()})

    summary = (
        f"simulated laser scanner, {what}, {-1000 * spec.position_left_m[1]:.0f} mm above the left camera, pose"
        " known exactly; reads the scene's mesh: a simulation, not a measurement on images; no prediction at"
        f" ranges below {spec.min_range_m:g} m"
    )
    # The digest distinguishes scanners of the same name with different parameters.
    source = f"this project, scanner {_digest(spec)}"
    info = MethodInfo(name, summary, _COLUMNS, True, source, "Apache-2.0", uses_ground_truth=True, inputs="lidar")
    return MultiViewMethod(info, prepare, check)


def _digest(spec: ScannerSpec) -> str:
    """Return a short digest of a scanner's parameters."""
    return hashlib.sha256(json.dumps(spec.to_dict(), sort_keys=True).encode()).hexdigest()[:_DIGITS]


LIDAR_SURVEY = lidar_method("lidar-survey", SURVEY, "surveyor's phase-shift class (FARO Focus S)")
"""Method of ``SURVEY``."""

LIDAR_MOBILE = lidar_method("lidar-mobile", MOBILE, "a robot's spinning class (Ouster OS1-128)")
"""Method of ``MOBILE``."""
