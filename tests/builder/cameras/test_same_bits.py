"""Poses and rays with the same bits on processors for which BLAS has different kernels."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest

from dataset_builder.cameras.rigs import rig_cameras
from dataset_builder.cameras.trajectories import look_at_with_rig
from dataset_builder.catalog.named_configs import CONFIGS
from rebar_depth_bench.geometry.cameras import inverse_rigid, matrix_product

KERNELS = ("Prescott", "Sandybridge", "Haswell")
"""Processors whose kernels of OpenBLAS, which NumPy's wheels contain, run on every processor with AVX2."""


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


def run_with(kernel: str, program: str) -> str:
    environment = {**os.environ, "OPENBLAS_CORETYPE": kernel}
    command = [sys.executable, "-c", program]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout


@pytest.mark.slow
def test_cameras_have_the_same_bits_with_all_kernels_of_blas() -> None:
    product = "import numpy as np; a = np.random.default_rng(0).normal(size=(4, 4)); print((a @ a).tobytes())"
    if len({run_with(kernel, product) for kernel in KERNELS}) == 1:
        pytest.skip("this NumPy has no OpenBLAS whose kernel can be chosen")
    program = "from tests.builder.cameras.test_same_bits import cameras_digest; print(cameras_digest())"
    assert {run_with(kernel, program).strip() for kernel in KERNELS} == {cameras_digest()}
