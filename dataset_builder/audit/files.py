"""Checks of the folder as a set of files.

Checks of one view's row by itself: types, masks, ids, digests.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dataset_builder.audit.report import Check
from dataset_builder.build.plan import BUILD_FOLDER
from rebar_depth_bench.data.dataset import EYES
from rebar_depth_bench.data.digests import eye_digest, file_sha256, views_digest
from rebar_depth_bench.data.manifest import MANIFEST, DatasetFolder, ViewRecord
from rebar_depth_bench.scoring.protocol import scored_pixels


def check_files(folder: DatasetFolder, root: Path) -> Check:
    """Every file the manifest names is there with its SHA-256, and none stands there unnamed."""
    named = folder.manifest["files"]
    problems = [problem for name, sha256 in named.items() if (problem := _file_problem(root, name, sha256))]
    strangers = sorted(_present(root) - set(named) - {MANIFEST})
    problems += [f"{name}: is not in the manifest" for name in strangers]
    if (root / BUILD_FOLDER).exists():
        problems.append(f"{BUILD_FOLDER}: an unfinished build stands there; run rebar-build again or remove it")
    return Check("files against the manifest", f"{len(named)} files", "every SHA-256 equal", tuple(problems))


def check_digests(folder: DatasetFolder) -> Check:
    """The ground-truth digest and each config's are those of the views' digests."""
    entries = {config: folder.config(config) for config in folder.configs}
    problems = [
        f"{config}: ground_truth_digest is {entry['ground_truth_digest']}, expected {views_digest(entry['views'])}"
        for config, entry in entries.items()
        if entry["ground_truth_digest"] != views_digest(entry["views"])
    ]
    expected = views_digest([view for entry in entries.values() for view in entry["views"]])
    if folder.digest != expected:
        problems.append(f"the ground-truth digest is {folder.digest}, expected {expected}")
    return Check("digests of the manifest", folder.digest[:23], "equal to the views'", tuple(problems))


def _file_problem(root: Path, name: str, sha256: str) -> str | None:
    path = root / name
    if not path.is_file():
        return f"{name}: is missing"
    found = file_sha256(path)
    return None if found == sha256 else f"{name}: SHA-256 is {found[:16]}, expected {sha256[:16]}"


def _present(root: Path) -> set[str]:
    """Return the folder's files, those of the scoring cache and other hidden folders left out."""
    names = {path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file()}
    return {name for name in names if not name.startswith(".")}


_IMAGES: Mapping[str, tuple[str, tuple[int, ...]]] = {
    "rgb": ("uint8", (3,)),
    "depth": ("float32", ()),
    "mask": ("bool", ()),
    "bars": ("uint16", ()),
}
_MATRICES: Mapping[str, tuple[int, ...]] = {"K": (3, 3), "distortion": (5,), "cam_from_world": (4, 4)}


def array_problems(row: Mapping[str, Any], rig: Mapping[str, Any]) -> Iterator[str]:
    """Yield why a decoded row's arrays cannot be judged at all: wrong types or shapes, numbers not finite."""
    for eye in EYES:
        for kind, (dtype, extra) in _IMAGES.items():
            array, expected = row[f"{eye}_{kind}"], (rig["height"], rig["width"], *extra)
            if array.shape != expected or array.dtype != dtype:
                yield f"{eye} {kind} is {array.dtype} {array.shape}, expected {dtype} {expected}"
        depth_m = row[f"{eye}_depth"]
        if not np.isfinite(depth_m).all() or (depth_m < 0).any():
            yield f"{eye} depth has values that are not finite or below 0"
        for kind, shape in _MATRICES.items():
            matrix = row[f"{eye}_{kind}"]
            if matrix.shape != shape or not np.isfinite(matrix).all():
                yield f"{eye}_{kind} is not {shape} of finite numbers"


def row_problems(row: Mapping[str, Any], record: ViewRecord, bar_ids: set[int]) -> Iterator[str]:
    """Yield what is wrong with a row whose arrays can be judged: masks, ids, and what the manifest says of it."""
    for eye in EYES:
        for problem in _truth_problems(row, eye, bar_ids):
            yield f"{eye}: {problem}"
    yield from _record_problems(row, record)


def _truth_problems(row: Mapping[str, Any], eye: str, bar_ids: set[int]) -> Iterator[str]:
    depth_m, mask, bars = row[f"{eye}_depth"], row[f"{eye}_mask"], row[f"{eye}_bars"]
    if not np.array_equal(mask, bars > 0):
        yield "the mask differs from the pixels that have a bar id"
    if (depth_m[mask] <= 0).any():
        yield "steel pixels without depth"
    unknown = set(np.unique(bars[mask]).tolist()) - bar_ids
    if unknown:
        yield f"bar ids {sorted(unknown)[:5]} are not in bars.parquet"


def _record_problems(row: Mapping[str, Any], record: ViewRecord) -> Iterator[str]:
    if row["view_id"] != record.view_id:
        yield f"the row's view_id is {row['view_id']}"
    for eye, expected in (("left", record.left), ("right", record.right)):
        kinds = ("depth", "mask", "bars", "K", "distortion", "cam_from_world")
        if eye_digest(*(row[f"{eye}_{kind}"] for kind in kinds)) != expected:
            yield f"{eye} ground truth has another digest than the manifest's"
    scored = len(scored_pixels(row["left_mask"], row["left_depth"]))
    if (np.count_nonzero(row["left_mask"]), scored) != (record.steel_px, record.scored_px):
        yield "steel and scored pixel counts differ from the manifest's"
