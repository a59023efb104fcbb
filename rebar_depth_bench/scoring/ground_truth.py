"""Ground truth for scoring: the scored pixels of each view and their depth.

It is extracted once per config and cached as arrays next to the dataset (or in the user's cache), keyed by the
ground-truth digest; later runs read the cache one view at a time.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt32
from numpy import ndarray

from rebar_depth_bench.data.array_cache import ArrayCache, ViewArrays, open_cache
from rebar_depth_bench.data.dataset import iterate_rows
from rebar_depth_bench.data.eye_view import EyeView, eye_from_row, truth_columns
from rebar_depth_bench.data.manifest import DatasetConfig, ViewRecord
from rebar_depth_bench.errors import DatasetError
from rebar_depth_bench.progress import Progress, silent
from rebar_depth_bench.scoring.metrics import median
from rebar_depth_bench.scoring.protocol import PROTOCOL, scored_pixels

CACHE_FOLDER = ".rebar-cache"
_DIGEST_CHARACTERS = 32


@dataclass(frozen=True, eq=False)
class ViewTruth:
    """Scored pixels of one view.

    ``index`` holds flat indices into the H x W image, ``depth_m`` their planar depth and ``median_m`` its median,
    in metres.
    """

    view_id: str
    index: UInt32[ndarray, " n"]
    depth_m: Float32[ndarray, " n"]
    median_m: float


@dataclass(frozen=True, eq=False)
class ConfigTruth:
    """Views of a config that have scored pixels, each read from the cache on access."""

    cache: ArrayCache

    @property
    def view_ids(self) -> tuple[str, ...]:
        """Ids of the views, in order."""
        return self.cache.view_ids

    @property
    def medians_m(self) -> tuple[float, ...]:
        """Median ground-truth depth of the scored pixels of each view, metres."""
        return tuple(float(metadata) for metadata in self.cache.metadata)

    def __len__(self) -> int:
        return len(self.cache)

    def __iter__(self) -> Iterator[ViewTruth]:
        return map(self.view, range(len(self)))

    def view(self, position: int) -> ViewTruth:
        """Return the view at ``position`` in protocol order."""
        view = self.cache.view(position)
        return ViewTruth(view.view_id, view.arrays["index"], view.arrays["depth_m"], float(view.metadata))


def config_truth(config: DatasetConfig, progress: Progress = silent) -> ConfigTruth:
    """Return the ground truth of a config, from the cache or else extracted from the dataset.

    Views without scored pixels are omitted. Raises ``DatasetError`` naming the view if its ground truth does not
    match its digest in the manifest.
    """
    cache = open_cache(
        cache_path(config, PROTOCOL),
        {"index": np.uint32, "depth_m": np.float32},
        lambda: _extract_views(config, progress),
        stale_pattern=cache_name_pattern(config.name, PROTOCOL),
    )
    return ConfigTruth(cache)


def cache_path(config: DatasetConfig, protocol: str, extra_digest: str = "") -> Path:
    """Return the path of the array cache of a config under a protocol.

    It lies in the dataset folder if that is local and writable, or else in the user's cache. ``extra_digest`` is
    the hex SHA-256 of further inputs, other than the views, that the cached arrays depend on.
    """
    digest = config.ground_truth_digest.removeprefix("sha256:")
    if extra_digest:
        digest = hashlib.sha256(f"{digest} {extra_digest}".encode()).hexdigest()
    local = config.local
    if local is not None and os.access(local, os.W_OK):
        base = local / CACHE_FOLDER
    else:
        user = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "rebar-depth-bench"
        # The folder is keyed by the dataset root as well: different datasets share config names.
        base = user / hashlib.sha256(config.root.encode()).hexdigest()[:16]
    return base / f"{protocol}-{config.name}-{digest[:_DIGEST_CHARACTERS]}"


def cache_name_pattern(config: str, protocol: str) -> str:
    """Return the glob pattern of the folder names that ``cache_path`` gives for any digest."""
    return f"{protocol}-{config}-{'?' * _DIGEST_CHARACTERS}"


def verified_views(
    config: DatasetConfig, progress: Progress, task: str
) -> Iterator[tuple[str, EyeView, UInt32[ndarray, " n"]]]:
    """Yield id, left eye and flat indices of the scored pixels of every view, verified against the manifest.

    ``task`` is its name in ``progress``. Raises ``DatasetError`` naming a view that occurs twice or does not match
    its digest, or, after the last row, if views of the manifest are missing.
    """
    records = {view.view_id: view for view in config.views}
    total = len(records)
    rows = iterate_rows(config, ("view_id", *truth_columns("left")))
    for done, row in enumerate(rows, start=1):
        view_id, left = row["view_id"], eye_from_row(row, "left")
        if view_id not in records:
            raise DatasetError(f"{config.root}: view {view_id} occurs twice, expected once")
        yield view_id, left, _verified_pixels(left, records.pop(view_id), config.root)
        progress(f"{task} of {config.name}", done, total)
    if records:
        raise DatasetError(f"{config.root}: {config.name} lacks {len(records)} views, among them {min(records)}")


def _extract_views(config: DatasetConfig, progress: Progress) -> Iterator[ViewArrays]:
    for view_id, left, pixels in verified_views(config, progress, "ground truth"):
        if len(pixels):
            depth_m = left.depth_m.ravel()[pixels]
            yield ViewArrays(view_id, {"index": pixels, "depth_m": depth_m}, median(depth_m))


def _verified_pixels(left: EyeView, record: ViewRecord, root: str) -> UInt32[ndarray, " n"]:
    digest = left.digest()
    same_size = left.depth_m.shape == left.mask.shape == left.bars.shape  # Damaged images may differ in size.
    pixels = scored_pixels(left.mask, left.depth_m) if same_size else np.empty(0, np.uint32)
    if digest != record.left or not same_size or len(pixels) != record.scored_px:
        raise DatasetError(
            f"{root}: view {record.view_id}: ground truth has digest {digest[:16]} and {len(pixels)} "
            f"scored pixels, the manifest has {record.left[:16]} and {record.scored_px}"
        )
    return pixels
