"""Folders of builds: links, leftovers, files of others, and damage."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from dataset_builder.catalog.named_configs import BuildRequest
from dataset_builder.cli.main import main
from dataset_builder.pipeline.build import build
from dataset_builder.pipeline.contact_sheet import write_contact_sheet
from dataset_builder.pipeline.folder import check_target
from dataset_builder.pipeline.plan import ConfigPlan, plan_config
from dataset_builder.pipeline.publish import remove_leftovers
from dataset_builder.pipeline.retained import Finished, check_retained
from dataset_builder.pipeline.shards import Staging, pack_shard
from dataset_builder.pipeline.work_units import remaining_units
from dataset_builder.specs.config_specs import ColourSpec
from rebar_depth_bench.base.errors import DatasetError, InputError
from rebar_depth_bench.data.manifest import open_folder
from tests.commands import run_in_process

REQUEST = BuildRequest(configs=("pile",), views=1, width=16, height=16, colour=ColourSpec(1, 1))
OWN_LOOKING = ("mine.ply", "mine.webp", "test-00000-of-00001-0123456789ab.parquet", ".a.ply.abcd_123.tmp", "0.log")
STAGING = ".rebar-build/{key}"
LINKED_FOLDERS = [".rebar-build", "meshes", "pictures", "pile", STAGING]
LINKED_FOLDERS += [f"{STAGING}/{name}" for name in ("rows", "logs", "shards")]
LINKED_FILES = [".rebar-build/lock", ".rebar-build/bars.parquet", f"{STAGING}/logs/shard-00000.log"]
LINKED_FILES += [f"{STAGING}/mesh.ply"]


@pytest.fixture
def root(tiny_root: Path, tmp_path: Path) -> Path:
    """Return a copy of the sample dataset."""
    return Path(shutil.copytree(tiny_root, tmp_path / "dataset"))


def tree(folder: Path) -> dict[str, bytes | str]:
    """Return the content of every file, and the target of every link, below a folder."""
    return {
        path.relative_to(folder).as_posix(): str(path.readlink()) if path.is_symlink() else path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_symlink() or path.is_file()
    }


def small_plan(root: Path) -> ConfigPlan:
    [spec] = REQUEST.config_specs()
    return plan_config(spec, REQUEST.views, root)


def edited(root: Path, change: Callable[[dict[str, Any]], object], config: str = "lattice") -> None:
    """Change the manifest entry of a config."""
    manifest = json.loads((root / "manifest.json").read_text())
    change(manifest["configs"][config])
    (root / "manifest.json").write_text(json.dumps(manifest))


def scene_of(config: dict[str, Any]) -> Any:
    """Return the entry of the only scene of a config."""
    return config["scenes"][0]


@pytest.mark.parametrize("link", LINKED_FOLDERS + LINKED_FILES)
def test_links_are_rejected_before_any_change(root: Path, tmp_path: Path, link: str) -> None:
    outside = tmp_path / "outside"
    if link in LINKED_FOLDERS:
        outside.mkdir()
        for name in OWN_LOOKING:
            (outside / name).write_text("mine")
    path = root / link.format(key=small_plan(root).staging.root.name)
    shutil.rmtree(path, ignore_errors=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.symlink_to(outside)
    before = tree(tmp_path)
    with pytest.raises(InputError, match=f"{path}: is a symbolic link"):
        build(REQUEST, root)
    assert tree(tmp_path) == before
    assert outside.exists() == (link in LINKED_FOLDERS)


def test_root_itself_may_be_a_link(root: Path, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(root)
    check_target(tmp_path / "link", {"lattice"})


def test_only_leftovers_of_builds_are_deleted(root: Path, tmp_path: Path) -> None:
    before = tree(root)
    own = [
        "lattice/test-00000-of-00009-0123456789ab.parquet",
        "gone/test-00000-of-00009-0123456789ab.parquet",
        "lattice/.test-00000-of-00009-0123456789ab.parquet.abcd_123.tmp",
        "meshes/old-scene.ply",
        "meshes/.lattice.ply.abcd_123.tmp",
        "pictures/old.webp",
        ".manifest.json.abcd_123.tmp",
    ]
    others = [
        ".draft.tmp",
        ".draft.tex.abcd_123.tmp",
        "meshes/notes.txt",
        "meshes/My Cage.ply",
        "lattice/test-0-of-1.parquet",
        "notes/test-0-of-1.parquet",
        ".git/test-00000-of-00009-0123456789ab.parquet",
        "pictures/.figure.tmp",
    ]
    for name in (*own, *others):
        (root / name).parent.mkdir(exist_ok=True)
        (root / name).write_text("")
    (tmp_path / "outside").mkdir()
    shutil.copy(root / own[0], tmp_path / "outside")
    (root / "linked").symlink_to(tmp_path / "outside")
    (root / "meshes/linked.ply").symlink_to(root / "README.md")
    (root / "meshes/folder.ply").mkdir()
    remove_leftovers(root, open_folder(root))
    assert tree(root).keys() - before.keys() == {*others, "linked", "meshes/linked.ply"}
    assert tree(root).items() >= before.items()
    assert [path.name for path in (tmp_path / "outside").iterdir()] == [Path(own[0]).name]
    assert (root / "meshes/folder.ply").is_dir()


@pytest.mark.parametrize(
    ("change", "place"),
    [
        (lambda entry: entry.update(sheet="notes/lattice.webp"), "sheet"),
        (lambda entry: entry.update(sheet="pictures/scenes.webp"), "sheet"),
        (lambda entry: scene_of(entry).update(mesh="README.md"), "scenes 1: mesh"),
        (lambda entry: scene_of(entry).update(shards=["manifest.json"]), "scenes 1: shards"),
        (lambda entry: scene_of(entry).pop("bytes"), "scenes 1: bytes"),
        (lambda entry: scene_of(entry).update(assembly=[]), "scenes 1: assembly"),
        (lambda entry: scene_of(entry)["assembly"].update(path="a\x1b[2Jb"), "scenes 1: assembly.path"),
        (lambda entry: scene_of(entry)["rig"].update(grid="other"), "scenes 1: rig.grid"),
        (lambda entry: scene_of(entry).update(protocol={"kind": "spiral"}), "scenes 1: protocol"),
        (lambda entry: entry["colour"].update(samples="1"), "colour.samples"),
    ],
)
def test_entries_of_kept_configs_are_checked(
    root: Path, change: Callable[[dict[str, Any]], object], place: str
) -> None:
    check_retained(root, Finished(root), [small_plan(root)], ())
    configs = ("lattice", "lattice-orbit")
    for config in configs:
        edited(root, change, config)
    with pytest.raises(DatasetError) as caught:
        check_retained(root, Finished(root), [small_plan(root)], ())
    found = {problem.where for problem in caught.value.problems}
    assert {f"configs.{name}.{place}" for name in configs} <= found


@pytest.mark.parametrize("keep_bytes", [None, 1000])
def test_kept_config_with_a_missing_or_shorter_shard_is_refused(root: Path, keep_bytes: int | None) -> None:
    shard = next(root.glob("lattice-orbit/*.parquet"))
    content = shard.read_bytes()
    shard.unlink()
    if keep_bytes is not None:
        shard.write_bytes(content[:keep_bytes])
    with pytest.raises(InputError, match=r"config lattice-orbit: .*--config lattice-orbit"):
        check_retained(root, Finished(root), [small_plan(root)], ())


@pytest.mark.parametrize("marker", ["notes.txt", ".build/state", "manifest.json", ".rebar-build/state"])
def test_foreign_folder_is_rejected_and_unchanged(tmp_path: Path, marker: str) -> None:
    foreign = [marker, "meshes/mine.ply", "lattice/test-0-of-1.parquet", ".draft.tmp"]
    for name in foreign:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("mine")
    process = run_in_process(main, "--out", tmp_path, "--config", "pile", "--views", "1")
    assert process.returncode == 2
    assert "Traceback" not in process.stderr
    assert tree(tmp_path) == dict.fromkeys(foreign, b"mine")


@pytest.mark.parametrize("content", [b"", b"PAR1" * 9, None, b"{}"])
def test_damaged_staged_rows_are_named(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "0000.parquet"
    if content is None:
        pq.write_table(pa.table({"a": [1]}), path)
    elif content == b"{}":
        pq.write_table(pa.table({"a": [1]}).replace_schema_metadata({b"rebar_view_record": content}), path)
    else:
        path.write_bytes(content)
    with pytest.raises(InputError, match=f"^{path}: .*problem"):
        pack_shard({"lattice/0000": path}, tmp_path / "shard.parquet")
    assert [item.name for item in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("content", [b"", b"\xff" * 64, b"0" * 63, b"0" * 64 + b"\n", b"0" * (1 << 21)])
def test_damaged_mesh_digest_is_named(tmp_path: Path, content: bytes) -> None:
    plan = small_plan(tmp_path)
    plan.staging.root.mkdir(parents=True)
    (plan.staging.root / "mesh.sha256").write_bytes(content)
    with pytest.raises(InputError, match=r"mesh\.sha256: "):
        remaining_units(plan)


def test_staged_pipes_are_rendered_again(tmp_path: Path) -> None:
    staging = Staging(small_plan(tmp_path).staging.root)
    staging.row(0).parent.mkdir(parents=True)
    for path in (staging.row(0), staging.mesh, staging.root / "mesh.sha256"):
        os.mkfifo(path)
    [unit] = remaining_units(small_plan(tmp_path))
    assert unit.with_mesh
    assert unit.indices


@pytest.mark.parametrize("kept_bytes", [0, 4, 1000, -9])
def test_damaged_shards_of_kept_configs_are_reported(root: Path, kept_bytes: int) -> None:
    shard = next(root.glob("lattice-orbit/*.parquet"))
    shard.write_bytes(shard.read_bytes()[:kept_bytes])
    config = open_folder(root).config("lattice-orbit")
    with pytest.raises(DatasetError, match=f"lattice-orbit cannot be read: {shard.relative_to(root)}"):
        write_contact_sheet(config, root / "a.webp")
    assert not (root / "a.webp").exists()
