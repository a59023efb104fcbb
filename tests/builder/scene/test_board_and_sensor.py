"""Printed board, whose markers OpenCV finds in their places, and sensor model, against independent formulas."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.board_texture import board_texture
from dataset_builder.scene.variants.sensor import (
    SensorSpec,
    apply_sensor,
    bayer_mosaic,
    demosaic,
    expose,
    illumination,
    linear_from_srgb,
    recorded,
    sensor_spec,
)
from dataset_builder.specs.config_specs import AppearanceSpec, LatticeSpec, SceneSpec
from rebar_depth_bench.geometry.aruco_board import BoardSpec, marker_corners_m

PX_PER_M = 6000.0
FOOTPRINT_M = 0.05
BOARDS = pytest.mark.parametrize("board", [BoardSpec(markers=6), BoardSpec(markers=12)], ids=["6", "12"])

SPEC = SensorSpec()
PLAIN = replace(SPEC, corner_illumination=1.0, jpeg_quality=100, jpeg_subsampling="4:4:4")
"""Noise and demosaicing alone, with the least compression."""


def expected_px(board: BoardSpec, corners_m: Float64[ndarray, "4 3"]) -> Float64[ndarray, "4 2"]:
    """Return world corners in texture pixels: columns along +x, rows along -y, integer pixel centres."""
    edge_m = np.stack([corners_m[:, 0] + board.width_m / 2, board.height_m / 2 - corners_m[:, 1]], axis=1)
    return np.asarray(edge_m * PX_PER_M - 0.5)


@BOARDS
def test_opencv_detects_markers_at_layout_positions(board: BoardSpec) -> None:
    texture = board_texture(board, PX_PER_M)
    assert (texture.shape, texture.dtype) == ((1782, 2520), np.uint8)
    assert (texture == 255).mean() > 0.75
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    detections, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(texture)
    layout = marker_corners_m(board)
    assert sorted(ids.ravel().tolist()) == sorted(layout) == list(range(board.markers))
    for marker_id, detected in zip(ids.ravel().tolist(), detections, strict=True):
        # The detector reports corner pixels, up to half a pixel inside the edge.
        np.testing.assert_allclose(detected[0], expected_px(board, layout[marker_id]), atol=0.6)


@BOARDS
def test_marker_edges_are_exact_to_the_pixel(board: BoardSpec) -> None:
    texture = board_texture(board, PX_PER_M)
    for corners_m in marker_corners_m(board).values():
        left, top = np.round(expected_px(board, corners_m)[0] + 0.5).astype(int)
        side = round(board.marker_side_m * PX_PER_M)
        module = side // 6
        marker = texture[top : top + side, left : left + side]
        frame = np.concatenate([marker[0], marker[-1], marker[:, 0], marker[:, -1]])
        assert (frame == 0).all()
        around = texture[top - module : top + side + module, left - module : left + side + module].copy()
        assert around.shape == (side + 2 * module, side + 2 * module)
        around[module:-module, module:-module] = 255
        assert (around == 255).all()


@BOARDS
def test_markers_are_clear_of_steel(board: BoardSpec) -> None:
    for corners_m in marker_corners_m(board).values():
        assert (corners_m[:, 2] == 0.0).all()
        nearest_m = np.abs(corners_m[:, :2]).min(axis=0) * (np.ptp(np.sign(corners_m[:, :2]), axis=0) == 0)
        assert nearest_m.max() > FOOTPRINT_M + 0.02
        np.testing.assert_allclose(np.linalg.norm(np.diff(corners_m, axis=0), axis=1), board.marker_side_m)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"markers": 7}, "6 or 12"),
        ({"markers": 12, "marker_side_m": 0.084}, "quiet zone"),
    ],
)
def test_invalid_boards_are_rejected(change: dict[str, int], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        board_texture(replace(BoardSpec(), **change), PX_PER_M)  # type: ignore[arg-type]


def flat(level: int | tuple[int, int, int], height: int = 120, width: int = 160) -> np.ndarray:
    return np.full((height, width, 3), level, dtype=np.uint8)


@pytest.mark.parametrize("gain_db", [0.0, 18.0, 36.0])
@pytest.mark.parametrize("signal", [0.01, 0.18, 0.7])
def test_raw_noise_has_variance_of_linear_camera_model(gain_db: float, signal: float) -> None:
    spec = replace(SPEC, gain_db=gain_db)
    raw_dn = expose(np.full((500, 500), signal), spec, np.random.default_rng(1)).astype(float)
    # K in numbers per electron, from the definition: white is at the saturation capacity over the gain.
    k = (4095 - 256) * 10 ** (gain_db / 20) / 10_700
    mean_dn = 256 + (4095 - 256) * signal
    variance = k * (mean_dn - 256) + (k * spec.read_noise_e) ** 2 + 1 / 12
    assert raw_dn.mean() == pytest.approx(mean_dn, abs=5 * np.sqrt(variance / raw_dn.size))
    assert raw_dn.var() == pytest.approx(variance, rel=0.015)


def test_parameters_follow_from_cited_data_sheet() -> None:
    assert pytest.approx(10 ** (40.3 / 10), rel=0.005) == SPEC.saturation_e
    quantisation_e = SPEC.saturation_e / (4095 - 256) / np.sqrt(12)
    threshold_e = np.sqrt(SPEC.read_noise_e**2 + quantisation_e**2 + 0.25) + 0.5
    assert 20 * np.log10(SPEC.saturation_e / threshold_e) == pytest.approx(71.2, abs=0.2)


def test_black_and_white_stay_in_range() -> None:
    random = np.random.default_rng(0)
    assert expose(np.ones((40, 40)), SPEC, random).max() == 4095
    black_dn = expose(np.zeros((200, 200)), SPEC, random).astype(float)
    assert black_dn.mean() == pytest.approx(256, abs=0.3), "noise below black is kept"
    assert apply_sensor(flat(0), SPEC, 0).max() < 40
    assert apply_sensor(flat(255), PLAIN, 0).min() > 215


def test_mean_of_grey_is_preserved_in_linear_light() -> None:
    for level in (40, 118, 200):
        mean = linear_from_srgb(apply_sensor(flat(level), PLAIN, 3)).mean(axis=(0, 1))
        assert mean == pytest.approx(linear_from_srgb(flat(level))[0, 0], rel=0.01)


@pytest.mark.parametrize("colour", [(118, 118, 118), (200, 60, 30), (20, 90, 220)])
def test_demosaicing_restores_flat_colour_up_to_the_border(colour: tuple[int, int, int]) -> None:
    signal = linear_from_srgb(flat(colour, 17, 22))
    noiseless_dn = np.rint(256 + 3839 * bayer_mosaic(signal)).astype(np.uint16)
    assert np.abs(demosaic(noiseless_dn, SPEC) - signal).max() < 1 / 3839


def test_vignetting_is_cos4_of_effective_field_angle() -> None:
    ratio = illumination(360, 640, SPEC)
    assert ratio[[0, 0, -1, -1], [0, -1, 0, -1]] == pytest.approx(0.6)
    assert 1.0 - ratio[179:181, 319:321] == pytest.approx(0.0, abs=1e-5)
    corner_rad = np.arccos(0.6**0.25)
    half_diagonal_px = np.hypot(359, 639) / 2
    for v, u in ((100, 80), (359, 320), (7, 600)):
        angle_rad = np.arctan(np.hypot(v - 179.5, u - 319.5) / half_diagonal_px * np.tan(corner_rad))
        assert ratio[v, u] == pytest.approx(np.cos(angle_rad) ** 4)


def test_picture_darkens_by_the_vignetting() -> None:
    rgb = apply_sensor(flat(160, 360, 640), SPEC, 2)
    signal, expected = (
        linear_from_srgb(rgb),
        linear_from_srgb(flat(160))[0, 0] * illumination(360, 640, SPEC)[40, 60],
    )
    assert signal[30:51, 50:71].mean(axis=(0, 1)) == pytest.approx(expected, rel=0.03)


def test_seed_determines_bytes_and_views_differ() -> None:
    first, again, other = (apply_sensor(flat(90), SPEC, seed) for seed in (7, 7, 8))
    assert (first == again).all()
    assert (first != other).mean() > 0.3


def test_jpeg_of_lower_quality_differs_more() -> None:
    random = np.random.default_rng(0)
    rgb = random.integers(0, 255, (64, 64, 3), dtype=np.uint8)
    plain, high, low = (
        apply_sensor(rgb, replace(PLAIN, jpeg_quality=quality), 1).astype(float) for quality in (100, 90, 30)
    )
    assert 0 < np.abs(high - plain).mean() < np.abs(low - plain).mean()


def test_pictures_of_other_scenes_are_unchanged() -> None:
    scene = SceneSpec("s", LatticeSpec(), None)
    rgb = flat(100)
    assert sensor_spec(scene) is None
    assert recorded(rgb, scene, 1) is rgb
    with_sensor = replace(scene, appearance=AppearanceSpec(("dusk", "sensor")))
    assert sensor_spec(with_sensor) == SensorSpec()
    assert (recorded(rgb, with_sensor, 1) == apply_sensor(rgb, SensorSpec(), 1)).all()
