"""Checks of one view's row by itself: types, masks, cameras, digests."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from rebar_depth_bench.cameras import ideal_K, right_of_rig
from rebar_depth_bench.digests import eye_digest
from rebar_depth_bench.folder import ViewRecord
from rebar_depth_bench.protocol import scored_pixels
from rebar_depth_bench.schema import EYES

_RIGID_TOLERANCE = 1e-12
_ARRAYS: Mapping[str, tuple[str, tuple[int, ...]]] = {
    "rgb": ("uint8", (3,)),
    "depth": ("float32", ()),
    "mask": ("bool", ()),
    "bars": ("uint16", ()),
}


def row_problems(
    row: Mapping[str, Any], record: ViewRecord, rig: Mapping[str, Any], bar_ids: set[int]
) -> Iterator[str]:
    """Yield what is wrong with a decoded row, each problem named by its view."""
    for eye in EYES:
        for problem in (*_image_problems(row, eye, rig), *_truth_problems(row, eye, bar_ids)):
            yield f"{record.view_id} {eye}: {problem}"
    for problem in (*_camera_problems(row, rig), *_record_problems(row, record)):
        yield f"{record.view_id}: {problem}"


def _image_problems(row: Mapping[str, Any], eye: str, rig: Mapping[str, Any]) -> Iterator[str]:
    for kind, (dtype, extra) in _ARRAYS.items():
        array = row[f"{eye}_{kind}"]
        expected = (rig["height"], rig["width"], *extra)
        if array.shape != expected or array.dtype != dtype:
            yield f"{kind} is {array.dtype} {array.shape}, expected {dtype} {expected}"


def _truth_problems(row: Mapping[str, Any], eye: str, bar_ids: set[int]) -> Iterator[str]:
    depth_m, mask, bars = row[f"{eye}_depth"], row[f"{eye}_mask"], row[f"{eye}_bars"]
    if not np.isfinite(depth_m).all() or (depth_m < 0).any():
        yield "depth has values that are not finite or below 0"
    if not np.array_equal(mask, bars > 0):
        yield "the mask differs from the pixels that have a bar id"
    if (depth_m[mask] <= 0).any():
        yield "steel pixels without depth"
    unknown = set(np.unique(bars[mask]).tolist()) - bar_ids
    if unknown:
        yield f"bar ids {sorted(unknown)[:5]} are not in bars.parquet"


def _camera_problems(row: Mapping[str, Any], rig: Mapping[str, Any]) -> Iterator[str]:
    for eye in EYES:
        if not np.array_equal(row[f"{eye}_K"], ideal_K(rig["width"], rig["height"])):
            yield f"{eye}_K is not the ideal matrix of the grid"
        rotation = row[f"{eye}_cam_from_world"][:3, :3]
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if error > _RIGID_TOLERANCE or np.linalg.det(rotation) < 0:
            yield f"{eye}_cam_from_world is no rigid pose (off by {error:.1e})"
    if row["baseline_m"] != rig["baseline_m"]:
        yield f"baseline_m is {row['baseline_m']}, expected {rig['baseline_m']}"
    expected = right_of_rig(row["left_cam_from_world"], row["baseline_m"])
    if not np.array_equal(row["right_cam_from_world"], expected):
        yield "the right camera does not stand baseline_m along the left one's x axis"


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
