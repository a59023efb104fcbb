"""Fixtures of tests that run code inside Blender."""

from __future__ import annotations

import pytest

from tests.builder.blender import probe
from tests.builder.blender.probe import RunProbe


@pytest.fixture(scope="session")
def run_probe(blender: None) -> RunProbe:
    """Run a test module in a Blender process."""
    return probe.run_probe
