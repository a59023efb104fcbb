"""Modules loaded by imports in a fresh interpreter."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import tomllib
from importlib import metadata
from importlib.util import find_spec
from itertools import chain
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

PACKAGES = ("cards", "dataset_builder", "leaderboard", "rebar_depth_bench")

SCORING_IMPORTS = (
    "import rebar_depth_bench as rdb; rdb.score; rdb.load; rdb.SubmissionWriter; "
    "from rebar_depth_bench.cli.main import argument_parser; argument_parser()"
)

BUILDER_MODULES = [
    "catalog.named_configs",
    "cameras.rigs",
    "user_files.scene_schema",
    "export",
    "user_files.make_assembly",
    "user_files.cage_file",
    "scene.variants.props",
]
"""Packages, and modules that could take part in circular imports."""


def modules_after(statement: str) -> set[str]:
    code = f"{statement}\nimport sys\nprint(*sys.modules)"
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(process.stdout.split())


@pytest.mark.slow
def test_loading_and_scoring_import_no_heavy_packages() -> None:
    modules = modules_after(SCORING_IMPORTS)
    assert "rebar_depth_bench.scoring.score" in modules
    heavy = {"torch", "bpy", "mathutils", "cv2", "embreex", "trimesh", "fastapi", "dataset_builder", "leaderboard"}
    heavy |= {"datasets", "huggingface_hub", "pandas", "scipy", "yaml"}  # Imported on use: each is slow to import.
    assert not modules & heavy


def test_package_import_is_lightweight() -> None:
    assert not modules_after("import rebar_depth_bench") & {"datasets", "pyarrow", "numpy", "torch"}


@pytest.mark.parametrize(
    ("words", "commands"),
    [("--version", set()), ("--help", set()), ("cache", {"cache"})],
)
def test_a_command_line_imports_only_its_command(words: str, commands: set[str]) -> None:
    modules = modules_after(
        f"from rebar_depth_bench.cli.main import argument_parser; argument_parser([{words!r}])"
    )
    names = {name.removeprefix("rebar_depth_bench.cli.") for name in modules if "rebar_depth_bench.cli." in name}
    assert names == {"main", "console", *commands}
    assert commands or not modules & {"numpy", "pyarrow", "pydantic", "jinja2"}


def test_options_of_a_command_load_no_other_command() -> None:
    modules = modules_after("from dataset_builder.cli.main import argument_parser; argument_parser(['export'])")
    assert {name for name in modules if name.startswith("dataset_builder")} == {
        "dataset_builder",
        "dataset_builder.cli",
        "dataset_builder.cli.main",
    }
    assert not modules & {"numpy", "pyarrow"}


@pytest.mark.slow
def test_build_planning_does_not_import_blender() -> None:
    modules = modules_after(
        "import dataset_builder.cli.main, dataset_builder.pipeline.build, dataset_builder.audit"
    )
    assert "dataset_builder.pipeline.build" in modules
    assert not modules & {"bpy", "mathutils", "torch"}


@pytest.mark.slow
@pytest.mark.parametrize("name", BUILDER_MODULES)
def test_builder_modules_can_be_imported_first(name: str) -> None:
    assert f"dataset_builder.{name}" in modules_after(f"import dataset_builder.{name}")


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
        "error: not installed: bpy, trimesh; expected the build extra: pip install 'rebar-depth-bench[build]'\n"
    )


@pytest.mark.parametrize(
    "name", ["load", "score", "SubmissionWriter", "torch_loader", "Result", "SubmissionError"]
)
def test_public_names_exist(name: str) -> None:
    import rebar_depth_bench

    assert name in rebar_depth_bench.__all__
    assert getattr(rebar_depth_bench, name).__name__ == name


def test_unknown_name_raises_attribute_error() -> None:
    import rebar_depth_bench

    with pytest.raises(AttributeError, match="has no attribute 'lod'"):
        rebar_depth_bench.lod  # noqa: B018


_IN_BLENDER = {"_cycles", "mathutils"}
"""Modules that come with bpy."""


def test_every_imported_package_is_declared() -> None:
    root = Path(__file__).parents[2]
    imported = set[str]()
    for path in (path for package in PACKAGES for path in (root / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                imported |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                imported.add((node.module or "").partition(".")[0])
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    requirements = [*project["dependencies"], *chain(*project["optional-dependencies"].values())]
    declared = {canonicalize_name(Requirement(text).name) for text in requirements}
    distributions = metadata.packages_distributions()
    others = imported - set(sys.stdlib_module_names) - set(PACKAGES) - _IN_BLENDER
    found = {name: {canonicalize_name(one) for one in distributions.get(name, [name])} for name in others}
    assert len(found) > 20
    assert sorted(name for name, of_name in found.items() if not of_name & declared) == []


def test_packages_without_which_tests_are_skipped_are_installed() -> None:
    """Where ``CI`` is true, no file of tests is skipped because its extra was not installed."""
    files = Path(__file__).parents[1].rglob("test_*.py")
    calls = [re.findall(r"^\s*(?:\w+ = )?pytest\.importorskip\(\"(\w+)", path.read_text(), re.M) for path in files]
    names = {name for found in calls for name in found}
    assert {"cv2", "onnx", "torch"} <= names
    missing = sorted(name for name in names if find_spec(name) is None)
    if missing and os.environ.get("CI") != "true":
        pytest.skip(f"not installed, and tests that need them are skipped: {', '.join(missing)}")
    assert not missing
