"""Archives of predictions that are not metric, and their results."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import rebar_depth_bench as rdb
from rebar_depth_bench.scoring.result import Result

Values = np.ndarray
Write = Callable[..., Path]


def disparity(depth_m: Values) -> Values:
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(depth_m > 0, 30 / depth_m - 70, -99), np.float32)


@pytest.fixture
def write(tiny_truth: dict[str, np.ndarray], tmp_path: Path) -> Write:
    """Write an archive of a function of the true depth of the lattice."""

    def write_archive(name: str, kind: str | None, make: Callable[[Values], Values]) -> Path:
        path = tmp_path / f"{name}.zip"
        with rdb.SubmissionWriter(path, name, prediction=kind, inputs="rgb", uses_ground_truth=False) as writer:
            for number, (view_id, depth_m) in enumerate(tiny_truth.items()):
                rng = np.random.default_rng(number)
                writer.add(view_id, make(depth_m) * (1 + 0.01 * rng.standard_normal(depth_m.shape)))
        return path

    return write_archive


@pytest.fixture
def relative(write: Write, tiny_root: Path) -> Result:
    return rdb.score(write("net", "affine-disparity", disparity), tiny_root)
