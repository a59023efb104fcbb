"""The ground truth a score needs, and nothing more: each view's scored pixels and their depth.

It is gathered once per config and kept next to the dataset under the dataset's digest, as flat arrays that a
later score maps into memory.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt32
from numpy import ndarray

from rebar_depth_bench.dataset import iterate
from rebar_depth_bench.digests import eye_digest
from rebar_depth_bench.errors import DatasetError
from rebar_depth_bench.files import sync
from rebar_depth_bench.folder import DatasetFolder, ViewRecord
from rebar_depth_bench.progress import Progress, silent
from rebar_depth_bench.protocol import PROTOCOL, scored_pixels

CACHE_FOLDER = ".rebar-cache"
_DIGEST_CHARACTERS = 32
_KINDS = ("rgb", "depth", "mask", "bars", "K", "distortion", "cam_from_world")
_TRUTH_COLUMNS = ("view_id", *(f"left_{kind}" for kind in _KINDS if kind != "rgb"))


@dataclass(frozen=True, eq=False)
class ViewTruth:
    """One view's scored pixels: flat indices into its H x W grid, their planar depth in metres, and its median."""

    view_id: str
    index: UInt32[ndarray, " n"]
    depth_m: Float32[ndarray, " n"]
    median_m: float


@dataclass(frozen=True, eq=False)
class ConfigTruth:
    """A config's views in the protocol, in order; a view without a scored pixel is not among them."""

    view_ids: tuple[str, ...]
    starts: tuple[int, ...]
    medians_m: tuple[float, ...]
    index: UInt32[ndarray, " n"]
    depth_m: Float32[ndarray, " n"]

    def __iter__(self) -> Iterator[ViewTruth]:
        """Yield the views."""
        bounds = pairwise(self.starts)
        for view_id, (start, end), median_m in zip(self.view_ids, bounds, self.medians_m, strict=True):
            yield ViewTruth(view_id, self.index[start:end], self.depth_m[start:end], median_m)


def config_truth(folder: DatasetFolder, config: str, progress: Progress = silent) -> ConfigTruth:
    """Return a config's scored pixels, from the cache or else from the dataset, checked against its manifest.

    Raises ``DatasetError`` naming the view whose ground truth is not the one the manifest's digest stands for.
    """
    cached = _cache_path(folder, config)
    try:
        return _read_cache(cached)
    except (OSError, ValueError, KeyError):
        shutil.rmtree(cached, ignore_errors=True)  # not there, or damaged
    _fill_cache(folder, config, cached, progress)
    return _read_cache(cached)


def _read_cache(cached: Path) -> ConfigTruth:
    outline = json.loads((cached / "views.json").read_text())
    return ConfigTruth(
        view_ids=tuple(outline["view_ids"]),
        starts=tuple(outline["starts"]),
        medians_m=tuple(outline["medians_m"]),
        index=np.asarray(np.load(cached / "index.npy", mmap_mode="r")),
        depth_m=np.asarray(np.load(cached / "depth_m.npy", mmap_mode="r")),
    )


def _cache_path(folder: DatasetFolder, config: str) -> Path:
    """Return where a config's scored pixels are kept: in the folder itself, or the user's cache for others."""
    digest = str(folder.config(config)["ground_truth_digest"]).removeprefix("sha256:")
    local = folder.local
    if local is not None and os.access(local, os.W_OK):
        base = local / CACHE_FOLDER
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "rebar-depth-bench"
    return base / f"{PROTOCOL}-{config}-{digest[:_DIGEST_CHARACTERS]}"


def _fill_cache(folder: DatasetFolder, config: str, target: Path, progress: Progress) -> None:
    """Write the flat arrays beside the target and rename them into place, view by view: memory stays flat."""
    target.parent.mkdir(parents=True, exist_ok=True)
    for outdated in target.parent.glob(f"{PROTOCOL}-{config}-{'?' * _DIGEST_CHARACTERS}"):
        shutil.rmtree(outdated, ignore_errors=True)
    temporary = Path(tempfile.mkdtemp(prefix=".filling-", dir=target.parent))
    try:
        outline = _write_arrays(folder, config, temporary, progress)
        (temporary / "views.json").write_text(json.dumps(outline))
        for path in (*temporary.iterdir(), temporary):
            sync(path)
        temporary.rename(target)
    except OSError:
        if not target.is_dir():  # else another process was faster, with the same bytes
            raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _write_arrays(
    folder: DatasetFolder, config: str, into: Path, progress: Progress
) -> dict[str, list[str] | list[int] | list[float]]:
    records = {view.view_id: view for view in folder.views(config)}
    total = sum(view.scored_px for view in records.values())
    index = _new_array(into / "index.npy", np.uint32, total)
    depth_m = _new_array(into / "depth_m.npy", np.float32, total)
    view_ids: list[str] = []
    starts = [0]
    medians_m: list[float] = []
    rows = iterate(folder.root, config, _TRUTH_COLUMNS)
    for done, row in enumerate(rows, start=1):
        record = records.pop(row["view_id"], None)
        pixels = _checked_pixels(row, record, folder.root)
        if len(pixels):
            end = starts[-1] + len(pixels)
            index[starts[-1] : end] = pixels
            scored_m = row["left_depth"].ravel()[pixels]
            depth_m[starts[-1] : end] = scored_m
            medians_m.append(float(np.median(scored_m.astype(np.float64))))
            view_ids.append(row["view_id"])
            starts.append(end)
        progress(f"ground truth of {config}", done, done + len(records))
    if records:
        raise DatasetError(f"{folder.root}: {config} lacks {len(records)} views, among them {min(records)}")
    index.flush()
    depth_m.flush()
    return {"view_ids": view_ids, "starts": starts, "medians_m": medians_m}


def _new_array(path: Path, dtype: type, length: int) -> np.memmap[Any, Any]:
    """Return a .npy file mapped for writing; it holds at least one value, for nothing cannot be mapped."""
    mapped: np.memmap[Any, Any] = np.lib.format.open_memmap(path, "w+", dtype, (max(length, 1),))  # type: ignore[no-untyped-call]
    return mapped


def _checked_pixels(row: dict[str, ndarray], record: ViewRecord | None, root: str) -> UInt32[ndarray, " n"]:
    if record is None:
        raise DatasetError(f"{root}: view {row['view_id']} is not in the manifest")
    found = eye_digest(*(row[f"left_{kind}"] for kind in _KINDS if kind != "rgb"))
    pixels = scored_pixels(row["left_mask"], row["left_depth"])
    if found != record.left or len(pixels) != record.scored_px:
        raise DatasetError(
            f"{root}: view {record.view_id}: ground truth has digest {found[:16]} and {len(pixels)} "
            f"scored pixels, the manifest says {record.left[:16]} and {record.scored_px}"
        )
    return pixels
