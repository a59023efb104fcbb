"""Ground truth of the extended measures: computed once from a config's rows and cached beside the dataset."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from rebar_depth_bench.data.array_cache import ArrayCache, ViewArrays, open_cache
from rebar_depth_bench.data.bars import BARS_FILE, read_bars
from rebar_depth_bench.data.digests import file_sha256
from rebar_depth_bench.data.eye_view import CAMERA_KINDS, EyeView
from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.errors import DatasetError
from rebar_depth_bench.extended.depth_layers import other_layers
from rebar_depth_bench.extended.inspection.segments import CageTruth, assign_segments, cage_truth
from rebar_depth_bench.extended.measures import EXTENDED_PROTOCOL
from rebar_depth_bench.extended.steel_truth import SteelTruth
from rebar_depth_bench.geometry.cameras import pixel_rays
from rebar_depth_bench.progress import Progress, silent
from rebar_depth_bench.scoring.ground_truth import cache_name_pattern, cache_path, verified_views

_DTYPES: Mapping[str, type] = {
    "index": np.uint32,
    "depth_m": np.float32,
    "bar_id": np.uint16,
    "interior": np.bool_,
    "run": np.int16,
    "front_m": np.float32,
    "behind_m": np.float32,
}
"""Arrays of ``SteelTruth`` that are cached, with their types."""


Rays = Float64[ndarray, "hw 2"]
"""x/z and y/z of each pixel's ray, row by row."""


@dataclass(frozen=True, eq=False)
class ConfigSteelTruth:
    """Steel ground truth of all views of a config that have scored pixels.

    ``cage`` holds the bar segments of the scene, ``diameter_m`` the nominal diameter by bar id (NaN for ids
    without a bar). ``rays`` holds the rays of each distinct lens (K and distortion), which views share.
    """

    height: int
    width: int
    cage: CageTruth
    diameter_m: Float64[ndarray, " ids"]
    rays: Mapping[str, Rays]
    cache: ArrayCache

    def __len__(self) -> int:
        """Return the number of views."""
        return len(self.cache)

    def view(self, position: int) -> SteelTruth:
        """Return the view at ``position`` in protocol order."""
        view = self.cache.view(position)
        arrays, metadata = view.arrays, view.metadata
        return SteelTruth(
            view_id=view.view_id,
            height=self.height,
            width=self.width,
            K=np.array(metadata["K"]),
            cam_from_world=np.array(metadata["cam_from_world"]),
            rays=self.rays[_lens_key(metadata)][arrays["index"]],
            **arrays,
        )


def load_steel_truth(config: DatasetConfig, progress: Progress = silent) -> ConfigSteelTruth:
    """Return a config's ground truth for extended measures, from the cache or else computed from the dataset.

    Raises ``DatasetError`` if the bars of the scene are missing or a view contradicts the manifest.
    """
    bars_path = config.file(BARS_FILE)
    bars = read_bars(bars_path).get(config.scene.name)
    if bars is None:
        raise DatasetError(f"{bars_path}: has no bars for scene {config.scene.name!r} of config {config.name}")
    cage = cage_truth(bars)
    diameter_m = np.full(max((bar.bar_id for bar in bars), default=0) + 1, np.nan)
    diameter_m[[bar.bar_id for bar in bars]] = [bar.diameter_m for bar in bars]
    cache = open_cache(
        cache_path(config, EXTENDED_PROTOCOL, file_sha256(bars_path)),
        _DTYPES,
        lambda: _view_arrays(config, cage, diameter_m, progress),
        stale_pattern=cache_name_pattern(config.name, EXTENDED_PROTOCOL),
    )
    height, width = config.grid
    lenses = {_lens_key(metadata): metadata for metadata in cache.metadata}
    rays = {lens: _rays(metadata, height, width) for lens, metadata in lenses.items()}
    return ConfigSteelTruth(height, width, cage, diameter_m, rays, cache)


def _view_arrays(
    config: DatasetConfig, cage: CageTruth, diameter_m: Float64[ndarray, " ids"], progress: Progress
) -> Iterator[ViewArrays]:
    """Yield the cached arrays of every view with scored pixels, with K, distortion and pose as metadata."""
    rays: dict[str, Rays] = {}
    for view_id, left, scored in verified_views(config, progress, "bars in the views"):
        if not len(scored):
            continue
        metadata = {kind: getattr(left.camera, kind).tolist() for kind in CAMERA_KINDS}
        if _lens_key(metadata) not in rays:
            rays[_lens_key(metadata)] = _rays(metadata, *left.depth_m.shape)
        arrays = _steel_arrays(left, scored, rays[_lens_key(metadata)], cage, diameter_m)
        yield ViewArrays(view_id, arrays, metadata)


def _steel_arrays(
    left: EyeView, scored: ndarray, rays: Rays, cage: CageTruth, diameter_m: Float64[ndarray, " ids"]
) -> dict[str, ndarray]:
    """Return the arrays of ``SteelTruth`` for one view, by field name.

    ``scored`` holds the flat indices of the scored pixels. Segments and other layers are determined for these
    only.
    """
    depth_m, bars = left.depth_m, left.bars
    index = np.flatnonzero(dilate_mask(left.mask) & (depth_m > 0))
    interior = np.zeros(depth_m.size, dtype=bool)
    interior[scored] = True
    interior = interior[index]
    arrays: dict[str, ndarray] = {
        "index": index,
        "depth_m": depth_m.ravel()[index],
        "bar_id": bars.ravel()[index],
        "interior": interior,
        "run": np.full(len(index), -1, dtype=np.int16),
        "front_m": np.full(len(index), np.nan, dtype=np.float32),
        "behind_m": np.full(len(index), np.nan, dtype=np.float32),
    }
    own, z_m = arrays["bar_id"][interior], arrays["depth_m"][interior]
    camera_m = np.column_stack([z_m[:, None] * rays[scored], z_m])
    pose = left.camera.cam_from_world
    arrays["run"][interior] = assign_segments((camera_m - pose[:3, 3]) @ pose[:3, :3], own, cage)
    gap_m = diameter_m[own].astype(np.float32)
    front_m, behind_m = other_layers(depth_m, bars, scored, gap_m)
    arrays["front_m"][interior], arrays["behind_m"][interior] = front_m, behind_m
    return arrays


def dilate_mask(mask: Bool[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Return a mask dilated by one pixel in all eight directions (3 x 3)."""
    rows = mask.copy()
    rows[1:] |= mask[:-1]
    rows[:-1] |= mask[1:]
    grown = rows.copy()
    grown[:, 1:] |= rows[:, :-1]
    grown[:, :-1] |= rows[:, 1:]
    return grown


def _lens_key(metadata: Mapping[str, Any]) -> str:
    """Return a key that is equal for views with the same K and distortion."""
    return repr((metadata["K"], metadata["distortion"]))


def _rays(metadata: Mapping[str, Any], height: int, width: int) -> Rays:
    """Return x/z and y/z of every pixel's ray, row by row, lens distortion undone."""
    rays = pixel_rays(np.array(metadata["K"]), width, height, np.array(metadata["distortion"]))
    return np.ascontiguousarray(rays[..., :2].reshape(-1, 2))
