"""File and row checks of the audit: SHA-256, crossings of bars, masks, bar ids and pixel counts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from dataset_builder.audit.report import Check
from dataset_builder.pipeline.plan import BUILD_FOLDER
from rebar_depth_bench.bar_crossings.definition import Crossings, scene_crossings
from rebar_depth_bench.bar_crossings.table import CROSSINGS_FILE, folder_crossings
from rebar_depth_bench.data.bars import Bar
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


def check_crossings(folder: DatasetFolder, bars: Mapping[str, tuple[Bar, ...]]) -> Check:
    """Check that the table of crossings holds the crossings of the bars, to ``_CROSSING_TOLERANCE_M``."""
    if CROSSINGS_FILE not in folder.files:
        return Check("crossings of the bars", "none", f"the folder has no {CROSSINGS_FILE}")
    stored = folder_crossings(folder, bars).by_scene
    expected = {
        scene: crossings for scene, of_scene in bars.items() if len(crossings := scene_crossings(of_scene))
    }
    problems = [
        f"{CROSSINGS_FILE}: scene {scene} differs from the crossings of its bars"
        for scene in sorted({*stored, *expected})
        if not _are_equal(stored.get(scene), expected.get(scene))
    ]
    total = sum(len(crossings) for crossings in expected.values())
    return Check("crossings of the bars", f"{total} crossings", "equal to 1 nm", tuple(problems))


_CROSSING_TOLERANCE_M = 1e-9


def _are_equal(stored: Crossings | None, expected: Crossings | None) -> bool:
    if stored is None or expected is None or len(stored) != len(expected):
        return False
    return all(
        np.allclose(getattr(stored, field.name), getattr(expected, field.name), rtol=0, atol=_CROSSING_TOLERANCE_M)
        for field in fields(Crossings)
    )


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
