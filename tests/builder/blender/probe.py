"""Subprocess runner for test modules that need ``bpy``."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

REPOSITORY = Path(__file__).parents[3]
TIMEOUT_S = 1800

RunProbe = Callable[[str, Path], Path]


def run_probe(module: str, folder: Path) -> Path:
    """Run ``python -m module folder``, which writes its results into ``folder``; return ``folder``."""
    command = [sys.executable, "-m", module, str(folder)]
    process = subprocess.run(
        command, cwd=REPOSITORY, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
    )
    assert process.returncode == 0, process.stderr
    return folder
