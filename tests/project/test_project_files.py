"""Project files: citation, changelog, workflow, forms and hooks agree with schemas, the package and each other."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import tomllib
from datetime import date
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest
import yaml

from rebar_depth_bench.reporting.published import load_published

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
FORMS = sorted(
    set((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml")) - {ROOT / ".github/ISSUE_TEMPLATE/config.yml"}
)
SCHEMAS = {
    "citation-file-format": [ROOT / "CITATION.cff"],
    "dependabot": [ROOT / ".github" / "dependabot.yml"],
    "github-issue-config": [ROOT / ".github" / "ISSUE_TEMPLATE" / "config.yml"],
    "github-issue-forms": FORMS,
    "github-workflows": WORKFLOWS,
}
KINDS = ["Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"]
"""Sections of a release, in the order of Keep a Changelog."""


def read_yaml(path: Path) -> Any:
    return yaml.safe_load(path.read_text())


def make_targets() -> set[str]:
    return set(re.findall(r"^([a-z-]+):.*##", (ROOT / "Makefile").read_text(), flags=re.MULTILINE))


def releases() -> dict[str, str]:
    """Return the text of each entry of the changelog by its heading, in order."""
    _, *entries = re.split(r"^## ", (ROOT / "CHANGELOG.md").read_text(), flags=re.MULTILINE)
    return dict(entry.split("\n", 1) for entry in entries)


@pytest.mark.parametrize("schema", SCHEMAS)
def test_file_follows_the_schema_of_its_host(schema: str) -> None:
    assert SCHEMAS[schema]
    command = [
        sys.executable,
        "-m",
        "check_jsonschema",
        "--builtin-schema",
        f"vendor.{schema}",
        *map(str, SCHEMAS[schema]),
    ]
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    assert finished.returncode == 0, finished.stdout


def test_citation_describes_the_released_package_and_the_paper() -> None:
    citation = read_yaml(ROOT / "CITATION.cff")
    assert citation["title"] == PROJECT["name"]
    assert citation["version"] == PROJECT["version"]
    assert citation["license"] == PROJECT["license"]
    assert f"[{citation['version']}] - {citation['date-released']}" in releases()
    (paper,) = citation["references"]
    assert paper["title"] == load_published().title
    assert paper["url"] in PROJECT["urls"].values()


def test_changelog_has_an_entry_for_the_version_of_the_package() -> None:
    unreleased, *released = releases()
    assert unreleased == "[Unreleased]"
    matches = [re.fullmatch(r"\[(\d+)\.(\d+)\.(\d+)\] - (\d{4}-\d\d-\d\d)", heading) for heading in released]
    assert all(matches)
    versions = [tuple(map(int, match.groups()[:3])) for match in matches if match]
    assert versions == sorted(versions, reverse=True)
    assert ".".join(map(str, versions[0])) == PROJECT["version"]
    dates = [date.fromisoformat(match[4]) for match in matches if match]
    assert dates == sorted(dates, reverse=True)


def test_changelog_groups_changes_by_kind() -> None:
    for heading, text in releases().items():
        kinds = re.findall(r"^### (.+)$", text, flags=re.MULTILINE)
        assert kinds == [kind for kind in KINDS if kind in kinds], heading
        before = re.split(r"^### ", text, flags=re.MULTILINE)[0]
        assert "\n- " not in before, f"{heading}: changes without a kind"


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_workflow_has_few_rights_and_runs_what_exists(path: Path) -> None:
    workflow = read_yaml(path)
    assert workflow["permissions"] == {"contents": "read"}
    assert all("permissions" not in job for job in workflow["jobs"].values())
    steps = [step for job in workflow["jobs"].values() for step in job["steps"]]
    actions = [step["uses"] for step in steps if "uses" in step]
    assert all(re.fullmatch(r"actions/[a-z-]+@v\d+", action) for action in actions)
    checkouts = [step for step in steps if step.get("uses", "").startswith("actions/checkout@")]
    assert len(checkouts) == len(workflow["jobs"])
    assert all(step["with"]["persist-credentials"] is False for step in checkouts)
    commands = [shlex.split(re.sub(r"\$\{\{.*?\}\}", "X", step["run"])) for step in steps if "run" in step]
    assert {command[0] for command in commands} == {"make"}
    assert {command[1] for command in commands} <= make_targets()
    assert {"versions", "test", "docs"} == {command[1] for command in commands}
    assert "VERSIONS" in (ROOT / "Makefile").read_text()


def test_workflow_classifiers_and_requirement_name_the_same_versions() -> None:
    core = read_yaml(ROOT / ".github" / "workflows" / "ci.yml")["jobs"]["core"]
    versions = core["strategy"]["matrix"]["python"]
    pattern = r"Programming Language :: Python :: (3\.\d+)"
    assert versions == [match[1] for name in PROJECT["classifiers"] if (match := re.fullmatch(pattern, name))]
    assert PROJECT["requires-python"] == f">={versions[0]}"


def test_pull_request_template_names_existing_targets_and_files() -> None:
    named = re.findall(r"`([^`]+)`", (ROOT / ".github" / "pull_request_template.md").read_text())
    targets = {name.removeprefix("make ") for name in named if name.startswith("make ")}
    files = {name for name in named if not name.startswith("make ")}
    assert targets
    assert targets <= make_targets()
    assert files
    assert all((ROOT / name).is_file() for name in files)


def test_hooks_run_installed_programs_on_existing_files() -> None:
    config = read_yaml(ROOT / ".pre-commit-config.yaml")
    hooks = [hook for repo in config["repos"] for hook in repo["hooks"]]
    assert {repo["repo"] for repo in config["repos"]} == {"local"}, "versions are those of constraints.txt"
    assert {"ruff-format", "ruff-check", "mypy", "lint-imports"} <= {hook["id"] for hook in hooks}
    programs = {point.name for point in entry_points(group="console_scripts")} | {"ruff"}
    files = [path.relative_to(ROOT).as_posix() for paths in SCHEMAS.values() for path in paths]
    for hook in hooks:
        folder, _, program = shlex.split(hook["entry"])[0].rpartition("/")
        assert (folder, program in programs) == (".venv/bin", True), hook["entry"]
        if "files" in hook:
            assert any(re.search(hook["files"], name) for name in files), hook["files"]


def test_configuration_of_hooks_is_valid() -> None:
    command = [sys.executable, "-m", "pre_commit", "validate-config", str(ROOT / ".pre-commit-config.yaml")]
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    assert finished.returncode == 0, finished.stdout


def test_editor_configuration_uses_the_line_length_of_the_linter() -> None:
    linter = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["ruff"]
    assert f"max_line_length = {linter['line-length']}\n" in (ROOT / ".editorconfig").read_text()
