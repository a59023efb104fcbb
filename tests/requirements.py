"""System packages that some tests need, by the list of ``make`` and CI, and the type of ``repetitions``."""

from __future__ import annotations

import ctypes.util
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

Repetitions = Callable[[int, int], int]
"""Type of the fixture ``repetitions``: ``repetitions(few, many)``."""

PACKAGES = Path(__file__).parents[1] / "scripts" / "system-packages.txt"


def probes(use: str) -> dict[str, str]:
    """Return the probes of one use (``blender``, ``browser``, ...) and the Debian package of each."""
    rows = [line.split() for line in PACKAGES.read_text().splitlines() if not line.startswith("#")]
    return {probe: package for kind, probe, package in rows if kind == use}


def chromium_path() -> str | None:
    """Return the path of the system's Chromium or Chrome."""
    return shutil.which("chromium") or shutil.which("google-chrome")


def program_path(name: str) -> str | None:
    """Return the path of a program, which may be one that Debian keeps out of the ``PATH`` of users."""
    return shutil.which(name, path=f"{os.environ['PATH']}:/usr/sbin")


def is_present(probe: str) -> bool:
    """Return whether a library or program of the list is on this machine."""
    if ".so." in probe:
        return ctypes.util.find_library(probe.removeprefix("lib").split(".so.")[0]) is not None
    return (chromium_path() if probe == "chromium" else program_path(probe)) is not None


def require(use: str) -> None:
    """Skip the test unless the packages of ``use`` are installed; fail instead where ``CI`` is true."""
    # Fonts change only how pages look, and other distributions keep them elsewhere.
    programs = {probe: package for probe, package in probes(use).items() if not probe.startswith("/")}
    missing = [package for probe, package in programs.items() if not is_present(probe)]
    if missing:
        reason = f"missing system packages; on Debian: apt-get install {' '.join(missing)}"
        if os.environ.get("CI") == "true":
            pytest.fail(reason)
        pytest.skip(reason)


def pip_environment() -> dict[str, str]:
    """Return the environment of a pip with the settings and the cache of the user, not those of the tests."""
    removed = ("PYTHONPATH", "VIRTUAL_ENV", "XDG_CACHE_HOME")
    return {name: value for name, value in os.environ.items() if name not in removed}


def require_index(folder: Path) -> None:
    """Skip the test unless pip can download a package into ``folder``; fail instead where ``CI`` is true."""
    command = [
        sys.executable,
        "-m",
        "pip",
        "download",
        "--quiet",
        "--no-deps",
        "--dest",
        str(folder),
        "setuptools>=77",
    ]
    finished = subprocess.run(command, capture_output=True, text=True, env=pip_environment(), check=False)
    if finished.returncode:
        last_line = (finished.stderr.strip() or "pip ended with an error").splitlines()[-1]
        reason = f"no package index can be reached: {last_line}"
        if os.environ.get("CI") == "true":
            pytest.fail(reason)
        pytest.skip(reason)
