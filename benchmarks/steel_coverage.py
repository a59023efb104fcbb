"""Steel in the views of a config: share of the frame, depths, and views without steel, by shell.

python -m benchmarks.steel_coverage [CONFIG ...]

Every view of the full trajectory is cast at 160 x 90 against the steel alone, without rendering. Depths are those
of the left camera. The distance to the nearest steel is that from the left camera to the nearest bar, in any
direction. The defaults are the configs with the three domes.
"""

from __future__ import annotations

import sys

import numpy as np

from benchmarks.timing import print_markdown
from dataset_builder.config.catalog import BuildRequest
from dataset_builder.config.rigs import rig_cameras
from dataset_builder.config.specs import ConfigSpec, RingSpec
from dataset_builder.config.trajectories import poses
from dataset_builder.scene.assemblies import aim_point_m, make_assembly
from dataset_builder.scene.model import Assembly, WorldMesh
from dataset_builder.scene.raycast import RayCaster
from dataset_builder.scene.shapes.solids import merge_meshes
from dataset_builder.scene.steel_distance import Cylinders
from rebar_depth_bench.geometry.cameras import camera_centre

GRID = (160, 90)
HEADS = ["config", "radius, m", "views", "nearest steel, m", "steel depth, m", "left, %", "right, %", "no steel"]


def main(*configs: str) -> None:
    rows = []
    for spec in BuildRequest(configs or ("lattice", "pile", "pier"), None, *GRID).config_specs():
        radii_m, views = measure_views(spec)
        rows += [(spec.name, f"{m:g}", *_summary(views[radii_m == m])) for m in np.unique(radii_m)]
        rows.append((spec.name, "all", *_summary(views)))
    print_markdown(HEADS, rows)


def measure_views(spec: ConfigSpec) -> tuple[np.ndarray, np.ndarray]:
    """Return the radius of each view, and for each view five numbers, metres and shares of the frame.

    They are the distance to the nearest steel, the least and largest depth of steel in the left camera (NaN
    without steel), and the share of steel in the left and in the right frame.
    """
    assembly = make_assembly(spec.scene.assembly)
    left_poses = poses(spec.protocol, aim_point_m(assembly), spec.rig, assembly.bars)
    caster, cylinders = RayCaster(steel_mesh(assembly)), Cylinders.from_bars(assembly.bars)
    nearest_m = cylinders.distance_m(np.array([camera_centre(pose) for pose in left_poses]))
    rays = {eye: camera.rays() for eye, camera in rig_cameras(spec.rig, np.eye(4)).items()}
    views = []
    for pose, distance_m in zip(left_poses, nearest_m, strict=True):
        left, right = (caster.cast(camera, rays[eye]) for eye, camera in rig_cameras(spec.rig, pose).items())
        steel_m = left.depth_m[left.mask] if left.mask.any() else np.array([np.nan])
        views.append((distance_m, steel_m.min(), steel_m.max(), left.mask.mean(), right.mask.mean()))
    protocol = spec.protocol
    shells_m = [protocol.radius_m] if isinstance(protocol, RingSpec) else protocol.radii_m
    return np.repeat(shells_m, len(views) // len(shells_m)), np.array(views)


def steel_mesh(assembly: Assembly) -> WorldMesh:
    """Return the mesh of all bars, world frame."""
    mesh = merge_meshes([part.mesh for part in assembly.parts])
    bar_ids = [np.full(len(part.mesh.faces), part.bar_id, np.uint16) for part in assembly.parts]
    return WorldMesh(mesh.vertices_m, mesh.faces, np.concatenate(bar_ids))


def _summary(views: np.ndarray) -> tuple[object, ...]:
    nearest_m, near_m, far_m, left, right = views.T
    return (
        len(views),
        f"{nearest_m.min():.3f}-{nearest_m.max():.3f}",
        f"{np.nanmin(near_m):.3f}-{np.nanmax(far_m):.3f}",
        *(
            f"{100 * share.mean():.1f} ({100 * share.min():.1f}-{100 * share.max():.1f})"
            for share in (left, right)
        ),
        int(np.count_nonzero((left == 0) | (right == 0))),
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
