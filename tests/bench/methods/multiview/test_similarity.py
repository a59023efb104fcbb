"""Similarity transform fitted to corresponding points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rebar_depth_bench.methods.multiview.pipeline import fit_similarity

ANGLE = st.floats(-3.0, 3.0)
ROTATION_VECTOR = st.tuples(ANGLE, ANGLE, ANGLE)


@given(ROTATION_VECTOR, st.floats(0.01, 100.0), st.booleans())
def test_fit_similarity_on_ring_and_dome(turn: tuple[float, float, float], scale: float, flat: bool) -> None:
    azimuth = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    height = np.full(24, 0.2) if flat else 0.2 + 0.1 * np.sin(3 * azimuth)
    source = np.stack([0.3 * np.cos(azimuth), 0.3 * np.sin(azimuth), height], axis=-1)
    rotation = Rotation.from_rotvec(turn).as_matrix()
    target = scale * source @ rotation.T + [1.0, -2.0, 3.0]
    fit = fit_similarity(source, target)
    assert fit.scale == pytest.approx(scale, rel=1e-9)
    assert np.linalg.det(fit.rotation) == pytest.approx(1)
    assert np.degrees(Rotation.from_matrix(fit.rotation @ rotation.T).magnitude()) < 1e-6
    assert fit.translation == pytest.approx([1.0, -2.0, 3.0], abs=1e-7 * max(scale, 1))
    assert fit.apply(source) == pytest.approx(target, abs=1e-7 * max(scale, 1))
