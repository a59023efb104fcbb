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

BUILDER_MODULES = [
    "catalog.named_configs",
    "cameras.rigs",
    "user_files.scene_schema",
    "export",
    "user_files.make_assembly",
    "user_files.cage_file",
    "scene.variants.props",
]
"""Modules that could take part in circular imports."""


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
def test_bench_imports_what_a_command_needs_and_no_heavy_package() -> None:
    parse = "from rebar_depth_bench.cli.main import argument_parser; argument_parser([{!r}])"
    found = modules_after(
        package="import rebar_depth_bench as rdb",
        version=parse.format("--version"),
        help=parse.format("--help"),
        cache=parse.format("cache"),
        scoring="rdb.score; rdb.load; rdb.SubmissionWriter; argument_parser()",
    )
    assert not found["package"] & {"datasets", "pyarrow", "numpy", "torch"}
    commands = {
        name: {one.removeprefix("rebar_depth_bench.cli.") for one in modules if "rebar_depth_bench.cli." in one}
        for name, modules in found.items()
    }
    assert commands["version"] == commands["help"] == {"main", "console"}
    assert commands["cache"] == {"main", "console", "cache"}
    assert not found["help"] & {"numpy", "pyarrow", "pydantic", "jinja2"}
    assert "rebar_depth_bench.scorer" in found["scoring"]
    heavy = {"torch", "bpy", "mathutils", "cv2", "embreex", "trimesh", "fastapi", "dataset_builder", "leaderboard"}
    heavy |= {"datasets", "huggingface_hub", "pandas", "scipy", "yaml"}  # Imported on use: each is slow to import.
    assert not found["scoring"] & heavy


@pytest.mark.slow
def test_builder_imports_what_a_command_needs_and_plans_without_blender() -> None:
    found = modules_after(
        export="from dataset_builder.cli.main import argument_parser; argument_parser(['export'])",
        planning="import dataset_builder.cli.main, dataset_builder.pipeline.build, dataset_builder.audit",
    )
    own = {name for name in found["export"] if name.startswith("dataset_builder")}
    assert own == {"dataset_builder", "dataset_builder.cli", "dataset_builder.cli.main"}
    assert not found["export"] & {"numpy", "pyarrow"}
    assert "dataset_builder.pipeline.build" in found["planning"]
    assert not found["planning"] & {"bpy", "mathutils", "torch"}


@pytest.mark.slow
def test_each_builder_module_can_be_imported_first() -> None:
    forget = "[sys.modules.pop(name) for name in list(sys.modules) if name.startswith('dataset_builder')]"
    found = modules_after(**{name: f"{forget}\nimport dataset_builder.{name}" for name in BUILDER_MODULES})
    assert all(f"dataset_builder.{name}" in modules for name, modules in found.items())


@pytest.mark.slow
def test_missing_build_extra_is_named() -> None:
    code = """
import importlib.util, sys
find = importlib.util.find_spec
importlib.util.find_spec = lambda name, *rest: None if name in ("bpy", "trimesh") else find(name, *rest)
sys.modules["trimesh"] = None
from dataset_builder.cli.main import main
sys.exit(main(["--out", "nowhere"]))
"""
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert process.returncode == 2
    assert process.stderr == (
        "error: not installed: bpy, trimesh; expected the build extra: "
        "pip install '.[build]' in a clone of rebar-depth-bench\n"
    )


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
