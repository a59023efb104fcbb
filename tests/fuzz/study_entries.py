"""Entry points that read KITTI folders, captures, folders of depth maps and result files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rebar_depth_bench.studies.kitti.ground_truth import find_truth, read_truth

from rebar_depth_bench.scoring.result_io import read_result
from tests.bench.studies import captures, kitti_folder
from tests.fuzz.dataset_entries import write_dataset_and_archive
from tests.fuzz.entry_point import EntryPoint, bench
from tests.fuzz.workspace import CASE, Workspace

_IMAGES = kitti_folder.first_images(2)
_VIEWS = 2


def _write_kitti(workspace: Workspace) -> None:
    kitti_folder.write_raw(workspace.case / "raw", _IMAGES)
    (workspace.case / "maps").mkdir()
    for file in find_truth(workspace.case / "raw", _IMAGES, "raw")[0]:
        depth_m = read_truth(file)
        kitti_folder.write_improved(kitti_folder.improved_path(workspace.case / "improved", file.image), depth_m)
        np.save(workspace.case / "maps" / f"{file.image.name}.npy", np.where(depth_m > 0, depth_m * 1.1, 7.0))


def _score_kitti(workspace: Workspace, kind: str) -> None:
    paths = ("--predictions", workspace.case / "maps", "--kitti", workspace.case / kind)
    bench("study", "kitti", *paths, "--ground-truth", kind, "--json", workspace.out / "kitti.json")


def _write_capture(workspace: Workspace) -> None:
    captures.write_capture(workspace.case / "zed", _VIEWS)
    depths = {view: captures.exact_depth(view) for view in range(_VIEWS)}
    captures.write_depths(workspace.case / "stereo", depths, "stereo")
    captures.write_depths(
        workspace.case / "mono", {view: 1.1 * depth_m for view, depth_m in depths.items()}, "mono"
    )


def _score_capture(workspace: Workspace) -> None:
    data = ("--reference", workspace.case / "stereo", "--data", workspace.case / "zed")
    output = ("--json", workspace.out / "r.json", "--html", workspace.out / "r.html")
    bench("study", "pseudo-reference", workspace.case / "mono", *data, *output)


def write_result(workspace: Workspace, path: Path) -> None:
    """Write the result JSON of an archive to ``path``, and nothing else."""
    write_dataset_and_archive(workspace)
    data = ("--data", workspace.case / "root")
    bench("score", workspace.case / "a.zip", *data, "--json", path)


STUDY_ENTRIES = (
    EntryPoint(
        "study kitti: raw",
        8,
        _write_kitti,
        lambda workspace: _score_kitti(workspace, "raw"),
        (f"{CASE}/raw/**/*", f"{CASE}/maps/*"),
    ),
    EntryPoint(
        "study kitti: improved",
        4,
        _write_kitti,
        lambda workspace: _score_kitti(workspace, "improved"),
        (f"{CASE}/improved/**/*.png", f"{CASE}/maps/*"),
    ),
    EntryPoint(
        "study pseudo-reference: capture",
        8,
        _write_capture,
        _score_capture,
        (f"{CASE}/zed/**/*", f"{CASE}/stereo/*", f"{CASE}/mono/*"),
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
