"""Cameras against the manifest: the protocol's pose of each view, seen through the config's rig.

From the manifest's plain JSON values back to the specs they were written from.

Depth against the lens model of OpenCV: each pixel's point, projected by ``cv2``, comes back to its pixel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.audit.report import Check
from dataset_builder.audit.views import AuditedConfig, AuditedEye, AuditedView
from dataset_builder.config.catalog import view_id
from dataset_builder.config.rigs import Camera, rig_cameras
from dataset_builder.config.specs import DomeSpec, ProtocolSpec, RigSpec, RingSpec, SweepSpec
from dataset_builder.config.trajectories import poses, subset
from dataset_builder.scene.assemblies import aim_point_m
from dataset_builder.scene.mesh_ply import read_mesh_ply
from dataset_builder.scene.model import NOT_STEEL, Assembly, Mesh, Part
from rebar_depth_bench.data.dataset import EYES
from rebar_depth_bench.errors import DatasetError
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.geometry.cameras import camera_centre
from rebar_depth_bench.geometry.stereo_calibration import Lens, StereoCalibration

_Spec = TypeVar("_Spec")
_PROTOCOLS: Mapping[str, Callable[..., ProtocolSpec]] = {"dome": DomeSpec, "ring": RingSpec, "sweep": SweepSpec}


def protocol_spec(config: str, entry: Mapping[str, Any]) -> ProtocolSpec:
    """Return the camera protocol of a config's manifest entry; raise ``DatasetError`` if it holds none."""
    return _read(config, "protocol", entry, _protocol)


def rig_spec(config: str, entry: Mapping[str, Any]) -> RigSpec:
    """Return the rig of a config's manifest entry; raise ``DatasetError`` if it holds none."""
    return _read(config, "rig", entry, _rig)


def board_spec(config: str, entry: Mapping[str, Any]) -> BoardSpec | None:
    """Return the board of a config's scene, None where it has none; raise ``DatasetError`` for a damaged one."""
    return _read(config, "board", entry["scene"], lambda board: None if board is None else BoardSpec(**board))


def _read(config: str, what: str, holder: Mapping[str, Any], maker: Callable[[Any], _Spec]) -> _Spec:
    try:
        return maker(holder[what])
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise DatasetError(
            f"manifest: the {what} of config {config} is {holder.get(what)!r}, expected one this version writes: "
            f"{type(error).__name__}: {error}"
        ) from None


def _protocol(values: Mapping[str, Any]) -> ProtocolSpec:
    return _PROTOCOLS[values["kind"]](**_with_tuples(values))


def _rig(values: Mapping[str, Any]) -> RigSpec:
    calibration = values.get("calibration")
    return RigSpec(**{**values, "calibration": None if calibration is None else _calibration(calibration)})


def _calibration(values: Mapping[str, Any]) -> StereoCalibration:
    lenses = {eye: Lens(**_with_tuples(values[eye])) for eye in ("left", "right")}
    return StereoCalibration(**{**_with_tuples(values), **lenses})


def _with_tuples(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values with JSON's lists as the tuples that specs hold."""
    return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}


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


MAX_PROJECTION_ERROR_PX = 1e-6
_PIXELS = 60_000
"""Of an eye, evenly spread: OpenCV also makes 15 derivatives a coordinate, seconds and 200 MB for all pixels."""


def view_projection_error_px(_: AuditedConfig, view: AuditedView) -> float:
    """Return the largest ``projection_error_px`` of both eyes."""
    return max(projection_error_px(eye) for eye in view.eyes.values())


def projection_error_px(eye: AuditedEye) -> float:
    """Return how far from its pixel a point lands at most, pixels; 0 for an eye that sees nothing.

    At most 60,000 pixels, evenly spread, are looked at. The point comes from the stored depth, our rays and the
    stored pose. Rodrigues vector and projection are OpenCV's (``cv2.projectPoints``, the model of its calib3d
    documentation), not ours.
    """
    seen = np.flatnonzero(eye.depth_m)
    if not len(seen):
        return 0.0
    if len(seen) > _PIXELS:
        seen = seen[np.linspace(0, len(seen) - 1, _PIXELS).astype(int)]
    pose = eye.camera.cam_from_world
    rotation_rad = cv2.Rodrigues(pose[:3, :3])[0]
    points_m = eye.points_m.reshape(-1, 3)[seen]
    found, _ = cv2.projectPoints(points_m, rotation_rad, pose[:3, 3], eye.camera.K, eye.camera.distortion)
    v, u = np.divmod(seen, eye.camera.width)
    return float(np.abs(found[:, 0] - np.stack([u, v], axis=1)).max())


def projection_verdict(config: AuditedConfig, errors_px: Sequence[float]) -> Check:
    """Hold the largest error of the views looked at against its bound."""
    worst_px = max(errors_px, default=0.0)
    problem = f"a pixel's point lands {worst_px:.2e} px from it in cv2.projectPoints"
    return Check(
        f"{config.name}: points through OpenCV's lens model",
        f"{len(errors_px)} views: at most {worst_px:.1e} px",
        f"{MAX_PROJECTION_ERROR_PX:g} px",
        () if worst_px <= MAX_PROJECTION_ERROR_PX else (problem,),
    )
