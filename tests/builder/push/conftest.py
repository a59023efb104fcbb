"""Fixture of the tests of pushes."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.builder.push.published import write_publishable


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_publishable(tmp_path / "dataset")
