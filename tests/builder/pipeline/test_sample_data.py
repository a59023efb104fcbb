"""Sample dataset in the repository compared with a fresh render."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.building import contents
from tests.data.render import render


@pytest.mark.nightly
@pytest.mark.usefixtures("blender")
def test_sample_data_equals_fresh_render(tiny_root: Path, tmp_path: Path) -> None:
    render(tmp_path / "dataset")
    assert contents(tmp_path / "dataset") == contents(tiny_root), "run `make sample-data`"
