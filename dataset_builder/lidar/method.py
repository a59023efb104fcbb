"""Laser scanners as methods: what one mounted over the left camera would answer, simulated on the scene's mesh."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from jaxtyping import Float32
from numpy import ndarray

from dataset_builder.lidar.beams import sector_of
from dataset_builder.lidar.project import LeftCamera, left_depth_m
from dataset_builder.lidar.scanner import MOBILE, SURVEY, ScannerSpec
from dataset_builder.lidar.simulate import noise_generator, scan
from dataset_builder.scene.mesh_ply import read_mesh_ply
from dataset_builder.scene.model import WorldMesh
from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.geometry.cameras import pixel_rays
from rebar_depth_bench.methods import ConfigViews, MethodInfo, MultiViewMethod, Prepared
from rebar_depth_bench.progress import Progress

_DIGITS = 12
_COLUMNS = ("left_K", "left_distortion", "left_cam_from_world")


def lidar_method(name: str, spec: ScannerSpec, what: str) -> MultiViewMethod:
    """Return the method of a scanner; ``what`` names it in the summary.

    It reads the scene's mesh, which is ground truth, and the scanner knows its pose exactly: a simulation of what
    such an instrument could give, no measurement of pictures.
    """

    def check(_: ConfigViews) -> None:
        if find_spec("embreex") is None:
            raise MethodError(f"{name} needs embreex to cast rays: pip install 'rebar-depth-bench[build]'")

    def prepare(views: ConfigViews, _: Path, progress: Progress) -> Prepared:
        from dataset_builder.scene.raycast import RayCaster

        progress(f"{name}: the mesh of {views.config}", 0, 1)
        caster = RayCaster(WorldMesh(*read_mesh_ply(views.mesh)))
        progress(f"{name}: the mesh of {views.config}", 1, 1)
        height, width = views.grid

        def run(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
            K, distortion = row["left_K"], row["left_distortion"]
            camera = LeftCamera(K, distortion, pixel_rays(K, width, height, distortion))
            sector = sector_of(spec, camera.rays)
            lidar_from_world = spec.lidar_from_left @ row["left_cam_from_world"]
            range_m = scan(caster, spec, sector, lidar_from_world, noise_generator(row["view_id"]))
            return left_depth_m(spec, sector, range_m, camera)

        return Prepared(run, {"scanner": spec.notes()})

    summary = (
        f"simulated laser scanner, {what}, {-1000 * spec.position_left_m[1]:.0f} mm above the left camera, pose"
        " known exactly; reads the scene's mesh: a simulation, no measurement of pictures; no answer at"
        f" ranges below {spec.min_range_m:g} m"
    )
    source = f"this project, scanner {_digest(spec)}"  # two scanners of one name are two methods
    info = MethodInfo(name, summary, _COLUMNS, True, source, "Apache-2.0", reads_truth=True)
    return MultiViewMethod(info, prepare, check)


def _digest(spec: ScannerSpec) -> str:
    return hashlib.sha256(json.dumps(spec.notes(), sort_keys=True).encode()).hexdigest()[:_DIGITS]


LIDAR_SURVEY = lidar_method("lidar-survey", SURVEY, "surveyor's phase-shift class (FARO Focus S)")
LIDAR_MOBILE = lidar_method("lidar-mobile", MOBILE, "a robot's spinning class (Ouster OS1-128)")
