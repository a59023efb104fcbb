"""From the description of an assembly to its bars and meshes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.lattice import lattice_assembly
from dataset_builder.mesh_door import load_assembly
from dataset_builder.model import Assembly
from dataset_builder.specs import LatticeSpec, MeshFileSpec

_TARGET_DECIMALS = 3


def make_assembly(spec: LatticeSpec | MeshFileSpec) -> Assembly:
    """Return the bars and meshes of an assembly; raise ``MeshError`` where a mesh file cannot serve."""
    if isinstance(spec, MeshFileSpec):
        return load_assembly(spec)
    return lattice_assembly(spec)


def aim_point_m(assembly: Assembly) -> Float64[ndarray, 3]:
    """Return what cameras look at: the middle of the steel's bounding box, to the millimetre.

    Rounding keeps ribs and float32 storage from moving the cameras.
    """
    vertices = np.concatenate([part.mesh.vertices_m for part in assembly.parts])
    middle: Float64[ndarray, 3] = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return np.asarray(np.round(middle, _TARGET_DECIMALS) + 0.0)  # no negative zero
