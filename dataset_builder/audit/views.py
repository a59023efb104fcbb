"""What checks look at: a config with what its manifest entry promises, and a view with its two eyes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8, UInt16
from numpy import ndarray

from dataset_builder.config.rigs import Camera
from dataset_builder.scene.model import ESTIMATED, Bar
from dataset_builder.scene.variants import LIGHT, THINGS, of_slot
from rebar_depth_bench.data.dataset import EYES
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.geometry.cameras import inverse_rigid, pixel_rays, transform


@dataclass(frozen=True, eq=False)
class AuditedConfig:
    """A config's manifest entry, the bars of its scene, and its board."""

    name: str
    entry: Mapping[str, Any]
    steel: tuple[Bar, ...]
    board: BoardSpec | None

    @property
    def drawn_steel(self) -> tuple[Bar, ...]:
        """The bars whose axes are known; an estimated axis is straight where its bar may be bent."""
        return tuple(bar for bar in self.steel if bar.role != ESTIMATED)

    @property
    def has_things(self) -> bool:
        """Whether the scene's appearance has things in it that may stand on the board or before it."""
        return bool(of_slot(self._variants, THINGS))

    @property
    def has_other_light(self) -> bool:
        """Whether the scene's appearance has light in which markers may not be found."""
        return bool(of_slot(self._variants, LIGHT))

    @property
    def _variants(self) -> Sequence[str]:
        return tuple(self.entry["scene"].get("appearance", {}).get("variants", ()))


@dataclass(frozen=True, eq=False)
class AuditedEye:
    """One eye of a view as its row holds it; ``rays_cam`` has z = 1, so that a ray's parameter is planar depth."""

    camera: Camera
    rgb: UInt8[ndarray, "h w 3"]
    depth_m: Float32[ndarray, "h w"]
    mask: Bool[ndarray, "h w"]
    bars: UInt16[ndarray, "h w"]
    rays_cam: Float64[ndarray, "h w 3"]

    @cached_property
    def points_m(self) -> Float64[ndarray, "h w 3"]:
        """Every pixel's point in the world frame, metres; the camera's centre where there is no depth."""
        points_cam = self.rays_cam * self.depth_m[..., None].astype(np.float64)
        return transform(inverse_rigid(self.camera.cam_from_world), points_cam)


@dataclass(frozen=True, eq=False)
class AuditedView:
    """A stereo view: its id and its eyes."""

    view_id: str
    left: AuditedEye
    right: AuditedEye

    @property
    def eyes(self) -> dict[str, AuditedEye]:
        """Both eyes by name."""
        return {"left": self.left, "right": self.right}


class RayMemory:
    """Pixel rays by grid: a config's views share theirs, and those of a distorted grid take seconds."""

    def __init__(self) -> None:
        self._rays: dict[tuple[bytes, bytes, int, int], Float64[ndarray, "h w 3"]] = {}

    def rays_cam(self, camera: Camera) -> Float64[ndarray, "h w 3"]:
        """Return ``pixel_rays`` of the camera's grid; the same array for the same grid, not to be written to."""
        key = (camera.K.tobytes(), camera.distortion.tobytes(), camera.width, camera.height)
        if key not in self._rays:
            if len(self._rays) >= len(EYES):  # a config has no more; damaged rows must not fill the memory
                self._rays.clear()
            self._rays[key] = pixel_rays(camera.K, camera.width, camera.height, camera.distortion)
        return self._rays[key]


def audited_view(row: Mapping[str, Any], rays: RayMemory) -> AuditedView:
    """Return a decoded row as a view to check; its arrays must have the shapes of the schema."""
    return AuditedView(row["view_id"], *(_eye(row, eye, rays) for eye in EYES))


def row_camera(row: Mapping[str, Any], eye: str) -> Camera:
    """Return one eye's camera as the row holds it."""
    height, width = row[f"{eye}_depth"].shape
    return Camera(row[f"{eye}_K"], row[f"{eye}_distortion"], row[f"{eye}_cam_from_world"], width, height)


def _eye(row: Mapping[str, Any], eye: str, rays: RayMemory) -> AuditedEye:
    camera = row_camera(row, eye)
    cells = {kind: row[f"{eye}_{kind}"] for kind in ("rgb", "mask", "bars")}
    return AuditedEye(camera=camera, depth_m=row[f"{eye}_depth"], rays_cam=rays.rays_cam(camera), **cells)
