"""One tiny dataset, rendered for real by ``rebar-build``, that most tests stand on."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rebar_depth_bench.dataset import load

TINY = ("--width", "160", "--height", "90", "--samples", "1")
TINY_VIEWS = 9
"""One more than a shard holds."""


def run_build(*arguments: str | Path, timeout_s: float = 600) -> subprocess.CompletedProcess[str]:
    """Run ``rebar-build`` as a user does."""
    command = [sys.executable, "-m", "dataset_builder", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)


@pytest.fixture(scope="session", autouse=True)
def _private_caches(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Keep the caches of ``datasets`` and the Hub away from the user's, and the network out."""
    folder = tmp_path_factory.mktemp("caches")
    os.environ["XDG_CACHE_HOME"] = str(folder)


@pytest.fixture(scope="session")
def tiny_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished dataset folder: two configs of the lattice, tiny."""
    root = tmp_path_factory.mktemp("tiny") / "dataset"
    for config, views in (("lattice", TINY_VIEWS), ("lattice-orbit", 2)):
        finished = run_build("--out", root, "--config", config, "--views", str(views), *TINY)
        assert finished.returncode == 0, finished.stderr
    return root


@pytest.fixture(scope="session")
def tiny_truth(tiny_root: Path) -> dict[str, np.ndarray]:
    """The left depth of every view of the tiny ``lattice`` config, by view id."""
    rows = load(tiny_root, "lattice", columns=["view_id", "left_depth"])
    return {row["view_id"]: row["left_depth"] for row in rows}


@pytest.fixture(scope="session")
def tiny_masks(tiny_root: Path) -> dict[str, np.ndarray]:
    """The left steel mask of every view of the tiny ``lattice`` config, by view id."""
    rows = load(tiny_root, "lattice", columns=["view_id", "left_mask"])
    return {row["view_id"]: row["left_mask"] for row in rows}


@pytest.fixture
def archive_of(tmp_path: Path) -> Callable[..., Path]:
    """Write predictions, by view id, as a submission archive."""
    from rebar_depth_bench import SubmissionWriter

    def write(predictions: dict[str, np.ndarray], name: str = "submission.zip") -> Path:
        with SubmissionWriter(tmp_path / name, method="test") as writer:
            for view_id, depth_m in predictions.items():
                writer.add(view_id, depth_m)
        return tmp_path / name

    return write
