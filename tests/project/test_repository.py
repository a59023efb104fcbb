"""Files and scripts of the repository: schemas, changelog, workflow, system packages and interpreters."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

from rebar_depth_bench.reporting.published import load_published
from tests import requirements
from tests.project.pages import DOCS, ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
GITHUB = ROOT / ".github"
WORKFLOWS = sorted((GITHUB / "workflows").glob("*.yml"))
SCHEMAS = {
    "citation-file-format": [ROOT / "CITATION.cff"],
    "dependabot": [GITHUB / "dependabot.yml"],
    "github-issue-config": [GITHUB / "ISSUE_TEMPLATE" / "config.yml"],
    "github-issue-forms": sorted(
        set(GITHUB.glob("ISSUE_TEMPLATE/*.yml")) - {GITHUB / "ISSUE_TEMPLATE" / "config.yml"}
    ),
    "github-workflows": WORKFLOWS,
}
VERSIONS = [match[1] for name in PROJECT["classifiers"] if (match := re.search(r"Python :: (3\.\d+)$", name))]


def read_yaml(path: Path) -> Any:
    return yaml.safe_load(path.read_text())


def releases() -> dict[str, str]:
    """Return the text of each entry of the changelog by its heading, in order."""
    _, *entries = re.split(r"^## ", (ROOT / "CHANGELOG.md").read_text(), flags=re.MULTILINE)
    return dict(entry.split("\n", 1) for entry in entries)


@pytest.mark.slow
@pytest.mark.parametrize("schema", SCHEMAS)
def test_file_follows_the_schema_of_its_host(schema: str) -> None:
    assert SCHEMAS[schema]
    command = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", f"vendor.{schema}"]
    finished = subprocess.run([*command, *SCHEMAS[schema]], capture_output=True, text=True, check=False)
    assert finished.returncode == 0, finished.stdout


@pytest.mark.slow
def test_configuration_of_hooks_is_valid_and_downloads_nothing() -> None:
    config = ROOT / ".pre-commit-config.yaml"
    subprocess.run([sys.executable, "-m", "pre_commit", "validate-config", config], check=True)
    hooks = [hook for repo in read_yaml(config)["repos"] for hook in repo["hooks"]]
    assert {repo["repo"] for repo in read_yaml(config)["repos"]} == {"local"}, "versions are in constraints.txt"
    assert {"ruff-format", "ruff-check", "mypy", "lint-imports"} <= {hook["id"] for hook in hooks}


def test_citation_describes_the_released_package_and_the_paper() -> None:
    citation = read_yaml(ROOT / "CITATION.cff")
    assert [citation[name] for name in ("title", "version", "license")] == [
        PROJECT[name] for name in ("name", "version", "license")
    ]
    assert f"[{citation['version']}] - {citation['date-released']}" in releases()
    (paper,) = citation["references"]
    assert paper["title"] == load_published().title
    assert paper["url"] in PROJECT["urls"].values()


def test_changelog_starts_with_unreleased_changes_and_this_version() -> None:
    unreleased, newest, *_ = releases()
    assert unreleased == "[Unreleased]"
    assert re.fullmatch(rf"\[{re.escape(PROJECT['version'])}\] - \d{{4}}-\d\d-\d\d", newest)


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_workflow_has_few_rights_and_runs_make(path: Path) -> None:
    workflow = read_yaml(path)
    assert workflow["permissions"] == {"contents": "read"}
    assert all("permissions" not in job for job in workflow["jobs"].values())
    steps = [step for job in workflow["jobs"].values() for step in job["steps"]]
    actions = [step["uses"] for step in steps if "uses" in step]
    assert all(re.fullmatch(r"actions/[a-z-]+@v\d+", action) for action in actions)
    checkouts = [step for step in steps if step.get("uses", "").startswith("actions/checkout@")]
    assert len(checkouts) == len(workflow["jobs"])
    assert all(step["with"]["persist-credentials"] is False for step in checkouts)
    commands = [shlex.split(re.sub(r"\$\{\{.*?\}\}", "X", step["run"]))[:2] for step in steps if "run" in step]
    made = {("make", "versions"), ("make", "test"), ("make", "docs")}
    expected = made | {("python", "-m"), ("docker", "build"), ("docker", "run")}
    assert {tuple(command) for command in commands} == expected


def test_workflow_classifiers_and_requirement_name_the_same_versions() -> None:
    core = read_yaml(GITHUB / "workflows" / "ci.yml")["jobs"]["core"]
    assert core["strategy"]["matrix"]["python"] == VERSIONS
    assert PROJECT["requires-python"] == f">={VERSIONS[0]}"


def test_demo_neither_uses_nor_changes_the_environment_of_developers() -> None:
    def commands(target: str) -> str:
        made = subprocess.run(["make", "--dry-run", target], cwd=ROOT, capture_output=True, text=True, check=True)
        return made.stdout

    demo, dev = (re.findall(r"environment\.sh \S+ (\S+)", commands(target)) for target in ("demo", "env-dev"))
    assert len(demo) == len(dev) == 1
    assert demo != dev
    assert f"{demo[0]}/bin/rebar-bench demo" in commands("demo")
    assert demo[0] in commands("clean").split()


def write_program(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


def libraries() -> str:
    """Return the libraries of Blender and the browser as ``ldconfig`` lists them."""
    probes = requirements.probes("blender") | requirements.probes("browser")
    return "".join(f"\\t{probe} (libc6) => /lib/{probe}\\n" for probe in probes if ".so." in probe)


def test_quick_start_lists_all_system_packages() -> None:
    commands = re.findall(r"^apt-get install (.+)$", (DOCS / "quick-start.md").read_text(), flags=re.MULTILINE)
    uses = ("blender", "browser", "uploads", "proxy")
    listed = [package for use in uses for package in requirements.probes(use).values()]
    assert sorted(" ".join(commands).split()) == sorted(listed)


@pytest.mark.parametrize(
    ("user", "uses", "found", "status", "words"),
    [
        ("1000", "blender", "\\tlibc.so.6 (libc6)\\n", 1, "error: missing system packages; on Debian install"),
        ("0", "blender", "\\tlibc.so.6 (libc6)\\n", 0, "installing system packages: "),
        ("1000", "blender browser uploads", libraries(), 0, "warning: missing system packages; tests that need"),
        ("1000", "blender uploads", "", 0, "warning: missing system packages; tests that need"),
        ("0", "blender", libraries(), 0, ""),
    ],
    ids=["user", "root", "only Blender is complete", "no ldconfig", "complete"],
)
def test_missing_packages_are_installed_or_named(
    user: str, uses: str, found: str, status: int, words: str, tmp_path: Path
) -> None:
    for name, output in (("id", user), ("ldconfig", found), ("apt-get", "")):
        write_program(tmp_path / name, f'echo "{name} $*" >> "{tmp_path}/calls"\nprintf "{output}"')
    for name in ("bash", "dirname", "grep"):
        (tmp_path / name).symlink_to(f"/usr/bin/{name}")
    command = ["/bin/bash", str(ROOT / "scripts" / "system_packages.sh"), *uses.split()]
    finished = subprocess.run(command, capture_output=True, text=True, check=False, env={"PATH": str(tmp_path)})
    assert finished.returncode == status
    assert finished.stderr.startswith(words)
    assert ("curl" in finished.stderr) == ("uploads" in uses)
    packages = " ".join(requirements.probes("blender").values())
    assert (packages in finished.stderr) == (words[:2] in ("er", "in"))
    installs = f"install -y -qq --no-install-recommends {packages}" in (tmp_path / "calls").read_text()
    assert installs == words.startswith("installing")


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
    write_program(tmp_path / "make", f'env > "{tmp_path}/environment"\necho "$*" > "{tmp_path}/target"')
    variables = {"PIP_INDEX_URL": "http://index", "https_proxy": "http://proxy", "PYTHONSAFEPATH": "1", "X": "y"}
    environment = {**variables, "HOME": str(tmp_path), "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    subprocess.run([ROOT / ".ci" / "run"], check=True, env=environment)
    names = {line.partition("=")[0] for line in (tmp_path / "environment").read_text().splitlines()}
    kept = {"CI", "HOME", "LANG", "PATH", "PIP_INDEX_URL", "https_proxy"}
    assert names - {"PWD", "OLDPWD", "SHLVL", "_"} == kept
    assert (tmp_path / "target").read_text() == "test\n"


def versions(*arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run the script of ``make versions``."""
    command = [str(ROOT / "scripts" / "versions.sh"), *arguments]
    inherited = {name: text for name, text in requirements.pip_environment().items() if name[:7] != "PYTEST_"}
    environment = inherited | variables
    return subprocess.run(command, capture_output=True, text=True, env=environment, timeout=3600, check=False)


def test_interpreter_that_does_not_start_is_passed_over(tmp_path: Path) -> None:
    write_program(tmp_path / "shims" / "python3.99", "echo 'command not found' >&2; exit 127")
    write_program(tmp_path / "pyenv" / "versions" / "3.99.0" / "bin" / "python", "echo 3.98")
    works = write_program(tmp_path / "pyenv" / "versions" / "3.99.1" / "bin" / "python", "echo 3.99")
    places = {"PATH": f"{tmp_path / 'shims'}:{os.environ['PATH']}", "PYENV_ROOT": str(tmp_path / "pyenv")}
    found = versions("--find", "3.99", **places)
    assert (found.returncode, found.stdout) == (0, f"{works}\n")
    works.unlink()
    missing = versions("3.99", **places)
    assert (missing.returncode, missing.stderr) == (1, "error: the tests failed with Python 3.99\n")
    assert "Python 3.99: skipped, no interpreter was found" in missing.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    "version", [pytest.param(one, marks=[pytest.mark.nightly] if one != VERSIONS[0] else []) for one in VERSIONS]
)
def test_quick_tests_of_the_core_pass_with_base_dependencies_alone(version: str, tmp_path: Path) -> None:
    if versions("--find", version).returncode:
        pytest.skip(f"no interpreter of Python {version} was found")
    requirements.require_index(tmp_path / "downloads")
    finished = versions(version)
    assert finished.returncode == 0, finished.stdout[-10_000:]
    (passed,) = re.findall(r"(\d+) passed", finished.stdout)
    # Files that need an extra are skipped; most tests do not.
    assert int(passed) > 1000
