"""From a rig's description to its two cameras, view by view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.specs import RigSpec
from rebar_depth_bench.cameras import ideal_K, right_of_rig


@dataclass(frozen=True, eq=False)
class Camera:
    """One eye: pinhole matrix (pixels), k1 k2 p1 p2 k3, pose and grid."""

    K: Float64[ndarray, "3 3"]
    distortion: Float64[ndarray, " 5"]
    cam_from_world: Float64[ndarray, "4 4"]
    width: int
    height: int


def rig_cameras(rig: RigSpec, cam_from_world: Float64[ndarray, "4 4"]) -> dict[str, Camera]:
    """Return the left and right camera of a rig whose physical left camera stands on a protocol's pose."""
    K = ideal_K(rig.width, rig.height)
    right = right_of_rig(cam_from_world, rig.baseline_m)
    return {
        eye: Camera(K, np.zeros(5), pose, rig.width, rig.height)
        for eye, pose in (("left", cam_from_world), ("right", right))
    }
