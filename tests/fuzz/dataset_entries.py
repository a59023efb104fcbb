"""Entry points that read a dataset folder, a submission archive or the user's cache."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from dataset_builder.catalog.named_configs import BuildRequest
from dataset_builder.cli.main import argument_parser as builder_parser
from dataset_builder.pipeline.build import build
from dataset_builder.specs.config_specs import colour_spec
from rebar_depth_bench import SubmissionWriter, load
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.cli.console import EXIT_DONE
from rebar_depth_bench.cli.demo import copy_sample
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.rows import ConfigViews
from rebar_depth_bench.methods.controls import noisy_depth_m
from rebar_depth_bench.submission import SubmissionReader
from tests.building import TINY_DATASET
from tests.fuzz.workspace import CACHE, CASE, EntryPoint, Workspace, bench, run_options
from tests.mat_dataset import write_mat_dataset
from tests.synthetic_dataset import write_split_dataset

CONFIG = "lattice-orbit"
ROOT = f"{CASE}/root"
SHARDS = f"{ROOT}/{CONFIG}/*.parquet"
_TABLES = ("manifest.json", "README.md", "bars.parquet", "crossings.parquet")
METADATA = tuple(f"{ROOT}/{name}" for name in _TABLES)
OPTIONAL_OUTPUTS = (*("--html", "r.html", "--csv", "r.csv", "--extended-csv", "e.csv", "--html-views", "1"),)


def write_dataset(workspace: Workspace) -> None:
    """Copy the tiny dataset, whose config ``lattice-orbit`` has two views, without its mesh, which is large."""
    shutil.copytree(TINY_DATASET, workspace.root / ROOT, ignore=shutil.ignore_patterns("meshes"))


def _write_complete_dataset(workspace: Workspace) -> None:
    """Copy the tiny dataset with its mesh, as if this software had just built it."""
    copy_sample(TINY_DATASET, workspace.root / ROOT)


def write_dataset_and_archive(workspace: Workspace) -> None:
    """Write the tiny dataset, and an archive with predictions of both views of a config."""
    write_dataset(workspace)
    views = ConfigViews(open_folder(workspace.root / ROOT).config(CONFIG))
    with SubmissionWriter(workspace.case / "a.zip", "noisy-truth") as writer:
        for row in views.rows("left_depth"):
            writer.add(row["view_id"], noisy_depth_m(row))


def write_result(workspace: Workspace, path: Path) -> None:
    """Write the dataset, an archive of one of its configs, and the result JSON of the archive to ``path``."""
    write_dataset_and_archive(workspace)
    bench("score", workspace.case / "a.zip", *_data(workspace), "--json", path)


def _write_scenes_and_archive(workspace: Workspace) -> None:
    """Write a dataset with three scenes in two splits, and an archive with predictions of the split ``test``."""
    root = workspace.root / ROOT
    write_split_dataset(root, {"a": "train", "b": "test", "c": "test"}, 1)
    with SubmissionWriter(workspace.case / "a.zip", "noisy-truth") as writer:
        for row in load(root, "cages", streaming=True, columns=["view_id", "left_depth"]):
            writer.add(row["view_id"], noisy_depth_m(row))


def _prepare_cache(workspace: Workspace) -> None:
    write_dataset_and_archive(workspace)
    _score(workspace, "--extended")
    for path in workspace.out.iterdir():
        path.unlink()


def _data(workspace: Workspace) -> Sequence[str | Path]:
    return "--data", workspace.root / ROOT


def _score(workspace: Workspace, *options: str) -> None:
    paths = [str(workspace.out / option) if "." in option else option for option in options]
    archive, json_file = workspace.case / "a.zip", workspace.out / "r.json"
    bench("score", archive, *_data(workspace), "--workers", "1", "--json", json_file, *paths)


def score_result(workspace: Workspace) -> bytes:
    """Return the result JSON without the version texts, which no digest covers."""
    result: dict[str, Any] = json.loads((workspace.out / "r.json").read_bytes())
    del result["dataset"]["version"], result["software"]
    return json.dumps(result).encode()


def _predict(workspace: Workspace) -> None:
    bench("predict", "constant", *_data(workspace), "--config", CONFIG, "--out", workspace.out / "p.zip")


def check_predictions(workspace: Workspace) -> None:
    """Check that the archive that was written is valid for the dataset."""
    expected = open_folder(workspace.root / ROOT).expected_views()
    with SubmissionReader(workspace.out / "p.zip", expected) as submission:
        assert list(submission.problems()) == []


def _load(workspace: Workspace) -> None:
    for _ in load(workspace.root / ROOT, CONFIG):
        pass


def _stream(workspace: Workspace) -> None:
    for _ in load(workspace.root / ROOT, CONFIG, streaming=True):
        pass


def _export(workspace: Workspace) -> None:
    data = workspace.root / ROOT
    run_options(builder_parser(), "export", data, "--out", workspace.out / "export", "--config", CONFIG)


def _write_mat_and_detections(workspace: Workspace) -> None:
    """Write a dataset with judged crossings, and files of detections in a view of it."""
    root = workspace.root / ROOT
    root.mkdir(parents=True)
    write_mat_dataset(root)
    rest = {"y": 0.0, "z": 0.4, "nx": 0.0, "ny": 0.0, "nz": 1.0}
    rows = [{"view_id": "mat/0000", "x": 0.01 * i, **rest, "confidence": i} for i in range(-3, 4)]
    pd.DataFrame(rows).to_csv(workspace.case / "d.csv", index=False)
    table = pa.Table.from_pylist(rows).replace_schema_metadata({"method": "detector", "inputs": "rgb"})
    pq.write_table(table, workspace.case / "d.parquet")


def _score_crossings(workspace: Workspace, name: str) -> None:
    outputs = ("--json", workspace.out / "c.json", "--html", workspace.out / "c.html")
    bench("score-crossings", workspace.case / name, "--data", workspace.root / ROOT, *outputs)


def _verify(workspace: Workspace) -> None:
    bench("verify", workspace.root / ROOT)


def _listed_files(workspace: Workspace) -> bytes:
    """Return the content of the files that the manifest lists with a digest."""
    root = workspace.root / ROOT
    return b"".join(path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file())


class _NoRenderer:
    """Renderer of a folder in which everything is up to date unless it is damaged."""

    def submit(self, *_: object) -> Any:
        raise InputError(f"{CASE}: has to be rendered, which these tests leave out")


def _build(workspace: Workspace) -> None:
    build(_REQUEST, workspace.root / ROOT, submit=_NoRenderer().submit)


_REQUEST = BuildRequest(configs=(CONFIG,), views=2, width=160, height=90, colour=colour_spec(quality="preview"))
_DATASET_FILES = (*_TABLES, "pictures/*.webp", "meshes/*.ply", "*/test-*.parquet")
_FROM_ARCHIVE = partial(EntryPoint, prepare=write_dataset_and_archive, result=score_result, covered=True)

DATASET_ENTRIES = (
    _FROM_ARCHIVE("score: manifest", 14, run=_score, targets=(f"{ROOT}/manifest.json",)),
    _FROM_ARCHIVE("score: shards", 14, run=_score, targets=(SHARDS,)),
    EntryPoint(
        "score: several scenes",
        10,
        _write_scenes_and_archive,
        lambda workspace: _score(workspace, "--extended"),
        (f"{ROOT}/manifest.json", f"{ROOT}/bars.parquet", f"{ROOT}/cages/*.parquet"),
        result=score_result,
        covered=True,
    ),
    _FROM_ARCHIVE(
        "score: extended",
        5,
        run=lambda workspace: _score(workspace, *OPTIONAL_OUTPUTS),
        targets=(*METADATA, SHARDS),
    ),
    EntryPoint(
        "score: archive",
        10,
        write_dataset_and_archive,
        _score,
        (f"{CASE}/a.zip",),
        result=score_result,
        shows_truncation=True,
    ),
    EntryPoint(
        "score: cache",
        14,
        _prepare_cache,
        lambda workspace: _score(workspace, "--extended"),
        (f"{CACHE}/**/*",),
        covered=True,
        result=score_result,
        statuses=(EXIT_DONE,),
    ),
    EntryPoint(
        "predict: dataset",
        10,
        write_dataset,
        _predict,
        (f"{ROOT}/manifest.json", SHARDS),
        check=check_predictions,
        kept_outputs=(".p.zip.views/*", ".p.zip.views"),
    ),
    EntryPoint(
        "score-crossings: CSV",
        4,
        _write_mat_and_detections,
        partial(_score_crossings, name="d.csv"),
        (f"{CASE}/d.csv",),
    ),
    EntryPoint(
        "score-crossings: Parquet",
        4,
        _write_mat_and_detections,
        partial(_score_crossings, name="d.parquet"),
        (f"{CASE}/d.parquet", f"{ROOT}/crossings.parquet"),
    ),
    EntryPoint("load: streaming", 8, write_dataset, _stream, (*METADATA[:2], SHARDS)),
    EntryPoint("load", 3, write_dataset, _load, (*METADATA[:2], SHARDS)),
    EntryPoint("export", 6, write_dataset, _export, (*METADATA, SHARDS), kept_outputs=("export*",)),
    EntryPoint(
        "verify",
        6,
        _write_complete_dataset,
        _verify,
        (*METADATA[1:], f"{ROOT}/pictures/*", f"{ROOT}/*/*.parquet"),
        covered=True,
        result=_listed_files,
    ),
    EntryPoint(
        "build: existing folder",
        6,
        _write_complete_dataset,
        _build,
        (*METADATA, f"{ROOT}/pictures/*"),
        may_change=tuple(f"{ROOT}/{name}" for name in (*_DATASET_FILES, ".rebar-build*")),
    ),
)
