"""One tiny dataset, rendered for real by ``rebar-build``, that most tests stand on."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

# Before anything of ours is imported: libraries read these once.
_CACHES = tempfile.TemporaryDirectory(prefix="rebar-test-caches-")
os.environ.update(HF_HOME=_CACHES.name, XDG_CACHE_HOME=_CACHES.name, HF_HUB_OFFLINE="1")

from rebar_depth_bench import SubmissionWriter, load  # noqa: E402

# A shell that runs the tests in the background ignores this signal; what they start would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

# No test is timed: a busy machine is no failure.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")

TINY = ("--width", "160", "--height", "90", "--samples", "1")
TINY_VIEWS = 9
"""One more than a shard holds."""


def run_build(*arguments: str | Path, timeout_s: float = 3600) -> subprocess.CompletedProcess[str]:
    """Run ``rebar-build`` as a user does."""
    command = [sys.executable, "-m", "dataset_builder", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)


@pytest.fixture(scope="session", autouse=True)
def _private_caches() -> Iterator[None]:
    """Keep the caches of ``datasets`` and the Hub away from the user's, and the network out."""
    yield
    _CACHES.cleanup()


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

    def write(predictions: dict[str, np.ndarray], name: str = "submission.zip") -> Path:
        with SubmissionWriter(tmp_path / name, method="test") as writer:
            for view_id, depth_m in predictions.items():
                writer.add(view_id, depth_m)
        return tmp_path / name

    return write
