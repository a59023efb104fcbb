"""File and row checks of the audit: SHA-256, masks, bar ids and pixel counts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dataset_builder.audit.report import Check
from dataset_builder.pipeline.plan import BUILD_FOLDER
from rebar_depth_bench.data.columns import EYES
from rebar_depth_bench.data.config_tables import ViewRecord
from rebar_depth_bench.data.eye_view import EyeView, eye_from_row
from rebar_depth_bench.data.manifest import DatasetFolder
from rebar_depth_bench.data.verification import file_problems
from rebar_depth_bench.progress import Progress
from rebar_depth_bench.scoring.protocol import scored_pixels


def check_files(folder: DatasetFolder, root: Path, progress: Progress) -> Check:
    """Check that every file of the manifest exists with its SHA-256, and that the folder has no other file."""
    problems = [str(problem) for problem in file_problems(folder, progress)]
    if (root / BUILD_FOLDER).exists():
        problems.append(
            f"{BUILD_FOLDER}: the folder contains an unfinished build; run rebar-build again or remove it"
        )
    return Check("files against the manifest", f"{len(folder.files)} files", "all SHA-256 equal", tuple(problems))


def row_problems(row: Mapping[str, Any], record: ViewRecord, bar_ids: set[int]) -> Iterator[str]:
    """Yield the problems of a decoded row: masks, bar ids, differences from the manifest."""
    eyes = {name: eye_from_row(row, name) for name in EYES}
    for name, eye in eyes.items():
        for problem in _ground_truth_problems(eye, bar_ids):
            yield f"{name}: {problem}"
    if row["view_id"] != record.view_id:
        yield f"the row's view_id is {row['view_id']}, expected {record.view_id}"
    for name, expected in (("left", record.left), ("right", record.right)):
        if eyes[name].digest() != expected:
            yield f"{name} ground-truth digest differs from the manifest's"
    left = eyes["left"]
    counts = np.count_nonzero(left.mask), len(scored_pixels(left.mask, left.depth_m))
    if counts != (record.steel_px, record.scored_px):
        yield "steel and scored pixel counts differ from the manifest's"


def _ground_truth_problems(eye: EyeView, bar_ids: set[int]) -> Iterator[str]:
    if not np.array_equal(eye.mask, eye.bars > 0):
        yield "the mask differs from the pixels that have a bar id"
    if (eye.depth_m[eye.mask] <= 0).any():
        yield "steel pixels without depth"
    unknown = set(np.unique(eye.bars[eye.mask]).tolist()) - bar_ids
    if unknown:
        yield f"bar ids {sorted(unknown)[:5]} are not in bars.parquet"
