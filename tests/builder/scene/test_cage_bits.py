"""Generated cages with the same bits on processors for which BLAS and NumPy have different kernels."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Mapping

import numpy as np
import pytest

from dataset_builder.scene.cages.generate import FAMILIES, generate_cage
from dataset_builder.specs.config_specs import GeneratedCageSpec
from dataset_builder.user_files.make_assembly import make_assembly
from tests.builder.cameras.test_same_bits import KERNELS

VECTORISED = "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX2 FMA3"
ENVIRONMENTS: tuple[Mapping[str, str], ...] = (
    {"OPENBLAS_CORETYPE": KERNELS[0], "NPY_DISABLE_CPU_FEATURES": VECTORISED},
    *({"OPENBLAS_CORETYPE": kernel} for kernel in KERNELS[1:]),
)
"""Kernels of BLAS, the oldest with the kernels of NumPy's own functions for the same processor."""


def cages_digests() -> str:
    """Return digests of cages of all families, bars and records, and of their meshes."""
    bars, meshes = hashlib.sha256(), hashlib.sha256()
    for number, family in enumerate(FAMILIES):
        cage = generate_cage("train", number, 3, family)
        bars.update(json.dumps(cage.record).encode())
        for bar in cage.bars:
            bars.update(bar.line_m.tobytes() + (b"" if bar.nominal_m is None else bar.nominal_m.tobytes()))
        meshes.update(make_assembly(GeneratedCageSpec("train", number, 3, family)).vertices_m.tobytes())
    return f"{bars.hexdigest()} {meshes.hexdigest()}"


@pytest.mark.slow
def test_cages_have_the_same_bits_with_all_kernels() -> None:
    program = "from tests.builder.scene.test_cage_bits import cages_digests; print(cages_digests())"
    found = {
        subprocess.run(
            [sys.executable, "-c", program],
            env={**os.environ, **environment},
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()
        for environment in ENVIRONMENTS
    }
    assert found == {cages_digests()}


@pytest.mark.parametrize("family", FAMILIES)
def test_axes_are_whole_nanometres(family: str) -> None:
    cage = generate_cage("validation", 0, 5, family)
    lines = [line for bar in cage.bars for line in (bar.line_m, bar.nominal_m) if line is not None]
    lines += [np.array(bar["nominal_axis"]) for bar in cage.record["left_out"]]
    for line_m in lines:
        assert np.array_equal(line_m, np.round(line_m, 9))
        assert not np.signbit(line_m[line_m == 0]).any()
