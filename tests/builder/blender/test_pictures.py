"""Rendered colour against the ground truth: right pictures warped to the left.

The right picture is sampled where the points of the left pixels project, and at whole-pixel shifts from there. If
depth, poses, K and pictures are consistent, they match best at zero shift. All whole-pixel shifts sample at the
same fractions of a pixel, so that noise and interpolation affect them equally; a parabola through the three lowest
costs gives the shift to hundredths of a pixel. Errors that both eyes share are for the audit, which compares depth
with Cycles, and for the markers of ``test_scene``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pytest
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray
from scipy.ndimage import map_coordinates

from dataset_builder.audit.checks import AuditedConfig, AuditedEye, AuditedView, RayCache, view_from_row
from dataset_builder.audit.independent_depth import project_into
from dataset_builder.catalog.named_configs import CONFIGS
from rebar_depth_bench.data.bars import BARS_FILE, read_bars
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.rows import iterate_rows
from rebar_depth_bench.data.schema import COLUMNS
from rebar_depth_bench.geometry.cameras import camera_centre
from tests.builder.audit.audit_scene import with_baseline, with_depth, with_K_shift
from tests.building import RunBuild

Pictures = tuple[str, AuditedConfig, Sequence[AuditedView]]
GRID = ("--width", "640", "--height", "360")
SHIFTS_PX = range(-3, 4)
MAX_PIXELS = 20_000
DEPTH_TOLERANCE = 0.03
"""Relative difference from which two depths belong to different surfaces."""


def photometric_problems(config: AuditedConfig, views: Sequence[AuditedView]) -> list[str] | None:
    """Report a common shift of all views above 0.1 px, more with few pixels, or of a single view above a pixel.

    None stands for too few pixels. Correct renders give under 0.05 px at 1280 x 720, and 0.1 px in three noisy
    views of 160 x 90.
    """
    costs, counts = zip(*(shift_costs(config, view) for view in views), strict=True)
    if sum(counts) < 1000:
        return None
    together_px = [best_shift_px(cost) for cost in np.sum(costs, axis=0)]
    is_off = np.abs(together_px).max() > 0.1 + 6 / sum(counts) ** 0.5
    problems = [f"all views match best at an offset of {together_px} px"] if is_off else []
    for view, cost, count in zip(views, costs, counts, strict=True):
        if count >= 300 and max(abs(best_shift_px(along)) for along in cost) > 1:
            problems.append(f"view {view.view_id} matches best more than a pixel off")
    return problems


def shift_costs(config: AuditedConfig, view: AuditedView) -> tuple[Float64[ndarray, "2 7"], int]:
    """Return the squared differences of both pictures by shift along u and along v, and the number of pixels."""
    left, right = smoothed_grey(view.left), smoothed_grey(view.right)
    left_m, right_m = (camera_centre(eye.camera.cam_from_world) for eye in view.eyes.values())
    pixels = comparable_pixels(config, view.left, left, float(np.linalg.norm(left_m - right_m)))
    projected = project_into(view.right, view.left.points_m.reshape(-1, 3)[pixels], len(SHIFTS_PX))
    seen = np.flatnonzero(projected.inside)
    bars = view.left.bars.ravel()[pixels[seen]]
    seen = seen[is_visible(view.right, projected.px[seen], projected.depth_m[seen], bars)]
    seen = seen[:: len(seen) // MAX_PIXELS + 1]
    cost = np.zeros((2, len(SHIFTS_PX)))
    for axis, (n, shift_px) in product((0, 1), enumerate(SHIFTS_PX)):
        u, v = (projected.px[seen] + shift_px * np.eye(2)[axis]).T
        difference = map_coordinates(right, [v, u], order=1) - left.ravel()[pixels[seen]]
        # Clipping bounds the weight of highlights that only one eye sees.
        cost[axis, n] = np.minimum(difference**2, 40.0**2).sum()
    return cost, len(seen)


def best_shift_px(cost: Float64[ndarray, " 7"]) -> float:
    """Return the vertex of the parabola through the least cost and its neighbours, or the end of the range."""
    best = int(np.argmin(cost))
    if best in (0, len(cost) - 1):
        return float(SHIFTS_PX[best])
    before, here, after = cost[best - 1 : best + 2]
    return float(SHIFTS_PX[best] + (before - after) / 2 / (before - 2 * here + after))


def smoothed_grey(eye: AuditedEye) -> Float32[ndarray, "h w"]:
    """Return the grey levels without the noise of few samples, and smooth enough for bilinear interpolation."""
    assert eye.rgb is not None
    grey = cv2.cvtColor(eye.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), 1.0))


def comparable_pixels(
    config: AuditedConfig, eye: AuditedEye, levels: Float32[ndarray, "h w"], baseline_m: float
) -> Int64[ndarray, " n"]:
    """Return the flat indices of pixels with depth and texture that look the same to both eyes.

    Left out are bars whose light and dark sides move by more than 0.05 px between the eyes, about half the angle
    between the eyes times the radius, and other surfaces near a jump or steep change of depth: there the colours
    of two surfaces are mixed, or only one side of an edge would be compared.
    """
    textured = np.hypot(*(cv2.Sobel(levels, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))) >= 4.0
    has_depth = eye.depth_m > 0
    focal_px, depth_m = eye.camera.K[0, 0], np.where(has_depth, eye.depth_m, np.inf).astype(np.float64)
    around = np.ones((3, 3), dtype=np.uint8)
    rise_m = np.maximum(
        cv2.dilate(eye.depth_m, around) - eye.depth_m, eye.depth_m - cv2.erode(eye.depth_m, around)
    )
    jump = np.abs(cv2.Laplacian(focal_px * baseline_m / depth_m, cv2.CV_64F)) > 0.2
    jump |= eye.mask | (rise_m >= DEPTH_TOLERANCE * eye.depth_m)
    near_jump = cv2.dilate(jump.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    radius_m = np.zeros(np.iinfo(np.uint16).max + 1)
    for bar in config.steel:
        radius_m[bar.bar_id] = bar.diameter_m / 2 if bar.has_axis else np.inf
    shading_shift_px = radius_m[eye.bars] * focal_px * baseline_m / depth_m**2 / 2
    return np.flatnonzero(textured & has_depth & (eye.mask | ~near_jump) & (shading_shift_px < 0.05))


def is_visible(
    eye: AuditedEye, px: Float64[ndarray, "n 2"], depth_m: Float64[ndarray, " n"], bars: ndarray
) -> Bool[ndarray, " n"]:
    """Return whether the eye's pixels around each projection have the point's bar id and about its depth.

    They are four, or fewer where a coordinate is whole, as the rows of parallel eyes are: a row more, always the
    one below, would leave out the lower sides of thin bars only.
    """
    low, high = np.floor(px + 1e-6).astype(int), np.ceil(px - 1e-6).astype(int)
    visible = np.ones(len(px), dtype=bool)
    for u, v in product((low[:, 0], high[:, 0]), (low[:, 1], high[:, 1])):
        visible &= (np.abs(eye.depth_m[v, u] - depth_m) < DEPTH_TOLERANCE * depth_m) & (eye.bars[v, u] == bars)
    return visible


def pictures(root: Path) -> Iterator[Pictures]:
    """Yield the label and the views of each scene of each config of a folder."""
    steel = read_bars(root / BARS_FILE)
    for config in open_folder(root).config_by_name.values():
        for scene in config.by_scene():
            spec, rays = scene.scene, RayCache()
            audited = AuditedConfig(spec.appearance.variants, steel[spec.name], spec.board)
            yield scene.label, audited, [view_from_row(row, rays) for row in iterate_rows(scene, COLUMNS)]


@pytest.fixture(scope="module")
def lattice(tmp_path_factory: pytest.TempPathFactory, run_build: RunBuild) -> Pictures:
    """Return two small views of the lattice."""
    root = tmp_path_factory.mktemp("pictures") / "dataset"
    process = run_build("--out", root, "--config", "lattice", "--views", "2", *GRID, "--samples", "4")
    assert process.returncode == 0, process.stderr
    (only,) = pictures(root)
    return only


@pytest.mark.parametrize(
    "damaged",
    [
        lambda view: with_depth(view, 1.01),
        lambda view: with_baseline(view, 0.002),
        lambda view: with_K_shift(view, ("right",), 0, 0.5),
        lambda view: with_K_shift(view, ("right",), 1, 0.5),
    ],
    ids=["depth 1 % off", "baseline 2 mm off", "K off along u", "K off along v"],
)
def test_only_small_errors_of_the_ground_truth_are_reported(
    lattice: Pictures, damaged: Callable[[AuditedView], AuditedView]
) -> None:
    _, config, views = lattice
    assert photometric_problems(config, views) == []
    assert photometric_problems(config, [damaged(view) for view in views])


@pytest.mark.nightly
def test_every_config_is_where_its_ground_truth_says(tmp_path: Path, run_build: RunBuild) -> None:
    root = tmp_path / "dataset"
    for options in (
        ("--views", "3"),
        ("--config", "lattice", "--variant", "wet", "formwork", "--views", "2"),
        ("--config", "lattice", "--variant", "sensor", "sunset", "--views", "2"),
        ("--scene", "examples/beam.toml", "--views", "2"),
        ("--config", "cages", "--split", "validation", "--scenes", "4", "--views-per-scene", "2"),
    ):
        process = run_build("--out", root, *options, *GRID, "--samples", "8")
        assert process.returncode == 0, process.stderr
    measured = set()
    for label, config, views in pictures(root):
        problems = photometric_problems(config, views)
        assert not problems, (label, problems)
        if problems is not None:
            measured.add(label)
    assert measured >= set(CONFIGS)
