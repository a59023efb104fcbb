"""Hostile inputs that were found by hand, one or more for each command, as a whole command line."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from rebar_depth_bench.cli.console import EXIT_INPUT
from rebar_depth_bench.data.codecs import encode_depth
from tests.bench.captures.example_capture import write_capture
from tests.bench.methods.onnx_models import write_mixer_model, write_toml
from tests.building import TINY as TINY_SIZE
from tests.fuzz.dataset_entries import CONFIG
from tests.fuzz.hostile import declare_image_size
from tests.fuzz.workspace import CACHE, Workspace

BENCH, BUILD, BOARD = "rebar_depth_bench", "dataset_builder", "leaderboard"
Arguments = Sequence[str | Path]


@dataclass(frozen=True)
class KnownCase:
    """Hostile input of a command.

    ``prepare`` writes it into a workspace that holds the tiny dataset (``root``) and an archive (``a.zip``), and
    returns the arguments of the program. ``statuses`` are the allowed exit statuses, ``kept_outputs`` patterns of
    outputs that may stay after a failure.
    """

    name: str
    program: str
    prepare: Callable[[Workspace], Arguments]
    statuses: Sequence[int] = (EXIT_INPUT,)
    kept_outputs: Sequence[str] = ()


def _data(workspace: Workspace) -> Arguments:
    return "--data", workspace.case / "root"


def _edit_manifest(workspace: Workspace, edit: Callable[[dict[str, Any]], object]) -> None:
    path = workspace.case / "root" / "manifest.json"
    manifest = json.loads(path.read_bytes())
    edit(manifest)
    path.write_text(json.dumps(manifest))


def _shard(workspace: Workspace) -> Path:
    return next((workspace.case / "root" / CONFIG).glob("*.parquet"))


def _replace_cell(workspace: Workspace, column: str, value: object) -> None:
    """Replace the cell of the first row in a column of the shard."""
    table = pq.read_table(_shard(workspace))
    cells = [value, *table.column(column).to_pylist()[1:]]
    index = table.column_names.index(column)
    pq.write_table(table.set_column(index, table.schema.field(column), [cells]), _shard(workspace))


def _replace_by_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def _digest_is_path(workspace: Workspace) -> Arguments:
    _edit_manifest(workspace, lambda m: m["configs"][CONFIG].update(ground_truth_digest="/../../../victim"))
    outputs = ("--json", workspace.out / "r.json", "--html", workspace.out / "r.html", "--extended")
    return "score", workspace.case / "a.zip", *_data(workspace), *outputs


def _deep_manifest(workspace: Workspace) -> Arguments:
    (workspace.case / "root" / "manifest.json").write_text("[" * 100_000 + "]" * 100_000)
    return "check", workspace.case / "a.zip", *_data(workspace)


def _archive_is_pipe(workspace: Workspace) -> Arguments:
    _replace_by_pipe(workspace.case / "a.zip")
    return "table", workspace.case / "a.zip", *_data(workspace), "--csv", workspace.out / "t.csv"


def _huge_depth(workspace: Workspace) -> Arguments:
    depth = encode_depth(np.zeros((90, 160), np.float32))
    _replace_cell(workspace, "left_depth", declare_image_size(depth, 12_000, 12_000))
    archive = workspace.case / "a.zip"
    return "compare", archive, archive, *_data(workspace), "--json", workspace.out / "c.json"


def _view_id_is_path(workspace: Workspace) -> Arguments:
    view_id = f"{CONFIG}/../../../../victim/evil"
    _edit_manifest(workspace, lambda m: m["configs"][CONFIG]["views"][0].update(view_id=view_id))
    _replace_cell(workspace, "view_id", view_id)
    return "predict", "constant", *_data(workspace), "--config", CONFIG, "--out", workspace.out / "p.zip"


def _truncated_shard(workspace: Workspace) -> Arguments:
    os.truncate(_shard(workspace), _shard(workspace).stat().st_size // 2)
    return "predict", "constant", *_data(workspace), "--config", CONFIG, "--out", workspace.out / "p.zip"


def _unread_model_data(workspace: Workspace) -> Arguments:
    folder = workspace.case / "model"
    folder.mkdir()
    _replace_by_pipe(write_mixer_model(folder))
    return "predict", write_toml(folder), *_data(workspace), "--out", workspace.out / "p.zip"


def _manifest_is_pipe(workspace: Workspace) -> Arguments:
    _replace_by_pipe(workspace.case / "root" / "manifest.json")
    return "score", workspace.case / "a.zip", *_data(workspace), "--json", workspace.out / "s.json"


def _capture_of_devices(workspace: Workspace) -> Arguments:
    capture = write_capture(workspace.case / "zed", 1)
    (capture / "left" / "000000.png").unlink()
    (capture / "left" / "000000.png").symlink_to("/dev/zero")
    return "predict", "sgbm", "--data", capture, "--out", workspace.out / "p.zip"


def _huge_picture(workspace: Workspace) -> Arguments:
    capture = write_capture(workspace.case / "zed", 1)
    path = capture / "left" / "000000.png"
    path.write_bytes(declare_image_size(path.read_bytes(), 60_000, 60_000))
    return "predict", "sgbm", "--data", capture, "--out", workspace.out / "p.zip"


def _verify_outside(workspace: Workspace) -> Arguments:
    _edit_manifest(workspace, lambda m: m["files"].update({"../victim/notes.txt": "0" * 64}))
    return "verify", workspace.case / "root"


def _clear_linked_cache(workspace: Workspace) -> Arguments:
    (workspace.root / CACHE / "rebar-depth-bench").symlink_to(workspace.case / "victim")
    return "cache", "--clear"


def _no_server(workspace: Workspace) -> Arguments:
    token = workspace.case / "my.token"
    token.symlink_to("/dev/zero")
    return "submit", workspace.case / "a.zip", "--url", "http://127.0.0.1:9", "--token-file", token


def _scene(name: str, content: str, workspace: Workspace) -> Arguments:
    (workspace.case / name).write_text(content)
    return "--out", workspace.out / "root", "--scene", workspace.case / name, *TINY_SIZE


def _ifc_of_comments(workspace: Workspace) -> Arguments:
    return _scene("c.ifc", _COLUMN.read_text().replace("DATA;", "DATA;" + "/* " * 60_000), workspace)


def _modules_beside(workspace: Workspace) -> Arguments:
    for name in ("ifcopenshell", "numpy"):
        (workspace.case / f"{name}.py").write_text("open('victim/ran', 'w')")
    return _scene("c.ifc", _COLUMN.read_text().replace("IFCREINFORCINGBAR", "IFCBEAM"), workspace)


def _truncated_mesh(workspace: Workspace) -> Arguments:
    header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    (workspace.case / "a.ply").write_text(
        f"{header}element face 2\nproperty list uchar int i\nend_header\n0 0 0\n"
    )
    return "--out", workspace.out / "root", "--mesh", workspace.case / "a.ply", *TINY_SIZE


def _linked_meshes(workspace: Workspace) -> Arguments:
    shutil.rmtree(workspace.case / "root" / "meshes", ignore_errors=True)
    (workspace.case / "victim" / "mine.ply").write_text("Not to be deleted.\n")
    (workspace.case / "root" / "meshes").symlink_to(workspace.case / "victim")
    options = ("--config", CONFIG, "--views", "2", *TINY_SIZE)
    return "--out", workspace.case / "root", *options


def _export_outside(workspace: Workspace) -> Arguments:
    _edit_manifest(workspace, lambda m: m["configs"][CONFIG]["scenes"][0].update(shards=["../victim/notes.txt"]))
    return "export", workspace.case / "root", "--out", workspace.out / "export"


def _audit_of_pipe(workspace: Workspace) -> Arguments:
    _replace_by_pipe(workspace.case / "root" / "bars.parquet")
    return "audit", workspace.case / "root", "--depth-views", "0"


def _settings_of_device(workspace: Workspace) -> Arguments:
    (workspace.case / "s.toml").symlink_to("/dev/zero")
    return "serve", "--settings", workspace.case / "s.toml"


_COLUMN = Path(__file__).parents[2] / "examples" / "column.ifc"
_LONG_KEY = "a." * 30_000 + "a = 1\n"

KNOWN_CASES = (
    KnownCase("score: digest is a path", BENCH, _digest_is_path),
    KnownCase("check: deep manifest", BENCH, _deep_manifest),
    KnownCase("table: archive is a pipe", BENCH, _archive_is_pipe),
    KnownCase("compare: huge depth", BENCH, _huge_depth),
    KnownCase("predict: view id is a path", BENCH, _view_id_is_path),
    KnownCase("predict: truncated shard", BENCH, _truncated_shard, kept_outputs=(".p.zip.views*",)),
    KnownCase("predict: model is a pipe", BENCH, _unread_model_data),
    KnownCase("score: manifest is a pipe", BENCH, _manifest_is_pipe),
    KnownCase("predict: picture is a device", BENCH, _capture_of_devices),
    KnownCase("predict: huge picture", BENCH, _huge_picture),
    KnownCase("verify: file outside", BENCH, _verify_outside),
    KnownCase("cache: folder is a link", BENCH, _clear_linked_cache),
    KnownCase("submit: token file is a device", BENCH, _no_server),
    KnownCase("build: key of many parts", BUILD, partial(_scene, "s.toml", _LONG_KEY)),
    KnownCase("build: IFC of comments", BUILD, _ifc_of_comments),
    KnownCase("build: modules in the working folder", BUILD, _modules_beside),
    KnownCase("build: truncated mesh", BUILD, _truncated_mesh),
    KnownCase("build: folder of meshes is a link", BUILD, _linked_meshes),
    KnownCase("export: shard outside", BUILD, _export_outside),
    KnownCase("audit: bars are a pipe", BUILD, _audit_of_pipe),
    KnownCase("leaderboard: settings are a device", BOARD, _settings_of_device),
)
