"""The ground truth a score needs, and nothing more: each view's scored pixels and their depth.

It is gathered once per config and kept next to the dataset under the dataset's digest, as flat arrays that a
later score reads view by view.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload

import numpy as np
from jaxtyping import Float32, UInt32
from numpy import ndarray

from rebar_depth_bench.data.array_cache import FlatCache, ViewArrays, open_cache
from rebar_depth_bench.data.dataset import iterate
from rebar_depth_bench.data.digests import eye_digest
from rebar_depth_bench.data.manifest import DatasetFolder, ViewRecord
from rebar_depth_bench.errors import DatasetError
from rebar_depth_bench.progress import Progress, silent
from rebar_depth_bench.scoring.metrics import median
from rebar_depth_bench.scoring.protocol import PROTOCOL, scored_pixels

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
class ConfigTruth(Sequence[ViewTruth]):
    """The views of a config in the protocol, in order, each read when it is asked for."""

    cache: FlatCache

    @property
    def view_ids(self) -> tuple[str, ...]:
        """The views' ids, in order."""
        return self.cache.view_ids

    @property
    def medians_m(self) -> tuple[float, ...]:
        """The median true depth of each view's scored pixels, metres."""
        return tuple(float(note) for note in self.cache.notes)

    def __len__(self) -> int:
        return len(self.cache)

    @overload
    def __getitem__(self, place: int) -> ViewTruth: ...

    @overload
    def __getitem__(self, place: slice) -> list[ViewTruth]: ...

    def __getitem__(self, place: int | slice) -> ViewTruth | list[ViewTruth]:
        if isinstance(place, slice):
            return [self[one] for one in range(*place.indices(len(self)))]
        view = self.cache.view(range(len(self))[place])
        return ViewTruth(view.view_id, view.arrays["index"], view.arrays["depth_m"], float(view.note))


def config_truth(folder: DatasetFolder, config: str, progress: Progress = silent) -> ConfigTruth:
    """Return the views of a config in the protocol, from the cache or else from the dataset.

    A view without a scored pixel is not among them. Raises ``DatasetError`` naming the view whose ground truth is
    not the one that the manifest's digest stands for.
    """
    cache = open_cache(
        cache_path(folder, config, PROTOCOL),
        {"index": np.uint32, "depth_m": np.float32},
        lambda: _views(folder, config, progress),
        outdated=cache_names(config, PROTOCOL),
    )
    return ConfigTruth(cache)


def cache_path(folder: DatasetFolder, config: str, protocol: str, also: str = "") -> Path:
    """Return where a config's pixels by a protocol are kept: in the folder itself, or in the user's cache.

    ``also`` is the hex SHA-256 of anything but the views that the pixels depend on.
    """
    digest = str(folder.config(config)["ground_truth_digest"]).removeprefix("sha256:")
    if also:
        digest = hashlib.sha256(f"{digest} {also}".encode()).hexdigest()
    local = folder.local
    if local is not None and os.access(local, os.W_OK):
        base = local / CACHE_FOLDER
    else:
        user = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "rebar-depth-bench"
        base = user / hashlib.sha256(str(folder.root).encode()).hexdigest()[:16]  # datasets share names of configs
    return base / f"{protocol}-{config}-{digest[:_DIGEST_CHARACTERS]}"


def cache_names(config: str, protocol: str) -> str:
    """Return the pattern of the names that ``cache_path`` may give, whatever the digest."""
    return f"{protocol}-{config}-{'?' * _DIGEST_CHARACTERS}"


def checked_rows(
    folder: DatasetFolder, config: str, progress: Progress, what: str
) -> Iterator[tuple[dict[str, Any], UInt32[ndarray, " n"]]]:
    """Yield every row of a config with its scored pixels, held against the manifest's digests.

    Raises ``DatasetError`` naming the view that is not the manifest's, or how many are missing at the end.
    """
    records = {view.view_id: view for view in folder.views(config)}
    total = len(records)
    for done, row in enumerate(iterate(folder.root, config, _TRUTH_COLUMNS), start=1):
        yield row, _checked_pixels(row, records.pop(row["view_id"], None), folder.root)
        progress(f"{what} of {config}", done, total)
    if records:
        raise DatasetError(f"{folder.root}: {config} lacks {len(records)} views, among them {min(records)}")


def _views(folder: DatasetFolder, config: str, progress: Progress) -> Iterator[ViewArrays]:
    for row, pixels in checked_rows(folder, config, progress, "ground truth"):
        if len(pixels):
            depth_m = row["left_depth"].ravel()[pixels]
            yield ViewArrays(row["view_id"], {"index": pixels, "depth_m": depth_m}, median(depth_m))


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
