"""Ground truth of a config for scoring: the scored pixels of each view, and the scene of the paper that it shows.

It is extracted once per config and kept as arrays in the user's cache, keyed by a digest of the views; later runs
read the cache one view at a time.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import UInt32
from numpy import ndarray

from rebar_depth_bench.base.errors import DatasetError
from rebar_depth_bench.base.parallel import Progress, silent
from rebar_depth_bench.data.bars import BARS_FILE, read_bars, with_axis
from rebar_depth_bench.data.cache import ArrayCache, CacheContent, ViewArrays, open_cache
from rebar_depth_bench.data.manifest import DatasetConfig, DatasetFolder
from rebar_depth_bench.data.rows import EyeTruth, iterate_rows, truth_columns, truth_from_row
from rebar_depth_bench.data.schema import NEAREST_STEEL, Assembly, Trajectory
from rebar_depth_bench.scoring.columns import nested, rounded
from rebar_depth_bench.scoring.groups import ViewTraits, bar_width_px
from rebar_depth_bench.scoring.metrics import mean, median
from rebar_depth_bench.scoring.protocol import PROTOCOL, scored_pixels
from rebar_depth_bench.scoring.reference import REFERENCE_PLACES, UNDEFINED, references, view_reference
from rebar_depth_bench.scoring.table import PublishedMatch, Truth
from rebar_depth_bench.scoring.view_numbers import ViewTruth

_REFERENCE = slice(1, 5)
"""Places of ``view_reference`` among the cached numbers: after the median depth, before the bar width, if any."""


def config_truth(folder: DatasetFolder, config: DatasetConfig, progress: Progress = silent) -> Truth:
    """Return the ground truth of a config, from the cache or else extracted from the dataset.

    Views without scored pixels are omitted. A config with splits that has bar ids also needs the table of bars.
    Raises ``DatasetError`` naming the view if its ground truth does not match its digest in the manifest, and if
    the table of bars is missing or damaged.
    """
    scored_px = scored_counts(config)
    has_widths = config.has_splits and "left_bars" not in config.absent_columns
    diameters = _diameters_by_scene(folder) if has_widths else None

    def is_sound(view: ViewArrays) -> bool:
        has_counts = len(view.arrays["index"]) == scored_px[view.view_id]
        return has_counts and len(view.numbers) == _REFERENCE.stop + has_widths and are_pixels_inside(view, config)

    content = CacheContent(
        task=f"ground truth of {config.name}",
        inputs=cache_inputs(config, PROTOCOL, folder.files[BARS_FILE] if has_widths else ""),
        dtypes={"index": np.uint32, "depth_m": np.float32},
        view_ids=tuple(scored_px),
        extract=lambda view_ids: _extract_views(config, diameters, view_ids),
        is_sound=is_sound,
    )
    cache = open_cache(content, progress)
    families = {scene.name: scene.family for scene in config.scenes}
    traits = []
    for view_id, numbers in zip(cache.view_ids, cache.numbers, strict=True):
        width_px = numbers[-1] if has_widths and numbers[-1] != UNDEFINED else None
        traits.append(ViewTraits(families[config.scene_by_view[view_id]], numbers[0], width_px))
    return Truth(
        view_ids=cache.view_ids,
        views=_CachedViews(cache),
        references=[references(numbers[_REFERENCE]) for numbers in cache.numbers],
        traits=traits,
        split=config.scenes[0].split if config.has_splits else None,
        views_per_distance=config.views_per_distance,
        truth_sigma_m=None if config.imported is None else config.imported.truth_sigma_m,
        published=published_match(config),
    )


@dataclass(frozen=True)
class _CachedViews(Sequence[ViewTruth]):
    """Views of a config, each read from the cache when it is taken."""

    cache: ArrayCache

    def __len__(self) -> int:
        return len(self.cache)

    def __getitem__(self, position: int) -> ViewTruth:  # type: ignore[override]  # No slices.
        view = self.cache.view(position)
        median_m, abs_rel, rmse_cm, *_ = view.numbers
        return ViewTruth(view.view_id, view.arrays["index"], view.arrays["depth_m"], median_m, (abs_rel, rmse_cm))


def _diameters_by_scene(folder: DatasetFolder) -> dict[str, dict[int, float]]:
    """Return the nominal diameters of the bars whose axis is known, metres, by scene and bar id."""
    scenes = read_bars(folder.verified_file(BARS_FILE))
    return {name: {bar.bar_id: bar.diameter_m for bar in with_axis(bars)} for name, bars in scenes.items()}


def reference_errors(config: DatasetConfig) -> dict[str, dict[str, float | None]]:
    """Return the reference errors of a config as a JSON object, computed from its rows without the cache.

    Raises ``DatasetError`` as ``config_truth``.
    """
    views = [references(view.numbers[_REFERENCE]) for view in _extract_views(config, None)]
    means = {
        place.removeprefix("reference."): rounded(
            mean([view[place] for view in views if not math.isnan(view[place])])
        )
        for place in REFERENCE_PLACES
    }
    return nested(means)


def cache_inputs(config: DatasetConfig, protocol: str, extra_digest: str = "") -> dict[str, Any]:
    """Return what the cached arrays of a config under a protocol depend on; it becomes the key of the cache.

    The digests of the views are those that are verified when the arrays are extracted. ``extra_digest`` is the hex
    SHA-256 of further inputs, other than the views.
    """
    return {
        "protocol": protocol,
        "config": config.name,
        "scenes": [scene.name for scene in config.scenes],
        "grid": config.grid,
        "views": [view.model_dump() for view in config.views],
        "extra": extra_digest,
    }


def are_pixels_inside(view: ViewArrays, config: DatasetConfig) -> bool:
    """Return whether all values of ``index``, one or more, are pixels of the image."""
    return bool(view.arrays["index"].max() < math.prod(config.grid))


def scored_counts(config: DatasetConfig) -> dict[str, int]:
    """Return the number of scored pixels of each view that has any, in the order of the manifest."""
    return {view.view_id: view.scored_px for view in config.views if view.scored_px}


def verified_views(
    config: DatasetConfig, view_ids: Collection[str] | None = None, eyes: Sequence[str] = ("left",)
) -> Iterator[tuple[str, Sequence[EyeTruth], UInt32[ndarray, " n"]]]:
    """Yield id, eyes and flat indices of the scored pixels of some views, or all, verified by the manifest.

    The first of ``eyes`` is the left one, which has the scored pixels.
    Raises ``DatasetError`` as ``iterate_rows``, and naming a view that does not match its digest.
    """
    records = {view.view_id: view for view in config.views}
    columns = [column for eye in eyes for column in truth_columns(eye)]
    for row in iterate_rows(config, ("view_id", *columns), view_ids):
        record, truths = records[row["view_id"]], [truth_from_row(row, eye) for eye in eyes]
        pixels = scored_pixels(truths[0].mask, truths[0].depth_m)
        for eye, truth in zip(eyes, truths, strict=True):
            digest, expected = truth.digest(), getattr(record, eye)
            if digest != expected or len(pixels) != record.scored_px:
                raise DatasetError(
                    f"{config.root}: view {record.view_id}: {eye} ground truth has digest {digest[:16]} and "
                    f"{len(pixels)} scored pixels, the manifest has {expected[:16]} and {record.scored_px}; "
                    f"rebar-bench verify {config.root} lists damaged files"
                )
        yield record.view_id, truths, pixels


def _extract_views(
    config: DatasetConfig,
    diameters: Mapping[str, Mapping[int, float]] | None,
    view_ids: Collection[str] | None = None,
) -> Iterator[ViewArrays]:
    """Yield the cached arrays and numbers of some views, or of all that have scored pixels.

    With ``diameters``, the diameters of the bars by scene, the last number is the bar width in pixels.
    """
    for view_id, (left,), pixels in verified_views(config, view_ids):
        if len(pixels):
            depth_m = left.depth_m.ravel()[pixels]
            median_m = median(depth_m)
            numbers: tuple[float, ...] = (median_m, *view_reference(left.depth_m, pixels, median_m))
            if diameters is not None:
                known_m = diameters.get(config.scene_by_view[view_id], {})
                assert left.bars is not None
                bar_id, focal_px = left.bars.ravel()[pixels], float(left.camera.K[0, 0])
                numbers += (bar_width_px(depth_m, bar_id, known_m, focal_px) or UNDEFINED,)
            yield ViewArrays(view_id, {"index": pixels, "depth_m": depth_m}, numbers)


# Conditions of the paper's Table I: which configs of a dataset its rows may be shown beside. Source: "Benchmarking
# Metric Depth for Construction Perception: Industrial Rebar Scenes with Exact Synthetic Ground Truth", sections
# II.A and II.C. The lattice was evaluated on the views of a ZED, rectified.

_GRID = (720, 1280)
_IDEAL = ("ideal", 0.12)
_ZED_RECTIFIED = ("rectified", 0.119978)


@dataclass(frozen=True)
class _Conditions:
    """Conditions of a scene; ``optics`` are grid and baseline in metres, ``markers`` is their number."""

    assembly: Mapping[str, Any]
    markers: int
    environment: str
    trajectory: Trajectory
    optics: tuple[str, float]


_CONDITIONS: Mapping[str, _Conditions] = {
    "lattice": _Conditions(
        {"kind": "lattice", "extent_m": 0.1, "pitch_m": 0.02, "diameters_m": [0.007, 0.004]},
        6,
        "laboratory",
        Trajectory(
            radii_m=(0.22, 0.3, 0.35, 0.38, 0.4, 0.42, 0.43),
            elevations_deg=(15.0, 27.0, 39.0, 51.0, 63.0, 75.0),
            azimuths=12,
        ),
        _ZED_RECTIFIED,
    ),
    "pile": _Conditions(
        {"kind": "pile", "stirrups": 6, "diameter_m": 0.01, "size_m": [0.28, 0.2], "state": "pile-0"},
        6,
        "laboratory",
        Trajectory(
            radii_m=(0.5, 0.57, 0.59, 0.62, 0.65, 0.67, 0.9),
            elevations_deg=(28.0, 37.0, 46.0, 55.0, 64.0, 73.0),
            azimuths=12,
        ),
        _IDEAL,
    ),
    "pier": _Conditions(
        {
            "kind": "pier",
            "side_m": 4.8,
            "height_m": 6.67,
            "verticals": 96,
            "levels": 45,
            "vertical_diameter_m": 0.032,
            "hoop_diameter_m": 0.016,
            "tie_diameter_m": 0.016,
        },
        0,
        "outdoors",
        Trajectory(
            radii_m=(8.0, 11.0, 13.0, 14.5, 15.5, 16.25, 17.0),
            elevations_deg=(-7.5, -1.0, 7.0, 17.0, 29.0, 44.0),
            azimuths=12,
            distance_to=NEAREST_STEEL,
        ),
        _IDEAL,
    ),
}


def published_match(config: DatasetConfig) -> PublishedMatch | None:
    """Return the scene of Table I whose rows may be shown beside a config, or None."""
    name = _paper_scene(config)
    if name is None or paper_differences(config):
        return None
    rig = config.scene.rig
    # The ideal rig of the paper has neither the name of another camera nor numbers of its own.
    is_other = rig is None or (rig.grid == "ideal" and (rig.camera != "" or rig.calibration is not None))
    optics = None if rig is None or is_other else (rig.grid, rig.baseline_m)
    return PublishedMatch(name, optics == _CONDITIONS[name].optics)


def paper_differences(config: DatasetConfig) -> list[str]:
    """Return why the rows of Table I may not be shown beside a config; empty if they may.

    Assembly, board, environment, image size and trajectory have to be equal, with all of its views and without
    appearance variants.
    """
    name = _paper_scene(config)
    if name is None:
        return ["not a scene of the paper"]
    expected, scene = _CONDITIONS[name], config.scene
    markers = scene.board.markers if scene.board else 0
    (height, width), of_views = config.grid, scene.protocol_views
    conditions = {
        f"{len(config.views)} of {of_views} views": len(config.views) == of_views,
        f"{width} x {height} pixels, not {_GRID[1]} x {_GRID[0]}": config.grid == _GRID,
        "other camera positions": scene.trajectory == expected.trajectory,
        f"{markers} markers, not {expected.markers}": markers == expected.markers,
        f"environment {scene.environment}, not {expected.environment}": scene.environment == expected.environment,
        "variants of appearance": not scene.appearance.variants,
    }
    return [difference for difference, is_equal in conditions.items() if not is_equal]


def _paper_scene(config: DatasetConfig) -> str | None:
    """Return the scene of Table I that has the assembly of a config, or None."""
    if config.imported is not None or config.has_splits:
        return None
    assemblies = {name: Assembly.model_validate(one.assembly) for name, one in _CONDITIONS.items()}
    return next((name for name, assembly in assemblies.items() if assembly == config.scene.assembly), None)
