"""Samples of bars, spacings, covers and crossings: their truth, errors and alignments, from folder to CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from numpy import ndarray
from scipy.ndimage import gaussian_filter
from scipy.optimize import least_squares

import rebar_depth_bench as rdb
from rebar_depth_bench.base.errors import DatasetError, InputError
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.schema import FormPlane
from rebar_depth_bench.extended import cover
from rebar_depth_bench.extended.cover import camera_planes, fit_planes, judged_covers
from rebar_depth_bench.extended.frames import (
    AlignedSamples,
    SteelFrames,
    SteelSamples,
    joined,
    laser_reading_m,
    steel_frames,
)
from rebar_depth_bench.extended.ground_truth import load_steel_truth
from rebar_depth_bench.extended.inspection import MEASURES
from rebar_depth_bench.extended.judged import visible_segments
from rebar_depth_bench.extended.measures import STATISTICS
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.scorer import ScoredResult
from rebar_depth_bench.submission import SubmissionReader
from tests.bench.extended.cage_scenes import pixel_directions
from tests.mat_dataset import CONFIG, DECK, DECK_Z_M, VIEWS, write_mat_dataset

COVERS_MM = {1: 51.0, 2: 51.0, 11: 30.0, 12: 30.0}
"""True cover of each bar: the distance of its axis from the deck, less its radius."""

KINDS: tuple[Literal["bars", "spacings", "crossings"], ...] = ("bars", "spacings", "crossings")

Views = list[tuple[SteelTruth, ndarray]]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("deck") / "dataset"
    folder.mkdir()
    write_mat_dataset(folder, with_deck=True)
    return folder


@pytest.fixture(scope="module")
def views(root: Path) -> Views:
    """Return truth and depth of each view of the mat above a deck."""
    folder = open_folder(root)
    steel = load_steel_truth(folder, folder.config(CONFIG))
    depths = {row["view_id"]: row["left_depth"] for row in rdb.load(root, CONFIG)}
    return [(steel.view(place), depths[view_id]) for place, view_id in enumerate(steel.view_ids)]


def sampled(views: Views, predict: Callable[[ndarray], ndarray]) -> SteelFrames:
    """Return the samples of all views; ``predict`` makes a prediction of the true depth."""
    return joined([steel_frames(predict(z_m), truth, place) for place, (truth, z_m) in enumerate(views)])


def test_exact_depth_measures_everything(views: Views) -> None:
    frames = sampled(views, lambda z_m: z_m)
    bars, spacings, crossings = (
        getattr(frames.native.predicted, one.name) for one in fields(frames.native.predicted)
    )
    assert (len(bars), len(spacings), len(crossings)) == (4 * VIEWS, 2 * VIEWS, 4 * VIEWS)
    for samples in (bars, spacings, crossings):
        assert samples.view.tolist() == np.repeat(range(VIEWS), len(samples) // VIEWS).tolist()
    assert bars.found.all()
    assert crossings.found.all()
    np.testing.assert_allclose(bars.true_cover_mm, [COVERS_MM[bar] for bar in bars.bar_id], atol=1e-6)
    np.testing.assert_allclose(bars.cover_mm, bars.true_cover_mm, atol=0.01)
    assert bars.diameter_judged.any()
    np.testing.assert_allclose(bars.diameter_mm[bars.diameter_judged], 20, atol=0.1)
    np.testing.assert_allclose(spacings.true_spacing_mm.reshape(-1, 2), [[120, 100]] * VIEWS, atol=1e-6)
    np.testing.assert_allclose(spacings.spacing_mm, spacings.true_spacing_mm, atol=0.01)
    np.testing.assert_allclose(crossings.true_layer_mm, 21)
    np.testing.assert_allclose(crossings.layer_mm, crossings.true_layer_mm, atol=0.01)
    assert crossings.tie_error_mm.max() < 0.01
    # A point of each fitted axis is on the axis in the world.
    is_upright = bars.bar_id < 10
    np.testing.assert_allclose(bars.point_m[:, 2], np.where(is_upright, 0, -0.021), atol=1e-5)
    np.testing.assert_allclose(np.abs(bars.direction[:, 1]), is_upright, atol=1e-4)
    # Exact depth as submitted is the exact depth of the frames.
    for one in fields(bars):
        np.testing.assert_array_equal(getattr(bars, one.name), getattr(frames.native.exact.bars, one.name))
    assert frames.laser_views == VIEWS
    assert frames.unread_views == 0


def test_farther_depth_moves_ties_and_keeps_cover(views: Views) -> None:
    steel = sampled(views, lambda z_m: z_m + np.float32(0.008)).native.predicted
    assert steel.bars.found.all()
    np.testing.assert_allclose(steel.crossings.tie_along_mm, 8, atol=0.1)
    assert steel.crossings.tie_error_mm.min() > 7.9
    np.testing.assert_allclose(
        np.hypot(steel.crossings.tie_along_mm, steel.crossings.tie_across_mm), steel.crossings.tie_error_mm
    )
    np.testing.assert_allclose(steel.bars.cover_mm, steel.bars.true_cover_mm, atol=0.3)


def test_depth_of_the_deck_alone_changes_the_cover_alone(views: Views) -> None:
    """The deck 5 mm lower along the optical axis adds at most 5 mm of cover, less by the tilt of the camera."""
    added = []
    for place, (truth, z_m) in enumerate(views):
        on_steel = np.zeros(z_m.size, bool)
        on_steel[truth.index[truth.bar_id > 0]] = True
        lower_m = z_m + np.where(on_steel.reshape(z_m.shape), 0, 0.005).astype(np.float32)
        bars = steel_frames(lower_m, truth, place).native.predicted.bars
        assert bars.offset_mm.max() < 0.01
        axis_z = truth.cam_from_world[2, 2]
        np.testing.assert_allclose((bars.cover_mm - bars.true_cover_mm) / -axis_z, 5, atol=0.5)
        added += (bars.cover_mm - bars.true_cover_mm).tolist()
    assert min(added) > 4


@pytest.mark.parametrize("blur_px", [None, 12.0], ids=["constant", "blurred"])
def test_predictions_without_bars_fail(views: Views, blur_px: float | None) -> None:
    def predict(z_m: ndarray) -> ndarray:
        return np.full_like(z_m, np.median(z_m)) if blur_px is None else gaussian_filter(z_m, blur_px)

    steel = sampled(views, predict).native.predicted
    errors_mm = np.where(steel.crossings.found, steel.crossings.tie_error_mm, np.inf)
    assert np.mean(errors_mm <= 5) < 0.5
    cover_mm = np.abs(steel.bars.cover_mm - steel.bars.true_cover_mm)
    assert not (cover_mm <= 5).any()


def test_plane_is_one_constant_that_knows_the_distance(views: Views) -> None:
    """Its samples are those of a constant prediction at the median front of the bars, or of the ties."""
    frames = sampled(views, lambda z_m: z_m)
    for place, (truth, z_m) in enumerate(views):
        exact, plane = frames.native.exact, frames.native.plane
        in_view = exact.bars.view == place
        constant = np.full_like(z_m, np.median(exact.bars.distance_m[in_view]) - 0.01, dtype=np.float64)
        bars = steel_frames(constant, truth, place).native.predicted.bars
        np.testing.assert_allclose(bars.offset_mm, plane.bars.offset_mm[in_view], rtol=1e-9)
        in_view = exact.crossings.view == place
        constant[:] = np.median(exact.crossings.distance_m[in_view]) - 0.01
        crossings = steel_frames(constant, truth, place).native.predicted.crossings
        np.testing.assert_allclose(crossings.tie_error_mm, plane.crossings.tie_error_mm[in_view], rtol=1e-9)


def test_laser_sets_the_scale_of_each_view(views: Views) -> None:
    """A factor has no effect; a view that has no prediction at its centre fails; one without truth is left out."""
    rng = np.random.default_rng(1)
    once = sampled(views, lambda z_m: z_m)
    scaled = sampled(views, lambda z_m: rng.uniform(0.5, 2) * z_m.astype(np.float64))
    for frames in (once, scaled):
        laser = frames.laser
        np.testing.assert_allclose(
            laser.predicted.crossings.tie_error_mm, laser.exact.crossings.tie_error_mm, atol=1e-3
        )
        np.testing.assert_allclose(laser.predicted.bars.cover_mm, laser.exact.bars.cover_mm, atol=1e-3)
    noise_mm = [1000 * (laser_reading_m(f"{CONFIG}/{place:04d}", 2.0) - 2.0) for place in range(2000)]
    assert np.std(noise_mm) == pytest.approx(1.0, rel=0.05)
    assert np.mean(noise_mm) == pytest.approx(0, abs=0.08)
    truth, z_m = views[0]
    assert truth.centre_depth_m == z_m[z_m.shape[0] // 2, z_m.shape[1] // 2]
    factor = laser_reading_m(truth.view_id, truth.centre_depth_m) / truth.centre_depth_m
    by_hand = steel_frames(factor * z_m.astype(np.float64), truth, 0).native.predicted
    np.testing.assert_allclose(
        once.laser.exact.crossings.tie_along_mm[:4], by_hand.crossings.tie_along_mm, atol=1e-6
    )
    hole_m = z_m.copy()
    hole_m[z_m.shape[0] // 2, z_m.shape[1] // 2] = np.nan
    unread = steel_frames(hole_m, truth, 0)
    assert (unread.laser_views, unread.unread_views) == (1, 1)
    assert not unread.laser.predicted.bars.found.any()
    assert unread.laser.exact.bars.found.all()
    nothing = steel_frames(z_m, replace(truth, centre_depth_m=0.0), 0)
    assert (nothing.laser_views, len(nothing.laser.predicted.bars), len(nothing.native.predicted.bars)) == (
        0,
        0,
        4,
    )


def test_fits_agree_with_scipy(views: Views) -> None:
    """Axes, cover and tie points of noisy depth, against robust fits by another solver from scratch."""
    rng = np.random.default_rng(5)
    truth, z_m = views[2]
    p_m = z_m + rng.normal(0, 0.0005, z_m.shape)
    bars = steel_frames(p_m, truth, 0).native.predicted.bars
    visible = visible_segments(truth)
    shift_mm, cover_mm = [], []
    for row in range(len(bars)):
        flat = truth.index[visible.pixels[row][visible.used[row]]]
        points_m = p_m.ravel()[flat, None] * pixel_directions()[flat]
        axis, middle_m = visible.frame[row, 2], visible.middle_m[row]
        away, side = middle_m / np.linalg.norm(middle_m), np.cross(axis, middle_m / np.linalg.norm(middle_m))

        def off_surface_m(unknowns: ndarray) -> ndarray:
            point_m = middle_m + unknowns[0] * side + unknowns[1] * away  # noqa: B023
            direction = axis + unknowns[2] * side + unknowns[3] * away  # noqa: B023
            direction /= np.linalg.norm(direction)
            return np.asarray(np.linalg.norm(np.cross(points_m - point_m, direction), axis=1) - 0.01)  # noqa: B023

        found = least_squares(off_surface_m, np.zeros(4), loss="soft_l1", f_scale=0.002, x_scale=1e-3).x
        point_m = middle_m + found[0] * side + found[1] * away
        shift_mm.append(1000 * (point_m - middle_m)[2])
        pixels = truth.covers.pixels[row]
        form_m = p_m.ravel()[pixels, None] * pixel_directions()[pixels]
        normal = np.linalg.svd(form_m - form_m.mean(axis=0))[2][2]
        cover_mm.append(1000 * (abs((point_m - form_m.mean(axis=0)) @ normal) - 0.01))
    np.testing.assert_allclose(bars.depth_offset_mm, shift_mm, atol=0.15)
    np.testing.assert_allclose(bars.cover_mm, cover_mm, atol=0.2)
    assert np.abs(bars.cover_mm - bars.true_cover_mm).max() < 1


def test_plane_fit_ignores_a_third_of_outliers_and_needs_half_of_the_pixels(
    views: Views, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth, _ = views[1]
    covers, rng = truth.covers, np.random.default_rng(3)
    exact_m = covers.depth_m.astype(np.float64)
    outliers_m = exact_m + np.where(rng.random(exact_m.shape) < 0.33, rng.uniform(0.03, 1, exact_m.shape), 0)
    np.testing.assert_allclose(fit_planes(outliers_m, covers), covers.plane, rtol=1e-4, atol=1e-4)
    # A plane across the optical axis, far from the true one, is found as it is.
    np.testing.assert_allclose(fit_planes(np.full_like(exact_m, 0.7), covers), [[0, 0, 1 / 0.7]] * 4, atol=1e-6)
    for left_out, is_found in ((99, True), (101, False)):
        holes_m = exact_m.copy()
        holes_m[:, :left_out] = np.nan
        assert np.isfinite(fit_planes(holes_m, covers)).all() == is_found
    wild = 10 ** rng.uniform(-300, 300, exact_m.shape)
    assert fit_planes(wild, covers).shape == covers.plane.shape  # Without a warning, which is an error.
    monkeypatch.setattr(cover, "PLANE_STEPS", 1)
    assert np.isnan(fit_planes(np.full_like(exact_m, 0.7), covers)).all(), "the only step moves the plane far"
    np.testing.assert_allclose(fit_planes(exact_m, covers), covers.plane, atol=1e-6)


def test_plane_pixels_are_on_the_form_near_the_bar(views: Views) -> None:
    truth, z_m = views[0]
    for pixels, middle_m in zip(truth.covers.pixels, visible_segments(truth).middle_m, strict=True):
        points_m = z_m.ravel()[pixels, None] * pixel_directions()[pixels]
        assert np.linalg.norm(points_m - middle_m, axis=1).max() <= 0.5
        world_m = (points_m - truth.cam_from_world[:3, 3]) @ truth.cam_from_world[:3, :3]
        np.testing.assert_allclose(world_m[:, 2], DECK_Z_M, atol=1e-6)
        steel = np.zeros(z_m.shape, bool)
        steel.ravel()[truth.index[truth.bar_id > 0]] = True
        rows, columns = np.divmod(pixels, z_m.shape[1])
        assert not any(steel[r - 2 : r + 3, c - 2 : c + 3].any() for r, c in zip(rows, columns, strict=True))
        assert len(np.unique(pixels)) > 190


def judged_by(views: Views, *z_m: float, up: float = 1.0) -> list[int]:
    """Return the plane that each bar of the first view is judged by, of planes at heights; -1: none."""
    truth, depth_m = views[0]
    planes = open_planes([{"name": f"p{z}", "point_m": [0, 0, z], "normal": [0, 0, up]} for z in z_m])
    rays = pixel_directions()[:, :2]
    visible = visible_segments(truth)
    segment, plane, _ = judged_covers(depth_m, rays, visible, camera_planes(planes, truth.cam_from_world))
    by_segment = dict(zip(segment.tolist(), plane.tolist(), strict=True))
    return [by_segment.get(one, -1) for one in visible.segment.tolist()]


def open_planes(entries: list[dict[str, Any]]) -> list[FormPlane]:
    return [FormPlane.model_validate(entry) for entry in entries]


def test_bars_are_judged_by_the_nearest_plane_that_is_seen(views: Views, monkeypatch: pytest.MonkeyPatch) -> None:
    deck = DECK_Z_M
    assert judged_by(views, deck) == [0] * 4
    assert judged_by(views, deck - 0.3, deck - 0.0004, deck) == [2] * 4, "the nearest with pixels"
    assert judged_by(views, deck, deck - 0.0004) == [0] * 4, "the nearest in any order"
    assert judged_by(views, deck - 0.3) == [-1] * 4, "no pixel is on it"
    assert judged_by(views, deck, up=-1.0) == [-1] * 4, "the camera is behind it"
    truth, depth_m = views[0]
    visible = visible_segments(truth)
    low = replace(visible, diameter_m=np.array([0.02, 0.02, 0.06001, 0.05999]))  # Covers of 9.995 and 10.005 mm.
    planes = camera_planes(open_planes([DECK]), truth.cam_from_world)
    segment, _, _ = judged_covers(depth_m, pixel_directions()[:, :2], low, planes)
    assert segment.tolist() == visible.segment[[0, 1, 3]].tolist()
    monkeypatch.setattr(cover, "MAX_FROM_BAR_M", 0.1)
    _, _, pixels = judged_covers(depth_m, pixel_directions()[:, :2], visible, planes)
    points_m = depth_m.ravel()[pixels][..., None] * pixel_directions()[pixels]
    assert np.linalg.norm(points_m - visible.middle_m[:, None], axis=2).max() <= 0.1


def test_normal_that_is_no_unit_vector_is_refused(root: Path, tmp_path: Path) -> None:
    manifest = (root / "manifest.json").read_text()
    (tmp_path / "manifest.json").write_text(manifest.replace("[0.0, 0.0, 1.0]", "[0.0, 0.0, 2.0]"))
    with pytest.raises(DatasetError, match=r"planes.*normal.*a vector of length 1"):
        open_folder(tmp_path)


@pytest.fixture(scope="module")
def scored(root: Path, views: Views) -> ScoredResult:
    rng = np.random.default_rng(2)
    path = root.parent / "a.zip"
    with rdb.SubmissionWriter(path, method="noisy") as writer:
        for truth, z_m in views:
            writer.add(truth.view_id, (z_m + rng.normal(0, 0.003, z_m.shape)).astype(np.float32))
    return rdb.score(path, root, extended=True)


def test_measures_are_statistics_of_the_frames(scored: ScoredResult, views: Views) -> None:
    bars, crossings = scored.to_pandas("bars"), scored.to_pandas("crossings")
    assert scored.extended is not None
    numbers = scored.extended.tables[CONFIG].numbers["native"]
    assert numbers["bars_found"].value == bars["found"].mean()
    cover_mm = (bars["cover_mm"] - bars["true_cover_mm"]).dropna()
    assert numbers["cover_bias_mm"].value == pytest.approx(cover_mm.mean())
    assert numbers["cover_std_mm"].value == pytest.approx(cover_mm.std(ddof=0))
    assert numbers["tie_within_2mm"].value == (crossings["tie_error_mm"] <= 2).mean()
    layer_mm = (crossings["layer_mm"] - crossings["true_layer_mm"]).fillna(100).abs().clip(upper=100)
    assert numbers["layer_p95_mm"].value == pytest.approx(STATISTICS["p95"](layer_mm.to_numpy()))
    assert bars["true_deviation_mm"].dtype == float, "undefined in all rows"
    assert set(bars["view_id"]) == set(scored.frames[CONFIG].view_ids)
    assert {measure.name for measure in MEASURES} <= numbers.keys()


def test_evaluate_has_the_same_frames(scored: ScoredResult, root: Path, views: Views) -> None:
    rows = {row["view_id"]: row for row in rdb.load(root, CONFIG)}
    assert scored.archive is not None
    with SubmissionReader(scored.archive, scored.folder.expected_views()) as reader:
        predicted = {view_id: reader.read(view_id) for view_id in rows}
    again = rdb.evaluate(predicted, root, config=CONFIG, extended=True)
    for kind in KINDS:
        assert again.to_pandas(kind).equals(scored.to_pandas(kind))
    with pytest.raises(InputError, match="rows is bars and the result has no extended measures, expected one of"):
        rdb.evaluate(predicted, root, config=CONFIG).to_pandas("bars")


def test_command_writes_the_frames(scored: ScoredResult, root: Path, tmp_path: Path) -> None:
    path = tmp_path / "bars.csv"
    assert main(["score", str(scored.archive), "--data", str(root), "--bars-csv", str(path)]) == 0
    frame = scored.to_pandas("bars")
    rows = list(csv.DictReader(io.StringIO(path.read_text())))
    assert [*rows[0]] == [*frame.columns]
    assert rows[0]["config"] == rows[0]["scene"] == CONFIG
    for head in [head for head in frame if frame[head].dtype == float]:
        assert [float(row[head] or "nan") for row in rows] == pytest.approx(frame[head].tolist(), nan_ok=True)


def test_spacings_join_the_bars_by_segment(scored: ScoredResult) -> None:
    bars, spacings = scored.to_pandas("bars"), scored.to_pandas("spacings")
    for end in "ab":
        keys = {"left_on": ["view_id", f"segment_{end}"], "right_on": ["view_id", "segment"]}
        both = spacings.merge(bars, **keys, validate="many_to_one")
        assert len(both) == len(spacings) > 0
        assert (both["bar_id"] == both[f"bar_{end}"]).all()


def test_configs_without_any_sample_have_empty_frames(scored: ScoredResult) -> None:
    assert scored.extended is not None
    steel, none = scored.extended.frames[CONFIG].native.predicted, np.empty(0, np.int64)
    empty = SteelSamples(steel.bars.of(none), steel.spacings.of(none), steel.crossings.of(none))
    frames = SteelFrames(AlignedSamples(empty, empty, empty), AlignedSamples(empty, empty, empty), 0, 0)
    without = replace(scored, extended=replace(scored.extended, frames={CONFIG: frames}))
    for kind in KINDS:
        frame = without.to_pandas(kind)
        assert len(frame) == 0
        assert [*frame.columns] == [*scored.to_pandas(kind).columns]
