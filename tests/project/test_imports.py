"""Imports in a fresh interpreter, declared packages and public names."""

from __future__ import annotations

import ast
import json
import os
import re
import subprocess
import sys
import tomllib
from importlib import metadata
from importlib.util import find_spec
from itertools import chain

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import rebar_depth_bench
from tests.project.pages import ROOT

PACKAGES = ("cards", "dataset_builder", "leaderboard", "rebar_depth_bench")

MODULES_AFTER = """
import json, sys
def added():
    return sorted(set(sys.modules) - before)
before, found = set(sys.modules), {}
"""
"""Start of a script that notes the modules that each of several statements has added."""


def modules_after(**statements: str) -> dict[str, set[str]]:
    """Return, by name, the modules that are loaded after each statement, run in order in a new interpreter."""
    steps = [f"{statement}\nfound[{name!r}] = added()\n" for name, statement in statements.items()]
    code = f"{MODULES_AFTER}{''.join(steps)}print(json.dumps(found))"
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return {name: set(modules) for name, modules in json.loads(process.stdout).items()}


@pytest.mark.slow
def test_commands_import_only_what_they_need() -> None:
    parse = "from rebar_depth_bench.cli.main import argument_parser; argument_parser([{!r}])"
    found = modules_after(
        package="import rebar_depth_bench as rdb",
        version=parse.format("--version"),
        help=parse.format("--help"),
        export="from dataset_builder.cli import main; main.argument_parser(['export'])",
        cache=parse.format("cache"),
        scoring="rdb.score; rdb.load; rdb.SubmissionWriter; argument_parser()",
    )
    commands = {
        name: {one.removeprefix("rebar_depth_bench.cli.") for one in modules if "rebar_depth_bench.cli." in one}
        for name, modules in found.items()
    }
    assert commands["version"] == commands["help"] == {"main", "console"}
    assert commands["cache"] == {"main", "console", "cache"}
    builder = {name for name in found["export"] if name.startswith("dataset_builder")}
    assert builder == {"dataset_builder", "dataset_builder.cli", "dataset_builder.cli.main"}
    assert not found["export"] & {"datasets", "numpy", "pyarrow", "pydantic", "jinja2", "torch"}
    assert "rebar_depth_bench.scorer" in found["scoring"]
    # Each is slow to import, and imported on use.
    assert not found["scoring"] & {"torch", "cv2", "datasets", "huggingface_hub", "pandas", "scipy", "yaml"}


@pytest.mark.slow
def test_public_names_exist_and_others_raise_attribute_error() -> None:
    names = {"load", "score", "SubmissionWriter", "torch_loader", "Result", "SubmissionError"}
    assert names <= set(rebar_depth_bench.__all__)
    assert all(getattr(rebar_depth_bench, name).__name__ == name for name in names)
    with pytest.raises(AttributeError, match="has no attribute 'lod'"):
        rebar_depth_bench.lod  # noqa: B018


_IN_BLENDER = {"_cycles", "mathutils"}
"""Modules that come with bpy."""


@pytest.mark.slow
def test_every_imported_package_is_declared() -> None:
    imported = set[str]()
    for path in (path for package in PACKAGES for path in (ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                imported |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                imported.add((node.module or "").partition(".")[0])
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    requirements = [*project["dependencies"], *chain(*project["optional-dependencies"].values())]
    declared = {canonicalize_name(Requirement(text).name) for text in requirements}
    distributions = metadata.packages_distributions()
    others = imported - set(sys.stdlib_module_names) - set(PACKAGES) - _IN_BLENDER
    found = {name: {canonicalize_name(one) for one in distributions.get(name, [name])} for name in others}
    assert len(found) > 20
    assert sorted(name for name, of_name in found.items() if not of_name & declared) == []


def test_packages_without_which_tests_are_skipped_are_installed() -> None:
    """Where ``CI`` is true, no file of tests is skipped because its extra was not installed."""
    files = (ROOT / "tests").rglob("test_*.py")
    calls = [re.findall(r"^\s*(?:\w+ = )?pytest\.importorskip\(\"(\w+)", path.read_text(), re.M) for path in files]
    names = {name for found in calls for name in found}
    assert {"cv2", "onnx", "torch"} <= names
    missing = sorted(name for name in names if find_spec(name) is None)
    if missing and os.environ.get("CI") != "true":
        pytest.skip(f"not installed, and tests that need them are skipped: {', '.join(missing)}")
    assert not missing
