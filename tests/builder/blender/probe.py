"""Runs a test module in a process of its own, where it may import Blender."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
TIMEOUT_S = 1800


def run_probe(module: str, folder: Path) -> Path:
    """Run ``python -m module folder``, which leaves what it saw in ``folder``; return the folder."""
    command = [sys.executable, "-m", module, str(folder)]
    finished = subprocess.run(
        command, cwd=REPOSITORY, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
    )
    assert finished.returncode == 0, finished.stderr
    return folder
