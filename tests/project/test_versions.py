"""``make versions``: interpreters that are found, and the core's tests with each."""

from __future__ import annotations

import os
import re
import subprocess
import tomllib
from pathlib import Path

import pytest

from tests.requirements import pip_environment, require_index

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "scripts" / "versions.sh"
CLASSIFIERS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["classifiers"]
VERSIONS = [name.rpartition(" ")[2] for name in CLASSIFIERS if re.search(r"Python :: 3\.\d+$", name)]


def find(version: str, **variables: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, **variables}
    command = [str(SCRIPT), "--find", version]
    return subprocess.run(command, capture_output=True, text=True, env=environment, check=False)


def write_program(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


def test_shim_that_does_not_start_is_passed_over(tmp_path: Path) -> None:
    write_program(tmp_path / "shims" / "python3.99", "echo 'command not found' >&2; exit 127")
    write_program(tmp_path / "pyenv" / "versions" / "3.99.0" / "bin" / "python", "echo 3.98")
    works = write_program(tmp_path / "pyenv" / "versions" / "3.99.1" / "bin" / "python", "echo 3.99")
    path = f"{tmp_path / 'shims'}:{os.environ['PATH']}"
    found = find("3.99", PATH=path, PYENV_ROOT=str(tmp_path / "pyenv"))
    assert (found.returncode, found.stdout) == (0, f"{works}\n")
    works.unlink()
    assert find("3.99", PATH=path, PYENV_ROOT=str(tmp_path / "pyenv")).returncode == 1


def test_missing_interpreter_fails_only_if_its_version_is_named(tmp_path: Path) -> None:
    named = subprocess.run([SCRIPT, "3.99"], capture_output=True, text=True, check=False)
    assert (named.returncode, named.stderr) == (1, "error: the tests failed with Python 3.99\n")
    assert "Python 3.99: skipped, no interpreter was found" in named.stdout


@pytest.mark.nightly
@pytest.mark.parametrize("version", [version for version in VERSIONS if version != "3.11"])
def test_core_works(version: str, tmp_path: Path) -> None:
    if find(version).returncode:
        pytest.skip(f"no interpreter of Python {version} was found")
    require_index(tmp_path / "downloads")
    environment = {name: value for name, value in pip_environment().items() if not name.startswith("PYTEST_")}
    finished = subprocess.run(
        [SCRIPT, version], capture_output=True, text=True, env=environment, timeout=3600, check=False
    )
    assert finished.returncode == 0, finished.stdout[-10_000:]
    (passed,) = re.findall(r"(\d+) passed", finished.stdout)
    # Files that need an extra are skipped; most tests do not.
    assert int(passed) > 1500
