"""Synthetic views of smooth straight bars: closed-form intersection of pinhole rays and cylinders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rebar_depth_bench.bar_crossings.definition import scene_crossings
from rebar_depth_bench.data.bars import Bar, with_axis
from rebar_depth_bench.extended.axes import assign_segments
from rebar_depth_bench.extended.frames import SteelSamples, steel_frames
from rebar_depth_bench.extended.judged import judged_crossings
from rebar_depth_bench.extended.steel import PLANE_PIXELS, CoverPixels, JudgedCrossings, SceneBars, SteelTruth
from rebar_depth_bench.scoring.protocol import interior, single_bar_pixels

WIDTH, HEIGHT, FOCAL_PX = 240, 160, 210.0
CAMERA_AT_ORIGIN = np.eye(4)
NO_CROSSINGS = JudgedCrossings(np.empty(0, np.int64), np.empty((0, 2, 1), np.int64))
NO_COVERS = CoverPixels(
    np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, PLANE_PIXELS), np.int64),
    np.empty((0, PLANE_PIXELS, 2)), np.empty((0, PLANE_PIXELS), np.float32),
)  # fmt: skip


def bar(bar_id: int, start_m: Sequence[float], end_m: Sequence[float], diameter_m: float = 0.02) -> Bar:
    """Return a straight bar between two points, world, metres."""
    (x, y, z), (u, v, w) = start_m, end_m
    return Bar(bar_id, "bar", diameter_m, ((x, y, z), (u, v, w)))


def mat(dx: float = 0.0, dy: float = 0.0, dz: float = 0.0, diameter_m: float = 0.02) -> list[Bar]:
    """Return a two-layer mat of bars before a camera at the origin that looks along z, shifted by a vector (m).

    Bars 1 to 3 are vertical at z = 0.4 m, 80 mm apart; bars 4 and 5 are horizontal, 60 mm behind them and 100 mm
    apart; bar 6 is vertical, 100 mm behind bar 2 and 30 mm aside: its neighbour in depth.
    """
    upright = [
        bar(i + 1, (x + dx, -0.14 + dy, 0.4 + dz), (x + dx, 0.14 + dy, 0.4 + dz), diameter_m)
        for i, x in enumerate((-0.08, 0.0, 0.08))
    ]
    lying = [
        bar(i + 4, (-0.2 + dx, y + dy, 0.46 + dz), (0.2 + dx, y + dy, 0.46 + dz), diameter_m)
        for i, y in enumerate((-0.05, 0.05))
    ]
    behind = bar(6, (0.03 + dx, -0.14 + dy, 0.5 + dz), (0.03 + dx, 0.14 + dy, 0.5 + dz), diameter_m)
    return [*upright, *lying, behind]


def pixel_directions() -> np.ndarray:
    """Return the ray (x/z, y/z, 1) of every pixel, row by row, shape (HEIGHT * WIDTH, 3)."""
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    x, y = (u - (WIDTH - 1) / 2) / FOCAL_PX, (v - (HEIGHT - 1) / 2) / FOCAL_PX
    return np.asarray(np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3))


def depth_on_bar_m(steel: Bar, cam_from_world: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the planar depth, metres, at which rays hit the side of a bar (not its ends); inf where they miss."""
    ends_m = np.array(steel.axis_m) @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
    line_m = ends_m[1] - ends_m[0]
    length_m = np.linalg.norm(line_m)
    u = line_m / length_m
    ray_flat = directions - np.outer(directions @ u, u)
    start_flat = ends_m[0] - (ends_m[0] @ u) * u
    a, b = (ray_flat**2).sum(axis=1), ray_flat @ start_flat
    c = start_flat @ start_flat - (steel.diameter_m / 2) ** 2
    with np.errstate(invalid="ignore", divide="ignore"):
        depth_m = (b - np.sqrt(b * b - a * c)) / a
        along_m = depth_m * (directions @ u) - ends_m[0] @ u
    hit = np.isfinite(depth_m) & (depth_m > 0) & (along_m >= 0) & (along_m <= length_m)
    return np.asarray(np.where(hit, depth_m, np.inf))


def cast(bars: Sequence[Bar], cam_from_world: np.ndarray = CAMERA_AT_ORIGIN) -> tuple[np.ndarray, np.ndarray]:
    """Return planar depth (metres) and bar id of every pixel; both are 0 where there is no bar."""
    directions = pixel_directions()
    depths_m = np.stack([depth_on_bar_m(item, cam_from_world, directions) for item in bars])
    nearest = depths_m.argmin(axis=0)
    depth_m = depths_m.min(axis=0)
    ids = np.array([item.bar_id for item in bars])[nearest]
    visible = np.isfinite(depth_m)
    return np.where(visible, depth_m, 0.0), np.where(visible, ids, 0)


def view(bars: Sequence[Bar], cam_from_world: np.ndarray = CAMERA_AT_ORIGIN) -> SteelTruth:
    """Return the truth of one view of bars (steel pixels only), with the judged crossings of the bars."""
    scene = SceneBars.of(bars, scene_crossings(bars))
    depth_m, ids = cast(with_axis(bars), cam_from_world)
    index = np.flatnonzero(depth_m)
    rays = pixel_directions()[index, :2]
    z_m = depth_m[index].astype(np.float32)
    points_m = np.column_stack([rays, np.ones(len(index))]) * z_m.astype(np.float64)[:, None]
    world_m = (points_m - cam_from_world[:3, 3]) @ cam_from_world[:3, :3]
    bar_id = ids[index].astype(np.uint16)
    inside = interior((ids > 0).reshape(HEIGHT, WIDTH)).ravel()[index]
    K = np.array([[FOCAL_PX, 0, (WIDTH - 1) / 2], [0, FOCAL_PX, (HEIGHT - 1) / 2], [0, 0, 1.0]])
    run = assign_segments(world_m, bar_id, scene.cage)
    single_bar = np.zeros_like(inside)
    scored = index[inside].astype(np.uint32)
    single_bar[inside] = single_bar_pixels(ids.reshape(HEIGHT, WIDTH).astype(np.uint16), scored)
    truth = SteelTruth(
        "lattice/0000", HEIGHT, WIDTH, K, cam_from_world, index.astype(np.uint32), z_m, bar_id, inside,
        single_bar, rays, run, NO_CROSSINGS, NO_COVERS, scene,
    )  # fmt: skip
    return replace(truth, judged=judged_crossings(truth))


def steel_samples(p_m: np.ndarray, truth: SteelTruth) -> SteelSamples:
    """Return the native samples of depth on the pixels of a truth, metres."""
    image_m = np.full(truth.height * truth.width, np.nan)
    image_m[truth.index] = p_m
    return steel_frames(image_m.reshape(truth.height, truth.width), truth, 0).native.predicted


def predicted_m(moved: Sequence[Bar], truth: SteelTruth) -> np.ndarray:
    """Return the depth of displaced bars, metres, on the true pixels of the bars with their ids; NaN: missed."""
    rays = np.column_stack([truth.rays, np.ones(len(truth.rays))])
    depth_m = np.full(len(rays), np.nan)
    for displaced in moved:
        own = truth.bar_id == displaced.bar_id
        depth_m[own] = depth_on_bar_m(displaced, truth.cam_from_world, rays[own])
    return np.where(np.isfinite(depth_m), depth_m, np.nan)
