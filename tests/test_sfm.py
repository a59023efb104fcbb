"""The similarity by which the SfM benchmark lays its cameras on the true ones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from benchmarks.sfm import rotation_deg, similarity

ANGLE = st.floats(-3.0, 3.0)


@given(st.tuples(ANGLE, ANGLE, ANGLE), st.floats(0.01, 100.0), st.booleans())
def test_the_similarity_is_found_on_a_ring_and_on_a_dome(
    turn: tuple[float, float, float], scale: float, flat: bool
) -> None:
    azimuth = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    height = np.full(24, 0.2) if flat else 0.2 + 0.1 * np.sin(3 * azimuth)
    source = np.stack([0.3 * np.cos(azimuth), 0.3 * np.sin(azimuth), height], axis=-1)
    rotation = Rotation.from_rotvec(turn).as_matrix()
    target = scale * source @ rotation.T + [1.0, -2.0, 3.0]
    found_scale, found_rotation, found_translation = similarity(source, target)
    assert found_scale == pytest.approx(scale, rel=1e-9)
    assert np.linalg.det(found_rotation) == pytest.approx(1)
    assert rotation_deg(found_rotation @ rotation.T) < 1e-6
    assert found_translation == pytest.approx([1.0, -2.0, 3.0], abs=1e-7 * max(scale, 1))
