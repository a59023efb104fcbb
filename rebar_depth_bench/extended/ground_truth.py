"""Ground truth of the extended measures: computed once from a config's rows and kept in the user's cache."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from rebar_depth_bench.bar_crossings.crossings_file import CrossingsSource, folder_crossings
from rebar_depth_bench.bar_crossings.definition import CROSSINGS_PROTOCOL
from rebar_depth_bench.base.errors import DatasetError
from rebar_depth_bench.base.parallel import Progress, silent
from rebar_depth_bench.data.bars import BARS_FILE, read_bars
from rebar_depth_bench.data.cache import ArrayCache, CacheContent, ViewArrays, open_cache
from rebar_depth_bench.data.manifest import DatasetConfig, DatasetFolder
from rebar_depth_bench.data.rows import EyeTruth
from rebar_depth_bench.extended.axes import assign_segments
from rebar_depth_bench.extended.cover import camera_planes, judged_covers
from rebar_depth_bench.extended.disparity import match_right
from rebar_depth_bench.extended.judged import SAMPLED_PIXELS, judged_crossings, visible_segments
from rebar_depth_bench.extended.measures import EXTENDED_PROTOCOL
from rebar_depth_bench.extended.published import depth_steps
from rebar_depth_bench.extended.steel import PLANE_PIXELS, CoverPixels, JudgedCrossings, SceneBars, SteelTruth
from rebar_depth_bench.geometry.cameras import pixel_rays
from rebar_depth_bench.scoring.protocol import interior, single_bar_pixels
from rebar_depth_bench.scoring.truth import are_pixels_inside, cache_inputs, scored_counts, verified_views

_DTYPES: Mapping[str, type] = {
    "index": np.uint32,
    "depth_m": np.float32,
    "bar_id": np.uint16,
    "interior": np.bool_,
    "single_bar": np.bool_,
    "run": np.int16,
    "seen_by_right": np.bool_,
    "has_depth": np.uint8,
    "near_step": np.uint8,
    "step_depth_m": np.float32,
    "crossing": np.uint32,
    "pixel": np.uint32,
    "cover_segment": np.uint16,
    "cover_plane": np.uint16,
    "cover_pixel": np.uint32,
    "cover_depth_m": np.float32,
}
"""Arrays that are cached, with their types: of ``SteelTruth``, ``JudgedCrossings`` and ``CoverPixels``.

``pixel``, ``cover_pixel`` and ``cover_depth_m`` are flattened, and ``cover_plane`` holds positions
among the planes of the scene.
"""


Rays = Float64[ndarray, "hw 2"]
"""x/z and y/z of each pixel's ray, row by row."""

Lens = tuple[float, ...]
"""K, row by row, and distortion of a camera."""

_LENS_NUMBERS, _NUMBERS = 9 + 5, 9 + 5 + 16 + 1 + 1


def has_bar_ids(config: DatasetConfig) -> bool:
    """Return whether a config has the masks and bar ids that all extended measures need."""
    return config.absent_columns.isdisjoint(("left_mask", "left_bars"))


@dataclass(frozen=True, eq=False)
class ConfigSteelTruth:
    """Steel ground truth of all views of a config that have scored pixels.

    ``bars_by_view`` holds the bars of each view's scene. ``rays`` holds the rays of each distinct lens (K and
    distortion), which views share. ``source`` is the file that the crossings come from.
    """

    config: DatasetConfig
    bars_by_view: Mapping[str, SceneBars]
    rays: Mapping[Lens, Rays]
    source: CrossingsSource
    cache: ArrayCache

    def __len__(self) -> int:
        """Return the number of views."""
        return len(self.cache)

    @property
    def view_ids(self) -> tuple[str, ...]:
        """Ids of the views, in order."""
        return self.cache.view_ids

    def view(self, position: int) -> SteelTruth:
        """Return the view at ``position``, in the order of the trajectory."""
        view = self.cache.view(position)
        rays = self.rays[view.numbers[:_LENS_NUMBERS]]
        return _steel_truth(self.config, view, rays, self.bars_by_view[view.view_id])


def load_steel_truth(
    folder: DatasetFolder, config: DatasetConfig, progress: Progress = silent
) -> ConfigSteelTruth:
    """Return the ground truth of a config that ``has_bar_ids`` for extended measures, from the cache or computed.

    Raises ``DatasetError`` if the bars of a scene are missing, or if the bars or a view contradict the manifest.
    """
    path = folder.verified_file(BARS_FILE)
    bars = read_bars(path)
    crossings, source = folder_crossings(folder, bars)
    scenes = {}
    for scene in config.scenes:
        of_scene = bars.get(scene.name, None if config.imported is None else ())
        if of_scene is None:
            raise DatasetError(f"{path}: has no bars for scene {scene.name!r} of config {config.name}")
        scenes[scene.name] = SceneBars.of(of_scene, crossings.get(scene.name), scene.planes)
    bars_by_view = {view_id: scenes[scene] for view_id, scene in config.scene_by_view.items()}
    scored_px = scored_counts(config)

    def is_sound(view: ViewArrays) -> bool:
        has_camera = len(view.numbers) == _NUMBERS and all(map(math.isfinite, view.numbers))
        has_counts = np.count_nonzero(view.arrays["interior"]) == scored_px[view.view_id]
        return has_camera and has_counts and are_pixels_inside(view, config)

    content = CacheContent(
        task=f"bars in the views of {config.name}",
        inputs={
            **cache_inputs(
                config, f"{EXTENDED_PROTOCOL} {CROSSINGS_PROTOCOL}", f"{folder.files[BARS_FILE]} {source.sha256}"
            ),
            "planes": [[plane.model_dump() for plane in scene.planes] for scene in config.scenes],
        },
        dtypes=_DTYPES,
        view_ids=tuple(scored_px),
        extract=lambda view_ids: _view_arrays(config, bars_by_view, view_ids),
        is_sound=is_sound,
    )
    cache = open_cache(content, progress)
    rays = {lens: _rays(lens, config) for lens in {numbers[:_LENS_NUMBERS] for numbers in cache.numbers}}
    return ConfigSteelTruth(config, bars_by_view, rays, source, cache)


def _rays(lens: Lens, config: DatasetConfig) -> Rays:
    """Return x/z and y/z of every pixel's ray, row by row, lens distortion undone."""
    height, width = config.grid
    rays = pixel_rays(np.array(lens[:9]).reshape(3, 3), width, height, np.array(lens[9:]))
    return np.ascontiguousarray(rays[..., :2].reshape(-1, 2))


def _view_arrays(
    config: DatasetConfig, bars_by_view: Mapping[str, SceneBars], view_ids: Collection[str] | None
) -> Iterator[ViewArrays]:
    """Yield the cached arrays of some views, or of all with scored pixels.

    The numbers of a view are K, distortion, pose, parallax, and depth at the centre.
    """
    rays: dict[Lens, Rays] = {}
    for view_id, eyes, scored in verified_views(config, view_ids, config.truth_eyes):
        if not len(scored):
            continue
        left, camera = eyes[0], eyes[0].camera
        lens = (*camera.K.ravel().tolist(), *camera.distortion.tolist())
        if lens not in rays:
            rays[lens] = _rays(lens, config)
        arrays = _steel_arrays(left, scored, rays[lens], bars_by_view[view_id])
        parallax_px_m, is_seen = match_right(eyes, scored)
        arrays["seen_by_right"] = np.isin(arrays["index"], scored[is_seen], assume_unique=True)
        arrays |= depth_steps(left.depth_m)
        arrays |= {name: np.empty(0) for name in _DTYPES if name not in arrays}
        centre_m = float(left.depth_m[left.depth_m.shape[0] // 2, left.depth_m.shape[1] // 2])
        numbers = (*lens, *camera.cam_from_world.ravel().tolist(), parallax_px_m, centre_m)
        truth = _steel_truth(config, ViewArrays(view_id, arrays, numbers), rays[lens], bars_by_view[view_id])
        judged = judged_crossings(truth)
        planes = camera_planes(truth.bars.planes, truth.cam_from_world)
        segment, plane, pixels = judged_covers(left.depth_m, rays[lens], visible_segments(truth), planes)
        arrays |= {
            "crossing": judged.crossing,
            "pixel": judged.pixels.ravel(),
            "cover_segment": segment,
            "cover_plane": plane,
            "cover_pixel": pixels.ravel(),
            "cover_depth_m": left.depth_m.ravel()[pixels.ravel()],
        }
        yield ViewArrays(view_id, arrays, numbers)


def _steel_truth(config: DatasetConfig, view: ViewArrays, rays: Rays, bars: SceneBars) -> SteelTruth:
    """Return a view from its arrays and numbers, the rays of its lens, and the bars of its scene."""
    arrays = dict(view.arrays)
    names = ("crossing", "pixel", "cover_segment", "cover_plane", "cover_pixel")
    crossing, pixel, segment, plane, cover_pixel = (arrays.pop(name).astype(np.int64) for name in names)
    cover_pixel, cover_depth_m = cover_pixel.reshape(-1, PLANE_PIXELS), arrays.pop("cover_depth_m")
    lens, (*pose, parallax_px_m, centre_m) = view.numbers[:_LENS_NUMBERS], view.numbers[_LENS_NUMBERS:]
    height, width = config.grid
    cam_from_world = np.array(pose).reshape(4, 4)
    return SteelTruth(
        view_id=view.view_id,
        height=height,
        width=width,
        K=np.array(lens[:9]).reshape(3, 3),
        cam_from_world=cam_from_world,
        rays=rays[arrays["index"]],
        bars=bars,
        distortion=np.array(lens[9:]),
        judged=JudgedCrossings(crossing, pixel.reshape(-1, 2, SAMPLED_PIXELS)),
        covers=CoverPixels(
            segment,
            camera_planes(bars.planes, cam_from_world)[plane],
            cover_pixel,
            rays[cover_pixel],
            cover_depth_m.reshape(-1, PLANE_PIXELS),
        ),
        centre_depth_m=centre_m,
        parallax_px_m=parallax_px_m,
        **arrays,
    )


def _steel_arrays(left: EyeTruth, scored: ndarray, rays: Rays, scene: SceneBars) -> dict[str, ndarray]:
    """Return the arrays of ``SteelTruth`` for one view, by field name.

    ``scored`` holds the flat indices of the scored pixels. Segments are determined for these only.
    """
    depth_m, bars, mask = left.depth_m, left.bars, left.mask
    assert bars is not None  # ``has_bar_ids``
    assert mask is not None
    index = np.flatnonzero(dilate_mask(mask) & (depth_m > 0))
    is_scored = np.zeros(depth_m.size, dtype=bool)
    is_scored[scored] = True
    is_scored = is_scored[index]

    def spread(values: ndarray, elsewhere: float) -> ndarray:
        """Return values of scored pixels on ``index``, with another one beside them."""
        spread = np.full(len(index), elsewhere, values.dtype)
        spread[is_scored] = values
        return spread

    z_m, own = depth_m.ravel()[scored], bars.ravel()[scored]
    camera_m, pose = np.column_stack([z_m[:, None] * rays[scored], z_m]), left.camera.cam_from_world
    run = assign_segments((camera_m - pose[:3, 3]) @ pose[:3, :3], own, scene.cage)
    return {
        "index": index,
        "depth_m": depth_m.ravel()[index],
        "bar_id": bars.ravel()[index],
        "interior": is_scored,
        "single_bar": spread(single_bar_pixels(bars, scored), False),
        "run": spread(run, -1),
    }


def dilate_mask(mask: Bool[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Return a mask dilated by one pixel in all eight directions (3 x 3): what is not eroded of its complement."""
    return ~interior(np.pad(~mask, 1, constant_values=True))[1:-1, 1:-1]
