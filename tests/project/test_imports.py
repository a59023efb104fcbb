"""What importing costs and drags in, seen from a fresh interpreter."""

from __future__ import annotations

import subprocess
import sys

import pytest

SCORING = (
    "import rebar_depth_bench as rdb; rdb.score; rdb.load; rdb.SubmissionWriter; import rebar_depth_bench.cli.main"
)

BUILDER = [
    "config.catalog",
    "config.rigs",
    "config.scene_schema",
    "export",
    "scene.assemblies",
    "scene.assemblies.cage_file",
    "scene.variants.props",
]
"""Each package, and the modules between which imports could run in a circle."""


def modules_after(statement: str) -> set[str]:
    code = f"{statement}\nimport sys\nprint(*sys.modules)"
    finished = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(finished.stdout.split())


def test_loading_and_scoring_need_neither_torch_nor_blender_nor_the_builder() -> None:
    found = modules_after(SCORING)
    assert "rebar_depth_bench.scoring.score" in found
    heavy = {"torch", "bpy", "mathutils", "cv2", "embreex", "trimesh", "fastapi", "dataset_builder", "leaderboard"}
    assert not found & heavy


def test_the_packages_own_import_is_light() -> None:
    assert not modules_after("import rebar_depth_bench") & {"datasets", "pyarrow", "numpy", "torch"}


def test_planning_a_build_does_not_import_blender() -> None:
    found = modules_after("import dataset_builder.cli, dataset_builder.build.build, dataset_builder.audit")
    assert "dataset_builder.build.build" in found
    assert not found & {"bpy", "mathutils", "torch"}


@pytest.mark.parametrize("name", BUILDER)
def test_every_module_of_the_builder_can_be_the_first_to_be_imported(name: str) -> None:
    assert f"dataset_builder.{name}" in modules_after(f"import dataset_builder.{name}")


def test_without_the_build_extra_one_sentence_names_it() -> None:
    code = """
import importlib.util, sys
find = importlib.util.find_spec
importlib.util.find_spec = lambda name, *rest: None if name in ("bpy", "trimesh") else find(name, *rest)
sys.modules["trimesh"] = None
from dataset_builder.cli import main
sys.exit(main(["--out", "nowhere"]))
"""
    finished = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert finished.returncode == 2
    assert finished.stderr == (
        "error: not installed: bpy, trimesh; expected the build extra: pip install 'rebar-depth-bench[build]'\n"
    )


@pytest.mark.parametrize(
    "name", ["load", "score", "SubmissionWriter", "torch_loader", "Result", "SubmissionError"]
)
def test_public_names_are_there(name: str) -> None:
    import rebar_depth_bench

    assert name in rebar_depth_bench.__all__
    assert getattr(rebar_depth_bench, name).__name__ == name


def test_an_unknown_name_is_an_attribute_error() -> None:
    import rebar_depth_bench

    with pytest.raises(AttributeError, match="has no attribute 'lod'"):
        rebar_depth_bench.lod  # noqa: B018
