"""Inputs of the audit checks: a config with its steel and board, and a stereo view with its two eyes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.model import ESTIMATED_ROLE
from dataset_builder.scene.variants.registry import PROPS_SLOT, variants_of_slot
from rebar_depth_bench.data.bars import Bar, with_axis
from rebar_depth_bench.data.columns import EYES
from rebar_depth_bench.data.eye_view import EyeView, eye_from_row
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.geometry.cameras import Camera, inverse_rigid, transform


@dataclass(frozen=True, eq=False)
class AuditedConfig:
    """Config under audit: its appearance variants, the bars of its scene, and its board (None without one)."""

    name: str
    variants: tuple[str, ...]
    steel: tuple[Bar, ...]
    board: BoardSpec | None

    @property
    def bars_with_known_axis(self) -> tuple[Bar, ...]:
        """Bars whose axes are known exactly; an axis fitted to the surface is no independent reference."""
        return tuple(bar for bar in with_axis(self.steel) if bar.role != ESTIMATED_ROLE)

    @property
    def has_props(self) -> bool:
        """Whether the scene has props, which may stand on the board or hide it."""
        return bool(variants_of_slot(self.variants, PROPS_SLOT))


@dataclass(frozen=True, eq=False)
class AuditedEye(EyeView):
    """Eye of a view under audit: it has pixel rays and the points that these determine.

    ``rays_cam`` are the pixel rays in the camera frame with z = 1, so that planar depth scales them to points.
    ``rgb`` is None in a config without colour.
    """

    rays_cam: Float64[ndarray, "h w 3"]

    @cached_property
    def points_m(self) -> Float64[ndarray, "h w 3"]:
        """World point of every pixel, metres; the camera centre for pixels without depth."""
        points_cam = self.rays_cam * self.depth_m[..., None].astype(np.float64)
        return transform(inverse_rigid(self.camera.cam_from_world), points_cam)


@dataclass(frozen=True, eq=False)
class AuditedView:
    """Stereo view under audit: its id and both eyes."""

    view_id: str
    left: AuditedEye
    right: AuditedEye

    @property
    def eyes(self) -> dict[str, AuditedEye]:
        """Both eyes by name (``left``, ``right``)."""
        return {"left": self.left, "right": self.right}


class RayCache:
    """Cache of pixel rays by grid.

    The views of a config share their grids, and the rays of a distorted grid take seconds to compute.
    """

    def __init__(self) -> None:
        self._rays: dict[tuple[bytes, bytes, int, int], Float64[ndarray, "h w 3"]] = {}

    def rays_cam(self, camera: Camera) -> Float64[ndarray, "h w 3"]:
        """Return ``pixel_rays`` of the camera's grid, a shared array that must not be modified."""
        key = (camera.K.tobytes(), camera.distortion.tobytes(), camera.width, camera.height)
        if key not in self._rays:
            # A config has one grid per eye; damaged rows with other cameras must not fill the memory.
            if len(self._rays) >= len(EYES):
                self._rays.clear()
            self._rays[key] = camera.rays()
        return self._rays[key]


def view_from_row(row: Mapping[str, Any], rays: RayCache) -> AuditedView:
    """Return the stereo view of a decoded row, whose arrays must have the shapes of the schema."""
    return AuditedView(row["view_id"], *(_eye_from_row(row, eye, rays) for eye in EYES))


def _eye_from_row(row: Mapping[str, Any], name: str, rays: RayCache) -> AuditedEye:
    eye = eye_from_row(row, name)
    return AuditedEye(**vars(eye), rays_cam=rays.rays_cam(eye.camera))
