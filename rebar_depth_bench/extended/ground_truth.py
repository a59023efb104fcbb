"""Gathers the ground truth of extended measures from a config's rows, once, and keeps it beside the dataset."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from rebar_depth_bench.data.array_cache import FlatCache, ViewArrays, open_cache
from rebar_depth_bench.data.bars import BARS, read_bars
from rebar_depth_bench.data.digests import file_sha256
from rebar_depth_bench.data.ground_truth import cache_names, cache_path, checked_rows
from rebar_depth_bench.data.manifest import DatasetFolder
from rebar_depth_bench.errors import DatasetError
from rebar_depth_bench.extended.depth_layers import other_layers
from rebar_depth_bench.extended.inspection.segments import CageTruth, assign_runs, cage_truth
from rebar_depth_bench.extended.measures import EXTENDED_PROTOCOL
from rebar_depth_bench.extended.steel_truth import SteelTruth
from rebar_depth_bench.geometry.cameras import pixel_rays
from rebar_depth_bench.progress import Progress, silent

_DTYPES: Mapping[str, type] = {
    "index": np.uint32,
    "depth_m": np.float32,
    "bar_id": np.uint16,
    "interior": np.bool_,
    "run": np.int16,
    "front_m": np.float32,
    "behind_m": np.float32,
}

Rays = Float64[ndarray, "hw 2"]


@dataclass(frozen=True, eq=False)
class SteelConfig:
    """All views of a config that ``rebar-1`` scores, with the cage they show.

    ``diameter_m`` is looked up by bar id, NaN for none. Views of one lens share their rays.
    """

    height: int
    width: int
    cage: CageTruth
    diameter_m: Float64[ndarray, " ids"]
    rays: Mapping[str, Rays]
    cache: FlatCache

    def __len__(self) -> int:
        return len(self.cache)

    def view(self, place: int) -> SteelTruth:
        """Return the view at ``place`` in the order of the protocol."""
        view = self.cache.view(place)
        arrays, note = view.arrays, view.note
        return SteelTruth(
            view_id=view.view_id,
            height=self.height,
            width=self.width,
            K=np.array(note["K"]),
            cam_from_world=np.array(note["cam_from_world"]),
            rays=self.rays[_lens(note)][arrays["index"]],
            **arrays,
        )


def steel_config(folder: DatasetFolder, config: str, progress: Progress = silent) -> SteelConfig:
    """Return a config's truth for extended measures, from its cache or else from the dataset.

    Raises ``DatasetError`` where the bars are missing or a view is not the one the manifest stands for.
    """
    bars_path = folder.file(BARS)
    scene = folder.config(config)["scene"]["name"]
    bars = read_bars(bars_path).get(scene)
    if bars is None:
        raise DatasetError(f"{bars_path}: has no bars of scene {scene!r}, which {config} shows")
    cage = cage_truth(bars)
    diameter_m = np.full(max((bar.bar_id for bar in bars), default=0) + 1, np.nan)
    diameter_m[[bar.bar_id for bar in bars]] = [bar.diameter_m for bar in bars]
    cache = open_cache(
        cache_path(folder, config, EXTENDED_PROTOCOL, file_sha256(bars_path)),
        _DTYPES,
        lambda: _view_arrays(folder, config, cage, diameter_m, progress),
        outdated=cache_names(config, EXTENDED_PROTOCOL),
    )
    height, width = folder.grid(config)
    lenses = {_lens(note): note for note in cache.notes}
    rays = {lens: _rays(note, height, width) for lens, note in lenses.items()}
    return SteelConfig(height, width, cage, diameter_m, rays, cache)


def _view_arrays(
    folder: DatasetFolder, config: str, cage: CageTruth, diameter_m: Float64[ndarray, " ids"], progress: Progress
) -> Iterator[ViewArrays]:
    rays: dict[str, Rays] = {}
    for row, scored in checked_rows(folder, config, progress, "bars in the views"):
        if not len(scored):
            continue
        note = {
            "K": row["left_K"].tolist(),
            "distortion": row["left_distortion"].tolist(),
            "cam_from_world": row["left_cam_from_world"].tolist(),
        }
        if _lens(note) not in rays:
            rays[_lens(note)] = _rays(note, *row["left_depth"].shape)
        arrays = _steel_arrays(row, scored, rays[_lens(note)], cage, diameter_m)
        yield ViewArrays(row["view_id"], arrays, note)


def _steel_arrays(
    row: Mapping[str, Any], scored: ndarray, rays: Rays, cage: CageTruth, diameter_m: Float64[ndarray, " ids"]
) -> dict[str, ndarray]:
    depth_m, bars = row["left_depth"], row["left_bars"]
    index = np.flatnonzero(widened(row["left_mask"]) & (depth_m > 0))
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
    rotation, translation = row["left_cam_from_world"][:3, :3], row["left_cam_from_world"][:3, 3]
    arrays["run"][interior] = assign_runs((camera_m - translation) @ rotation, own, cage)
    gap_m = diameter_m[own].astype(np.float32)
    front_m, behind_m = other_layers(depth_m, bars, scored, gap_m)
    arrays["front_m"][interior], arrays["behind_m"][interior] = front_m, behind_m
    return arrays


def widened(mask: Bool[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Return a mask grown by one pixel in all eight directions."""
    rows = mask.copy()
    rows[1:] |= mask[:-1]
    rows[:-1] |= mask[1:]
    grown = rows.copy()
    grown[:, 1:] |= rows[:, :-1]
    grown[:, :-1] |= rows[:, 1:]
    return grown


def _lens(note: Mapping[str, Any]) -> str:
    return repr((note["K"], note["distortion"]))


def _rays(note: Mapping[str, Any], height: int, width: int) -> Rays:
    rays = pixel_rays(np.array(note["K"]), width, height, np.array(note["distortion"]))
    return np.ascontiguousarray(rays[..., :2].reshape(-1, 2))
