"""Fixture of tests that run code inside Blender."""

from __future__ import annotations

import pytest
from numpy import ndarray

from tests.builder.blender.probe import rendered_by


@pytest.fixture(scope="module")
def rendered(
    blender: None, request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, ndarray]:
    """Return the arrays that the function ``probe`` of the module makes in a Blender process."""
    return rendered_by(request.module.__name__, tmp_path_factory.mktemp("blender"))
