"""Entry points that read captures and result files."""

from __future__ import annotations

from pathlib import Path

from rebar_depth_bench.scoring.result import read_result
from tests.bench.captures.example_capture import write_capture
from tests.fuzz.dataset_entries import write_dataset_and_archive
from tests.fuzz.entry_point import EntryPoint, bench
from tests.fuzz.workspace import CASE, Workspace


def _predict_capture(workspace: Workspace) -> None:
    bench("predict", "sgbm", "--data", workspace.case / "zed", "--out", workspace.out / "a.zip")


def write_result(workspace: Workspace, path: Path) -> None:
    """Write the result JSON of an archive to ``path``, and nothing else."""
    write_dataset_and_archive(workspace)
    data = ("--data", workspace.case / "root")
    bench("score", workspace.case / "a.zip", *data, "--json", path)


CAPTURE_ENTRIES = (
    EntryPoint(
        "predict: capture",
        8,
        lambda workspace: write_capture(workspace.case / "zed", 2),
        _predict_capture,
        (f"{CASE}/zed/**/*",),
        kept_outputs=(".a.zip.views*",),
    ),
    EntryPoint(
        "result JSON",
        6,
        lambda workspace: write_result(workspace, workspace.case / "r.json"),
        lambda workspace: read_result((workspace.case / "r.json").read_bytes(), "r.json"),
        (f"{CASE}/r.json",),
        special_files=False,
    ),
)
