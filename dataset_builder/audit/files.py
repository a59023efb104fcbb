"""File and row checks of the audit: SHA-256 and digests, array types, masks, bar ids and pixel counts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dataset_builder.audit.report import Check
from dataset_builder.pipeline.plan import BUILD_FOLDER
from rebar_depth_bench.data.dataset import EYES
from rebar_depth_bench.data.digests import file_sha256, views_digest
from rebar_depth_bench.data.eye_view import EyeView, eye_from_row
from rebar_depth_bench.data.manifest import MANIFEST_FILE, DatasetFolder, ViewRecord
from rebar_depth_bench.scoring.protocol import scored_pixels


def check_files(folder: DatasetFolder, root: Path) -> Check:
    """Check that every file of the manifest exists with its SHA-256, and that the folder has no other file."""
    problems = [problem for name, sha256 in folder.files.items() if (problem := _file_problem(root, name, sha256))]
    unlisted = sorted(_existing_files(root) - set(folder.files) - {MANIFEST_FILE})
    problems += [f"{name}: is not in the manifest" for name in unlisted]
    if (root / BUILD_FOLDER).exists():
        problems.append(
            f"{BUILD_FOLDER}: the folder contains an unfinished build; run rebar-build again or remove it"
        )
    return Check("files against the manifest", f"{len(folder.files)} files", "all SHA-256 equal", tuple(problems))


def check_digests(folder: DatasetFolder) -> Check:
    """Check the ground-truth digest of the dataset and of each config against the digests of the views."""
    configs = folder.config_by_name.values()
    problems = [
        f"{config.name}: ground_truth_digest is {config.ground_truth_digest}, expected {digest}"
        for config in configs
        if config.ground_truth_digest != (digest := views_digest(config.views))
    ]
    expected = views_digest(view for config in configs for view in config.views)
    if folder.digest != expected:
        problems.append(f"the ground-truth digest is {folder.digest}, expected {expected}")
    return Check("digests of the manifest", folder.digest[:23], "equal to the views'", tuple(problems))


def _file_problem(root: Path, name: str, sha256: str) -> str | None:
    path = root / name
    if not path.is_file():
        return f"{name}: is missing"
    actual_sha256 = file_sha256(path)
    return None if actual_sha256 == sha256 else f"{name}: SHA-256 is {actual_sha256[:16]}, expected {sha256[:16]}"


def _existing_files(root: Path) -> set[str]:
    """Return the relative POSIX paths of the folder's files.

    The scoring cache and other hidden files and folders at the top level are left out.
    """
    names = {path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file()}
    return {name for name in names if not name.startswith(".")}


_IMAGES: Mapping[str, tuple[str, tuple[int, ...]]] = {
    "rgb": ("uint8", (3,)),
    "depth": ("float32", ()),
    "mask": ("bool", ()),
    "bars": ("uint16", ()),
}
_MATRICES: Mapping[str, tuple[int, ...]] = {"K": (3, 3), "distortion": (5,), "cam_from_world": (4, 4)}


def array_problems(row: Mapping[str, Any], grid: tuple[int, int]) -> Iterator[str]:
    """Yield the faults that make a decoded row unusable: wrong dtypes or shapes, non-finite or negative values."""
    for eye in EYES:
        for kind, (dtype, extra) in _IMAGES.items():
            array, expected = row[f"{eye}_{kind}"], (*grid, *extra)
            if array.shape != expected or array.dtype != dtype:
                yield f"{eye} {kind} is {array.dtype} {array.shape}, expected {dtype} {expected}"
        depth_m = row[f"{eye}_depth"]
        if not np.isfinite(depth_m).all() or (depth_m < 0).any():
            yield f"{eye} depth has non-finite or negative values"
        for kind, shape in _MATRICES.items():
            matrix = row[f"{eye}_{kind}"]
            if matrix.shape != shape or not np.isfinite(matrix).all():
                yield f"{eye}_{kind} is not an array of finite numbers of shape {shape}"


def row_problems(row: Mapping[str, Any], record: ViewRecord, bar_ids: set[int]) -> Iterator[str]:
    """Yield the problems of a row with well-formed arrays: masks, bar ids, differences from the manifest."""
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
