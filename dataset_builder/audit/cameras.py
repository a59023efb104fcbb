"""Cameras against the manifest: the protocol's pose of each view, seen through the config's rig."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.assemblies import aim_point_m
from dataset_builder.audit.manifest_specs import protocol_spec, rig_spec
from dataset_builder.configs import view_id
from dataset_builder.model import NOT_STEEL, Assembly, Mesh, Part
from dataset_builder.optics import Camera, rig_cameras
from dataset_builder.protocols import poses, subset
from rebar_depth_bench.cameras import camera_centre
from rebar_depth_bench.errors import DatasetError
from rebar_depth_bench.ply import read_mesh_ply
from rebar_depth_bench.schema import EYES

CAMERA_TOLERANCE = 1e-12
"""Of every number of K, distortion and pose: what another machine's sines may differ by."""
_AIM_TOLERANCE_M = 0.0011
"""The aim point is rounded to the millimetre; the mesh is float32 and may fall on the other side."""


@dataclass(frozen=True, eq=False)
class ExpectedView:
    """What a view must be called, where its cameras must stand and how far apart."""

    view_id: str
    cameras: Mapping[str, Camera]
    baseline_m: float


def mesh_aim_point_m(mesh: Path) -> Float64[ndarray, " 3"]:
    """Return what cameras look at, of a dataset's mesh file: the middle of its steel, to the millimetre.

    Raises ``DatasetError`` where the file is no mesh of this dataset or holds no steel.
    """
    vertices_m, faces, face_bar_id = read_mesh_ply(mesh)
    steel = vertices_m[np.unique(faces[face_bar_id != NOT_STEEL])]
    if not len(steel):
        raise DatasetError(f"{mesh}: holds no steel, expected the bars of its scene")
    return aim_point_m(Assembly((), (Part("steel", Mesh(steel, faces[:0]), 1, "steel"),)))


def aim_point_of(entry: Mapping[str, Any], mesh: Path) -> tuple[Float64[ndarray, " 3"], tuple[str, ...]]:
    """Return a config's aim point, world metres, and what is wrong with it.

    It is the manifest's where it says one, held against the middle of the mesh's steel; else that middle.
    """
    middle_m = mesh_aim_point_m(mesh)
    if "aim_point_m" not in entry:
        return middle_m, ()
    aim_m = np.asarray(entry["aim_point_m"], dtype=np.float64)
    if aim_m.shape != (3,) or not np.abs(aim_m - middle_m).max() <= _AIM_TOLERANCE_M:
        return middle_m, (f"aim_point_m is {entry['aim_point_m']}, the steel's middle is {middle_m.tolist()}",)
    return aim_m, ()


def expected_views(config: str, entry: Mapping[str, Any], aim_m: Float64[ndarray, " 3"]) -> list[ExpectedView]:
    """Return what the views of a config must be, in order, rebuilt from its manifest entry alone.

    Raises ``DatasetError`` where the manifest's protocol or rig is not one this version writes.
    """
    rig = rig_spec(config, entry)
    left_poses = poses(protocol_spec(config, entry), aim_m, rig)
    try:
        return [
            ExpectedView(view_id(config, index), rig_cameras(rig, left_poses[index]), rig.baseline_m)
            for index in subset(len(left_poses), len(entry["views"]))
        ]
    except ValueError as error:
        raise DatasetError(f"manifest: the rig of config {config} gives no cameras: {error}") from None


def protocol_problems(entry: Mapping[str, Any], views: Sequence[ExpectedView]) -> Iterator[str]:
    """Yield what is wrong with the manifest's list of views."""
    found = [view["view_id"] for view in entry["views"]]
    expected = [view.view_id for view in views]
    if found != expected:
        wrong = next((pair for pair in zip(found, expected, strict=False) if pair[0] != pair[1]), None)
        said = f": the first that differs is {wrong[0]}, expected {wrong[1]}" if wrong else ""
        yield f"the manifest names {len(found)} views, its protocol gives {len(expected)} of these{said}"


def camera_problems(row: Mapping[str, Any], expected: ExpectedView) -> Iterator[str]:
    """Yield where a row's cameras differ from those of the protocol and the rig."""
    for eye in EYES:
        camera = expected.cameras[eye]
        for kind in ("K", "distortion", "cam_from_world"):
            found, wanted = row[f"{eye}_{kind}"], getattr(camera, kind)
            off = float(np.abs(found - wanted).max()) if found.shape == wanted.shape else np.inf
            if not off <= CAMERA_TOLERANCE:
                yield f"{eye}_{kind} is {off:.1e} off that of the protocol and the rig"
        if row[f"{eye}_depth"].shape != (camera.height, camera.width):
            yield f"{eye} grid is {row[f'{eye}_depth'].shape}, expected {(camera.height, camera.width)}"
    yield from _rig_problems(row, expected.baseline_m)


def _rig_problems(row: Mapping[str, Any], baseline_m: float) -> Iterator[str]:
    if abs(row["baseline_m"] - baseline_m) > CAMERA_TOLERANCE:
        yield f"baseline_m is {row['baseline_m']}, expected {baseline_m}"
    left_m, right_m = (camera_centre(row[f"{eye}_cam_from_world"]) for eye in EYES)
    apart_m = float(np.linalg.norm(right_m - left_m))
    if not abs(apart_m - row["baseline_m"]) <= 1e-9:
        yield f"the eyes stand {apart_m:.9f} m apart, baseline_m is {row['baseline_m']}"
    for eye in EYES:
        rotation = row[f"{eye}_cam_from_world"][:3, :3]
        off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
        if not off <= CAMERA_TOLERANCE or not np.linalg.det(rotation) > 0:
            yield f"{eye}_cam_from_world is no rigid pose (off by {off:.1e})"
