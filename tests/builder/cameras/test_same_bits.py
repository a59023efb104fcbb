"""Cameras and generated cages with the same bits on processors for which BLAS and NumPy have different kernels."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable

import numpy as np
import pytest

from dataset_builder.cameras.rigs import rig_cameras
from dataset_builder.cameras.trajectories import look_at_with_rig
from dataset_builder.catalog.named_configs import CONFIGS
from dataset_builder.scene.cages.generate import FAMILIES, cage_assembly, generate_cage
from rebar_depth_bench.geometry.cameras import inverse_rigid, matrix_product

VECTORISED = "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX2 FMA3"
ENVIRONMENTS = (
    {"OPENBLAS_CORETYPE": "Prescott", "NPY_DISABLE_CPU_FEATURES": VECTORISED},
    {"OPENBLAS_CORETYPE": "Sandybridge"},
    {"OPENBLAS_CORETYPE": "Haswell"},
)
"""Kernels of OpenBLAS that run on every processor with AVX2; the first also without NumPy's vector functions."""


def cameras_digest() -> str:
    """Return a digest of cameras of all rigs at random places, of their inverse poses and of rays in the world."""
    digest, rng = hashlib.sha256(), np.random.default_rng(0)
    for rig in {name: factory().rig for name, factory in CONFIGS.items()}.values():
        for centre_m, target_m, roll_deg in zip(
            *rng.normal(size=(2, 20, 3)), rng.uniform(-20, 20, 20), strict=True
        ):
            pose = look_at_with_rig(centre_m, target_m, rig.baseline_m, roll_deg)
            for camera in rig_cameras(rig, pose).values():
                rays = matrix_product(rng.normal(size=(50, 3)), inverse_rigid(camera.cam_from_world)[:3, :3].T)
                digest.update(camera.cam_from_world.tobytes() + camera.K.tobytes() + rays.tobytes())
    return digest.hexdigest()


def cages_digest() -> str:
    """Return the digest of a cage of each family, its record and bars, and of the meshes of two."""
    digest = hashlib.sha256()
    for number, family in enumerate(FAMILIES):
        cage = generate_cage("train", number, 3, family)
        digest.update(json.dumps(cage.record).encode())
        for bar in cage.bars:
            digest.update(bar.line_m.tobytes() + (b"" if bar.nominal_m is None else bar.nominal_m.tobytes()))
        if family in ("beam", "pile-cage"):
            digest.update(cage_assembly(cage).vertices_m.tobytes())
    return digest.hexdigest()


@pytest.mark.slow
@pytest.mark.parametrize("digest", [cameras_digest, cages_digest])
def test_bits_are_the_same_with_all_kernels(digest: Callable[[], str]) -> None:
    command = [sys.executable, "-c", f"from {__name__} import {digest.__name__}; print({digest.__name__}())"]
    expected = digest()
    for environment in ENVIRONMENTS:
        process = subprocess.run(
            command, env={**os.environ, **environment}, capture_output=True, text=True, check=True
        )
        assert process.stdout.strip() == expected
