"""Steel of a scene with the space for cameras round it: tests of where an eye may be and what it sees.

World frame, metres.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from dataset_builder.config.surroundings import CameraSpace
from dataset_builder.scene.model import NOT_STEEL, Assembly, Part, WorldMesh
from dataset_builder.scene.raycast import RayCaster
from dataset_builder.scene.shapes.point_sets import SurfaceSampler, covering_points
from dataset_builder.scene.shapes.solids import merge_meshes

SIGHT_TOLERANCE_M = 0.01
"""Largest distance along the line of sight between its first hit and the aimed point: about a bar's radius."""


class CameraSite:
    """Steel of an assembly and other ``obstacles``, with the space for cameras; ``surface`` samples the steel.

    Distances of eyes are to points of the surfaces of which one is within ``spacing_m`` of every point.
    """

    def __init__(
        self, assembly: Assembly, space: CameraSpace, spacing_m: float, obstacles: Sequence[Part] = ()
    ) -> None:
        from scipy.spatial import cKDTree  # Imported when needed: it takes a while.

        self.surface = SurfaceSampler(merge_meshes([part.mesh for part in assembly.parts]))
        parts = (*assembly.parts, *obstacles)
        surfaces = merge_meshes([part.mesh for part in parts])
        bar_id = np.repeat([part.bar_id for part in parts], [len(part.mesh.faces) for part in parts])
        self._caster = RayCaster(WorldMesh(surfaces.vertices_m, surfaces.faces, bar_id.astype(np.uint16)))
        self._spacing_m = spacing_m
        self._points = cKDTree(covering_points(surfaces, spacing_m))
        self._space = space

    def is_clear(
        self, eyes_m: Float64[ndarray, "n 3"], clearance_m: float | Float64[ndarray, " n"]
    ) -> Bool[ndarray, " n"]:
        """Return which eyes are in the space for cameras and at least ``clearance_m`` from steel and obstacles."""
        is_clear = self._space.contains(eyes_m)
        least_m = np.broadcast_to(clearance_m + self._spacing_m, len(eyes_m))[is_clear]
        farthest_m = float(least_m.max(initial=self._spacing_m))
        nearest_m, _ = self._points.query(eyes_m[is_clear], distance_upper_bound=farthest_m)
        is_clear[is_clear] = nearest_m >= least_m
        return is_clear

    def sees(self, eyes_m: Float64[ndarray, "n 3"], points_m: Float64[ndarray, "n 3"]) -> Bool[ndarray, " n"]:
        """Return from which eyes the points are seen: they are where the line of sight first meets a surface."""
        sight_m = points_m - eyes_m
        range_m = self._caster.hits(eyes_m, sight_m).range_m
        return np.asarray(np.abs(range_m - np.linalg.norm(sight_m, axis=1)) <= SIGHT_TOLERANCE_M)

    def ranges_m(
        self, world_from_eye: Float64[ndarray, "n 4 4"], rays: Float64[ndarray, "r 3"]
    ) -> Float64[ndarray, "n r"]:
        """Return the distance along each ray of each eye to steel, infinite where there is none in sight.

        The rays are in the frame of the eye.
        """
        directions = np.einsum("nij,rj->nri", world_from_eye[:, :3, :3], rays)
        origins_m = np.repeat(world_from_eye[:, :3, 3], len(rays), axis=0)
        hits = self._caster.hits(origins_m, directions.reshape(-1, 3))
        return np.asarray(np.where(hits.bar_id == NOT_STEEL, np.inf, hits.range_m).reshape(-1, len(rays)))
