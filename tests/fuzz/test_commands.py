"""Hostile inputs that were found by hand, as whole commands, each in a process of its own."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from rebar_depth_bench.cli.console import EXIT_INPUT
from tests.building import TINY as TINY_SIZE
from tests.fuzz.cases import work_folder
from tests.fuzz.dataset_entries import CONFIG, write_dataset_and_archive
from tests.fuzz.oracle import Expectation, Observation, failures
from tests.fuzz.workspace import CACHE, CASE, Workspace, changes

BENCH, BUILD = "rebar_depth_bench", "dataset_builder"
Arguments = Sequence[str | Path]


def _data(workspace: Workspace) -> Arguments:
    return "--data", workspace.case / "root"


def _edit_manifest(workspace: Workspace, edit: Callable[[dict[str, Any]], object]) -> None:
    path = workspace.case / "root" / "manifest.json"
    manifest = json.loads(path.read_bytes())
    edit(manifest)
    path.write_text(json.dumps(manifest))


def _digest_is_path(workspace: Workspace) -> Arguments:
    _edit_manifest(workspace, lambda m: m["configs"][CONFIG].update(ground_truth_digest="/../../../victim"))
    outputs = ("--json", workspace.out / "r.json", "--html", workspace.out / "r.html", "--extended")
    return "score", workspace.case / "a.zip", *_data(workspace), *outputs


def _view_id_is_path(workspace: Workspace) -> Arguments:
    view_id = f"{CONFIG}/../../../../victim/evil"
    _edit_manifest(workspace, lambda m: m["configs"][CONFIG]["views"][0].update(view_id=view_id))
    [shard] = (workspace.case / "root" / CONFIG).glob("*.parquet")
    table = pq.read_table(shard)
    ids = [view_id, *table.column("view_id").to_pylist()[1:]]
    at = table.column_names.index("view_id")
    pq.write_table(table.set_column(at, table.schema.field(at), [ids]), shard)
    return "predict", "constant", *_data(workspace), "--config", CONFIG, "--out", workspace.out / "p.zip"


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


def _modules_beside(workspace: Workspace) -> Arguments:
    for name in ("ifcopenshell", "numpy"):
        (workspace.case / f"{name}.py").write_text("open('victim/ran', 'w')")
    (workspace.case / "c.ifc").write_text(_COLUMN.read_text().replace("IFCREINFORCINGBAR", "IFCBEAM"))
    return "--out", workspace.out / "root", "--scene", workspace.case / "c.ifc", *TINY_SIZE


def _export_outside(workspace: Workspace) -> Arguments:
    _edit_manifest(workspace, lambda m: m["configs"][CONFIG]["scenes"][0].update(shards=["../victim/notes.txt"]))
    return "export", workspace.case / "root", "--out", workspace.out / "export"


def _audit_of_pipe(workspace: Workspace) -> Arguments:
    path = workspace.case / "root" / "bars.parquet"
    path.unlink()
    os.mkfifo(path)
    return "audit", workspace.case / "root", "--depth-views", "0"


_COLUMN = Path(__file__).parents[2] / "examples" / "column.ifc"

KNOWN_CASES: Mapping[str, tuple[str, Callable[[Workspace], Arguments]]] = {
    "score: digest is a path": (BENCH, _digest_is_path),
    "predict: view id is a path": (BENCH, _view_id_is_path),
    "verify: file outside": (BENCH, _verify_outside),
    "cache: folder is a link": (BENCH, _clear_linked_cache),
    "submit: token file is a device": (BENCH, _no_server),
    "build: modules in the working folder": (BUILD, _modules_beside),
    "export: shard outside": (BUILD, _export_outside),
    "audit: bars are a pipe": (BUILD, _audit_of_pipe),
}
"""Program of each command, and the function that writes its input and returns its arguments."""
PROJECT = Path(__file__).parents[2]
TIMEOUT_S = 120.0
MEMORY_BYTES = 3 << 30
LIMITS = {"REBAR_MAX_IFC_SECONDS": "8", "REBAR_MAX_IFC_MEMORY_BYTES": str(1 << 30)}


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Save a work folder with the tiny dataset and an archive."""
    folder = tmp_path_factory.mktemp("sound")
    workspace = Workspace(folder / "work")
    workspace.make()
    write_dataset_and_archive(workspace)
    return workspace.root


@pytest.mark.slow
@pytest.mark.parametrize("name", KNOWN_CASES)
def test_hostile_input_is_refused(name: str, sound: Path, tmp_path: Path) -> None:
    workspace = Workspace(work_folder(tmp_path))
    workspace.restore(sound)
    program, prepare = KNOWN_CASES[name]
    arguments = prepare(workspace)
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    before = workspace.snapshot()
    environment = {**os.environ, **workspace.environment(temporary), **LIMITS, "PYTHONPATH": str(PROJECT)}
    start_s = _children_cpu_s()
    process = subprocess.run(
        [sys.executable, "-P", "-m", program, *map(str, arguments)],
        cwd=workspace.case,
        env=environment,
        preexec_fn=_limit_memory,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    seen = Observation(
        status=process.returncode,
        codes=(),
        stdout=process.stdout,
        stderr=process.stderr,
        crash="",
        cpu_s=_children_cpu_s() - start_s,
        peak_bytes=0,  # The limit of the process shows an excess as a traceback.
        changed=tuple(changes(before, workspace.snapshot())),
    )
    names = (CASE, str(workspace.root), "settings: ")
    assert failures(seen, Expectation((EXIT_INPUT,), names)) == []
    assert list(temporary.iterdir()) == []


def _limit_memory() -> None:
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))


def _children_cpu_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime
