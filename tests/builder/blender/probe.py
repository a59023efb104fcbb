"""Blender process in which a test module renders: ``python -m tests.builder.blender.probe MODULE FOLDER``."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
from numpy import ndarray

REPOSITORY = Path(__file__).parents[3]
TIMEOUT_S = 1800


def rendered_by(module: str, folder: Path) -> dict[str, ndarray]:
    """Return the arrays that ``probe(scratch)`` of a test module makes in a Blender process.

    ``probe`` must leave no files in its scratch folder.
    """
    command = [sys.executable, "-m", "tests.builder.blender.probe", module, str(folder)]
    process = subprocess.run(
        command, cwd=REPOSITORY, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
    )
    assert process.returncode == 0, process.stderr
    assert list((folder / "scratch").iterdir()) == []
    return dict(np.load(folder / "arrays.npz"))


if __name__ == "__main__":
    _scratch = Path(sys.argv[2]) / "scratch"
    _scratch.mkdir()
    np.savez(_scratch.parent / "arrays.npz", **import_module(sys.argv[1]).probe(_scratch))
