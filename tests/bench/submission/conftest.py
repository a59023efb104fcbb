from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from rebar_depth_bench.submission import check_archive
from tests.bench.submission.zips import EXPECTED, Record, build

Check = Callable[[list[Record] | bytes], list[str]]


@pytest.fixture
def check(tmp_path: Path) -> Check:
    """Write an archive and return its problems."""

    def problems_of(archive: list[Record] | bytes) -> list[str]:
        path = tmp_path / "submission.zip"
        path.write_bytes(archive if isinstance(archive, bytes) else build(archive))
        return check_archive(path, EXPECTED)

    return problems_of
