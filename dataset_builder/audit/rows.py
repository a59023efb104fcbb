"""Checks of one view's row by itself: types, masks, ids, digests."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from rebar_depth_bench.digests import eye_digest
from rebar_depth_bench.folder import ViewRecord
from rebar_depth_bench.protocol import scored_pixels
from rebar_depth_bench.schema import EYES

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
