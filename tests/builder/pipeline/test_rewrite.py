"""Manifests of the earlier format: refused by all readers, and converted without any other change."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dataset_builder.cli.main import main
from dataset_builder.importing.config_import import plan_import, run_import
from dataset_builder.pipeline.folder import manifest_text
from rebar_depth_bench.base.errors import DatasetError
from rebar_depth_bench.cli.main import main as rebar_bench
from rebar_depth_bench.data.files import MANIFEST_FILE
from rebar_depth_bench.data.manifest import open_folder
from tests.builder.importing import source_data
from tests.building import contents
from tests.commands import run_in_process
from tests.synthetic_dataset import write_earlier_manifest, write_split_dataset

Entry = dict[str, Any]


@pytest.fixture
def root(tiny_root: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(tiny_root, tmp_path / "dataset"))


def test_manifest_is_converted_without_any_other_change(root: Path, tiny_root: Path, tmp_path: Path) -> None:
    source = tmp_path / "source"
    source_data.write_source(source, source_data.sample_rows(tiny_root), tiny_root)
    run_import(plan_import(source_data.write_layout(source), "mock-up"), root)
    before, manifest = contents(root), write_earlier_manifest(root)
    process = run_in_process(main, "--out", root, "--rewrite-manifest")
    assert (process.returncode, process.stderr) == (0, "")
    assert json.loads((root / MANIFEST_FILE).read_text()) == manifest
    assert (root / MANIFEST_FILE).read_text() == manifest_text(json.loads((root / MANIFEST_FILE).read_text()))
    assert {name for name, digest in contents(root).items() if before.get(name) != digest} <= {MANIFEST_FILE}
    again = contents(root)
    assert run_in_process(main, "--out", root, "--rewrite-manifest").returncode == 0
    assert contents(root) == again


def test_config_with_splits_and_one_scene_keeps_its_view_ids(tmp_path: Path) -> None:
    write_split_dataset(tmp_path, {"a": "test"}, 2)
    manifest = json.loads((tmp_path / MANIFEST_FILE).read_text())
    manifest["configs"]["cages"]["scenes"][0]["protocol"] = {
        "kind": "random views",
        "views": 2,
        "distances_m": [1.0, 2.0],
    }
    (tmp_path / MANIFEST_FILE).write_text(json.dumps(manifest))
    ids = open_folder(tmp_path).config("cages").view_ids
    write_earlier_manifest(tmp_path)
    assert run_in_process(main, "--out", tmp_path, "--rewrite-manifest").returncode == 0
    config = open_folder(tmp_path).config("cages")
    assert (config.has_splits, config.view_ids, ids) == (True, ids, ("cages/test-a-0000", "cages/test-a-0001"))


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        (rebar_bench, ("verify", "ROOT")),
        (main, ("--out", "ROOT", "--config", "lattice", "--no-colour")),
        (main, ("audit", "ROOT")),
    ],
)
def test_other_commands_name_the_option(root: Path, command: Any, arguments: tuple[str, ...]) -> None:
    write_earlier_manifest(root)
    before = contents(root)
    process = run_in_process(command, *(root if word == "ROOT" else word for word in arguments))
    assert (process.returncode, process.stdout) == (2, "")
    expected = "has the format rebar-depth-dataset-1, expected rebar-depth-dataset-2; rebar-build --out ROOT"
    assert f"{expected} --rewrite-manifest converts it without rendering" in " ".join(process.stderr.split())
    assert contents(root) == before


@pytest.mark.parametrize(
    ("change", "where"),
    [
        (lambda manifest: manifest.update(configs=[]), "configs"),
        (lambda manifest: manifest["configs"].update(lattice=7), "configs.lattice"),
        (lambda manifest: manifest["configs"]["lattice"].update(scene=7), "configs.lattice.scenes 1: name"),
        (lambda manifest: manifest["configs"]["lattice"].update(scenes=[7]), "configs.lattice.scenes 1"),
        (lambda manifest: manifest["configs"]["lattice"].update(rig="x"), "configs.lattice.rig"),
        (lambda manifest: manifest["configs"]["lattice"].pop("views"), "configs.lattice.views"),
        (lambda manifest: manifest["configs"]["lattice"].pop("bytes"), "configs.lattice.scenes 1: bytes"),
    ],
)
def test_invalid_manifest_is_not_converted(root: Path, change: Callable[[Entry], object], where: str) -> None:
    write_earlier_manifest(root)
    manifest = json.loads((root / MANIFEST_FILE).read_text())
    change(manifest)
    (root / MANIFEST_FILE).write_text(json.dumps(manifest))
    before = contents(root)
    process = run_in_process(main, "--out", root, "--rewrite-manifest")
    assert "Traceback" not in process.stderr
    assert process.returncode == 2
    assert f"- {where}: " in process.stderr
    assert contents(root) == before


def test_folder_without_manifest_is_refused(tmp_path: Path) -> None:
    process = run_in_process(main, "--out", tmp_path / "dataset", "--rewrite-manifest")
    assert process.returncode == 2
    assert not (tmp_path / "dataset").exists()
    process = run_in_process(main, "--out", tmp_path, "--rewrite-manifest", "--config", "lattice")
    assert "--rewrite-manifest is combined with --config, expected only --out ROOT" in process.stderr


def test_other_formats_are_not_converted(root: Path) -> None:
    manifest = json.loads((root / MANIFEST_FILE).read_text())
    (root / MANIFEST_FILE).write_text(json.dumps({**manifest, "format": "rebar-depth-dataset-9"}))
    assert run_in_process(main, "--out", root, "--rewrite-manifest").returncode == 2
    with pytest.raises(DatasetError, match="rebar-depth-dataset-9"):
        open_folder(root)
