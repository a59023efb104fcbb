"""System packages: the same list in the documentation, make, CI and messages of skipped tests."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import pytest

from tests import requirements

SCRIPT = Path(__file__).parents[2] / "scripts" / "system_packages.sh"
PAGE = Path(__file__).parents[2] / "docs" / "quick-start.md"
USES = ("blender", "browser", "uploads")


def run(
    programs: Path, *uses: str, user: str = "1000", libraries: str = "\\tlibc.so.6 (libc6) => /lib/libc.so.6\\n"
) -> subprocess.CompletedProcess[str]:
    """Run the script with only ``programs`` in PATH, including stand-ins for id, ldconfig and apt-get."""
    for name, output in (("id", user), ("ldconfig", libraries), ("apt-get", "")):
        program = programs / name
        program.write_text(f'#!/bin/sh\necho "{name} $*" >> "{programs}/calls"\nprintf "{output}"\n')
        program.chmod(0o755)
    for name in ("bash", "dirname", "grep"):
        (programs / name).symlink_to(f"/usr/bin/{name}")
    return subprocess.run(
        ["/bin/bash", SCRIPT, *uses], capture_output=True, text=True, check=False, env={"PATH": str(programs)}
    )


def all_libraries() -> str:
    probes = requirements.probes("blender") | requirements.probes("browser")
    return "".join(f"\\t{probe} (libc6) => /lib/{probe}\\n" for probe in probes if ".so." in probe)


def test_page_lists_all_system_packages() -> None:
    commands = re.findall(r"^apt-get install (.+)$", PAGE.read_text(), flags=re.MULTILINE)
    listed = [package for use in USES for package in requirements.probes(use).values()]
    assert sorted(" ".join(commands).split()) == sorted(listed)


def test_missing_blender_library_stops_before_any_download(tmp_path: Path) -> None:
    process = run(tmp_path, "blender")
    assert process.returncode == 1
    assert f"apt-get install {' '.join(requirements.probes('blender').values())}" in process.stderr


def test_missing_browser_and_curl_only_warn(tmp_path: Path) -> None:
    process = run(tmp_path, "blender", "browser", "uploads", libraries=all_libraries())
    assert process.returncode == 0
    assert process.stderr.startswith("warning: missing system packages; tests that need them are skipped")
    assert "chromium" in process.stderr
    assert "curl" in process.stderr
    assert "libx11-6" not in process.stderr


def test_root_on_debian_installs_missing_packages(tmp_path: Path) -> None:
    process = run(tmp_path, "blender", user="0")
    packages = " ".join(requirements.probes("blender").values())
    assert process.returncode == 0
    assert process.stderr == f"installing system packages: {packages}\n"
    assert f"install -y -qq --no-install-recommends {packages}" in (tmp_path / "calls").read_text()


def test_without_ldconfig_only_programs_are_checked(tmp_path: Path) -> None:
    process = run(tmp_path, "blender", "uploads", libraries="")
    assert process.returncode == 0
    assert "apt-get install curl" in process.stderr


def test_complete_machine_installs_nothing(tmp_path: Path) -> None:
    process = run(tmp_path, "blender", user="0", libraries=all_libraries())
    assert (process.returncode, process.stderr) == (0, "")
    assert "apt-get" not in (tmp_path / "calls").read_text()


@pytest.mark.parametrize("is_ci", [False, True])
def test_missing_program_skips_test_and_fails_in_ci(
    is_ci: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("CI", str(is_ci).lower())
    expected = pytest.fail.Exception if is_ci else pytest.skip.Exception
    with pytest.raises(expected, match="apt-get install curl"):
        requirements.require("uploads")


def test_ci_keeps_only_variables_of_package_clients(tmp_path: Path) -> None:
    (tmp_path / "make").write_text(f'#!/bin/sh\nenv > "{tmp_path}/environment"\necho "$*" > "{tmp_path}/target"\n')
    (tmp_path / "make").chmod(0o755)
    variables = {
        "PIP_INDEX_URL": "http://index",
        "https_proxy": "http://proxy",
        "PYTHONDONTWRITEBYTECODE": "1",
        "X": "y",
    }
    environment = {**variables, "HOME": str(tmp_path), "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    subprocess.run([SCRIPT.parents[1] / ".ci" / "run"], check=True, env=environment)
    names = {line.partition("=")[0] for line in (tmp_path / "environment").read_text().splitlines()}
    assert names - {"PWD", "OLDPWD", "SHLVL", "_"} == {
        "CI",
        "HOME",
        "LANG",
        "PATH",
        "PIP_INDEX_URL",
        "https_proxy",
    }
    assert (tmp_path / "target").read_text() == "test\n"
