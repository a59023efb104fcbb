"""Fixtures of the submission tests."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from rebar_depth_bench.base.errors import Problem
from tests.bench.submission.zips import EXPECTED, Record, build, check_archive

Check = Callable[[list[Record] | bytes], list[Problem]]


def located(problems: Iterable[Problem]) -> list[tuple[str, str]]:
    """Return code and location of every problem."""
    return [(problem.code, problem.where) for problem in problems]


@pytest.fixture
def check(tmp_path: Path) -> Check:
    """Return a function that writes an archive and returns its problems."""

    def problems_of(archive: list[Record] | bytes) -> list[Problem]:
        path = tmp_path / "submission.zip"
        path.write_bytes(archive if isinstance(archive, bytes) else build(archive))
        return check_archive(path, EXPECTED)

    return problems_of
