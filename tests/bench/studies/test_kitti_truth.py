"""KITTI ground truth: the test split, the projection of LiDAR scans and damaged files."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rebar_depth_bench.captures.kitti_calibration import KittiCamera, read_camera
from rebar_depth_bench.captures.kitti_images import eigen_test_images, parse_images
from rebar_depth_bench.studies.kitti.ground_truth import (
    find_truth,
    project_scan,
    read_scan,
    read_truth,
)

from rebar_depth_bench.errors import DatasetError, InputError
from tests.bench.studies import kitti_folder as kitti


def test_split_is_the_published_eigen_split() -> None:
    images = eigen_test_images()
    assert len(images) == 697
    assert len({image.name for image in images}) == 697
    drives = Counter(image.drive for image in images)
    assert len(drives) == 28
    assert drives.pop("2011_09_26_drive_0048_sync") == 22
    assert set(drives.values()) == {25}
    assert images[0].name == "2011_09_26_drive_0002_sync_0000000000_l"
    assert list(images) == sorted(images)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("2011_09_26/2011_09_28_drive_0002_sync 0000000069 l", "line 1: the line is 2011_09_26/2011_09_28"),
        ("2011_09_26/2011_09_26_drive_0002_sync 69 l", "expected <date>/<drive> <frame>"),
        ("2011_09_26/2011_09_26_drive_0002_sync 0000000069 l\n" * 2, "line 2: .* is listed twice"),
    ],
)
def test_bad_split_list_names_line(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        parse_images("list.txt", text.encode())


def test_scan_projection_matches_plain_python(tmp_path: Path) -> None:
    kitti.write_day(tmp_path)
    scan = kitti.random_scan(7)
    camera = read_camera(tmp_path, 2)
    planar, forward = (project_scan(scan, camera, kind) for kind in ("camera", "velodyne"))
    expected = kitti.project_reference(scan)
    assert len(expected) > 500
    assert set(zip(*(axis.tolist() for axis in np.nonzero(planar)), strict=True)) == set(expected)
    for (row, column), (z_m, x_m) in expected.items():
        assert planar[row, column] == pytest.approx(z_m, abs=1e-4)  # The calibration text has seven digits.
        assert forward[row, column] == pytest.approx(x_m, abs=1e-4)
    shift_m = np.median((forward - planar)[planar > 0])
    assert 0.2 < shift_m < 0.35


def test_any_bits_are_accepted_as_reflectance(tmp_path: Path) -> None:
    kitti.write_day(tmp_path)
    scan, bits = (kitti.random_scan(7).view("<u4").copy() for _ in range(2))
    bits[:, 3] = 0x7F800001  # A signalling NaN.
    first, other = (project_scan(values.view("<f4"), read_camera(tmp_path, 2)) for values in (scan, bits))
    assert np.array_equal(first, other)


def test_nearest_lidar_point_wins() -> None:
    # Scanner and camera axes coincide: a point (x, y, z) falls into column round(3 x/z) - 1, row round(3 y/z) - 1.
    straight = np.array([[3.0, 0, 0, 0], [0, 3.0, 0, 0], [0, 0, 1.0, 0]])
    camera = KittiCamera(4, 2, straight)
    scan = np.array(
        [[8, 4, 6, 0], [4, 2, 3, 0], [12, 6, 9, 0], [2, 1, 3, 0], [1, 1, 90, 0], [5, 3.5, 3, 0], [1, 1, -3, 0]],
        "<f4",
    )
    # 3 * 4/3 = 4 -> column 3; 3 * 2/3 = 2 -> row 1: depths 6, 3 and 9. Then (2, 1, 3): column 1, row 0, depth 3.
    # (1, 1, 90) rounds to -1, (5, 3.5, 3) to column 4 of 4: outside; the last is behind the camera.
    assert project_scan(scan, camera).tolist() == [[0, 3, 0, 0], [0, 0, 0, 3]]
    # With velodyne depth, the value is the point's x: 2 of (2, 1, 3) and 4 of (4, 2, 3).
    assert project_scan(scan, camera, "velodyne").tolist() == [[0, 2, 0, 0], [0, 0, 0, 4]]


def test_pixel_halves_round_to_even() -> None:
    straight = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0]])
    scan = np.array([[1.5, 1, 1, 0], [2.5, 2, 1, 0]], "<f4")
    assert project_scan(scan, KittiCamera(3, 2, straight)).tolist() == [[0, 1, 0], [0, 1, 0]]


def test_right_camera_has_own_projection(tmp_path: Path) -> None:
    kitti.write_day(tmp_path)
    left, right = (read_camera(tmp_path, number) for number in (2, 3))
    assert not np.array_equal(left.image_from_velo, right.image_from_velo)


def test_images_without_ground_truth_are_named(tmp_path: Path) -> None:
    images = kitti.first_images(3)
    kitti.write_raw(tmp_path, images[:2])
    files, missing = find_truth(tmp_path, images, "raw")
    assert [file.image for file in files] == list(images[:2])
    assert missing == [images[2].name]
    assert files[0].shape == (kitti.HEIGHT, kitti.WIDTH)


@pytest.mark.parametrize("part", [".", "train", "val", "data_depth_annotated/train", "data_depth_annotated/val"])
def test_improved_maps_are_found_in_every_known_layout(part: str, tmp_path: Path) -> None:
    (image,) = kitti.first_images(1)
    depth_m = np.arange(12).reshape(3, 4) / 2.0
    kitti.write_improved(kitti.improved_path(tmp_path, image, part), depth_m)
    files, missing = find_truth(tmp_path, (image,), "improved")
    assert not missing
    assert files[0].shape == (3, 4)
    assert np.array_equal(read_truth(files[0]), depth_m.astype(np.float32))


Damage = Callable[[Path], None]


def truncate_scan(root: Path) -> None:
    path = kitti.scan_path(root, kitti.first_images(1)[0])
    path.write_bytes(path.read_bytes()[:-5])


def empty_scan(root: Path) -> None:
    kitti.scan_path(root, kitti.first_images(1)[0]).write_bytes(b"")


def nan_scan(root: Path) -> None:
    kitti.scan_path(root, kitti.first_images(1)[0]).write_bytes(np.full(4, np.nan, "<f4").tobytes())


def far_scan(root: Path) -> None:
    points = np.array([[1e4, 0, 0, 0], [-1, 2, 3, np.nan], [3e38, 0, 0, 0]], "<f4")
    kitti.scan_path(root, kitti.first_images(1)[0]).write_bytes(points.tobytes())


def remove_projection(root: Path) -> None:
    kitti.write_day(root / "2011_09_26", kitti.CAM_TO_CAM.replace("P_rect_02", "P_rect_99"))


def add_nan_to_translation(root: Path) -> None:
    kitti.write_day(root / "2011_09_26", velo_to_cam=kitti.VELO_TO_CAM.replace("T: ", "T: nan "))


def shorten_rotation(root: Path) -> None:
    kitti.write_day(root / "2011_09_26", velo_to_cam="R: 1 2 3\nT: 0 0 0\n")


def delete_calibration(root: Path) -> None:
    (root / "2011_09_26" / "calib_velo_to_cam.txt").unlink()


def enlarge_image_size(root: Path) -> None:
    kitti.write_day(root / "2011_09_26", kitti.CAM_TO_CAM.replace("S_rect_02: 1.24", "S_rect_02: 9.e9 #1.24"))


def replace_text(name: str, old: str, new: str) -> Damage:
    def change(root: Path) -> None:
        path = root / "2011_09_26" / f"calib_{name}.txt"
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new, 1))

    return change


def make_scan_a_pipe(root: Path) -> None:
    path = kitti.scan_path(root, kitti.first_images(1)[0])
    path.unlink()
    os.mkfifo(path)


@pytest.mark.parametrize(
    ("damage", "file", "location"),
    [
        (truncate_scan, "0000000000.bin", "size "),
        (empty_scan, "0000000000.bin", "size "),
        (nan_scan, "0000000000.bin", "invalid point 1"),
        (far_scan, "0000000000.bin", "invalid point 3"),
        (make_scan_a_pipe, "0000000000.bin", "unreadable "),
        (remove_projection, "calib_cam_to_cam.txt", "missing P_rect_02"),
        (add_nan_to_translation, "calib_velo_to_cam.txt", "invalid T"),
        (shorten_rotation, "calib_velo_to_cam.txt", "invalid R"),
        (delete_calibration, "calib_velo_to_cam.txt", "missing "),
        (enlarge_image_size, "calib_cam_to_cam.txt", "invalid S_rect_02"),
        (
            replace_text("cam_to_cam", "S_rect_02: 1.24", "S_rect_02: 1.245"),
            "calib_cam_to_cam.txt",
            "invalid S_rect_02",
        ),
        (replace_text("cam_to_cam", "S_rect_02: 1", "S_rect_02: -1"), "calib_cam_to_cam.txt", "invalid S_rect_02"),
        (replace_text("cam_to_cam", "9.999239e-01", "9.989239e-01"), "calib_cam_to_cam.txt", "invalid R_rect_00"),
        (replace_text("cam_to_cam", "R_rect_00: ", "R_rect_00: -"), "calib_cam_to_cam.txt", "invalid R_rect_00"),
        (replace_text("cam_to_cam", " 0 0 1 ", " 0 0 0 "), "calib_cam_to_cam.txt", "invalid P_rect_02"),
        (replace_text("cam_to_cam", "P_rect_02: ", "P_rect_02: -"), "calib_cam_to_cam.txt", "invalid P_rect_02"),
        (replace_text("cam_to_cam", "S_rect_03", "S_rect_02"), "calib_cam_to_cam.txt", "duplicate S_rect_02"),
        (replace_text("velo_to_cam", "R: ", "R: 1 0 0 0 1 0 0 0 1\nR: "), "calib_velo_to_cam.txt", "duplicate R"),
        (replace_text("velo_to_cam", "R: ", "R: 1"), "calib_velo_to_cam.txt", "invalid R"),
        (replace_text("velo_to_cam", "T: ", "T: 1e300 "), "calib_velo_to_cam.txt", "invalid T"),
        (replace_text("velo_to_cam", "T: -4.06", "T: -4_06"), "calib_velo_to_cam.txt", "invalid T"),
        (replace_text("velo_to_cam", "T: ", f"T: {'9' * 5000} "), "calib_velo_to_cam.txt", "invalid T"),
        (replace_text("velo_to_cam", "R: ", "R: \x1b[2J"), "calib_velo_to_cam.txt", "invalid R"),
        (replace_text("velo_to_cam", "calib_time", "x" * (1 << 20)), "calib_velo_to_cam.txt", "size "),
    ],
)
def test_damaged_raw_data_raises(damage: Damage, file: str, location: str, tmp_path: Path) -> None:
    images = kitti.first_images(1)
    kitti.write_raw(tmp_path, images)
    damage(tmp_path)
    with pytest.raises(DatasetError, match=re.escape(file)) as caught:
        read_truth(find_truth(tmp_path, images, "raw")[0][0])
    assert [f"{problem.code} {problem.where}" for problem in caught.value.problems] == [location]
    assert all(str(problem).isprintable() and len(str(problem)) < 300 for problem in caught.value.problems)


KITTI_ROTATIONS = [
    "9.999239e-01 9.837760e-03 -7.445048e-03 -9.869795e-03 9.999421e-01 "
    "-4.278459e-03 7.402527e-03 4.351614e-03 9.999631e-01",
    "9.999128e-01 1.009263e-02 -8.511932e-03 -1.012729e-02 9.999406e-01 "
    "-4.037671e-03 8.470675e-03 4.123522e-03 9.999556e-01",
    "9.999478e-01 9.791707e-03 -2.925305e-03 -9.806939e-03 9.999382e-01 "
    "-5.238719e-03 2.873828e-03 5.267134e-03 9.999820e-01",
    "9.999280e-01 8.085985e-03 -8.866797e-03 -8.123205e-03 9.999583e-01 "
    "-4.169750e-03 8.832711e-03 4.241477e-03 9.999520e-01",
    "9.999454e-01 7.259129e-03 -7.519551e-03 -7.292213e-03 9.999638e-01 "
    "-4.381729e-03 7.487471e-03 4.436324e-03 9.999621e-01",
]


def test_rotations_of_all_recording_days_are_accepted(tmp_path: Path) -> None:
    for text in KITTI_ROTATIONS:
        rounded = " ".join(f"{float(value):.5e}" for value in text.split())
        for rotation in (text, rounded):
            lines = [line for line in kitti.CAM_TO_CAM.splitlines() if not line.startswith("R_rect_00")]
            kitti.write_day(tmp_path, "\n".join([*lines, f"R_rect_00: {rotation}"]))
            assert read_camera(tmp_path, 2).width == kitti.WIDTH


@pytest.mark.parametrize(
    ("picture", "words"),
    [
        (np.zeros((3, 4), np.uint8), "8-bit greyscale, expected 16-bit greyscale"),
        (np.zeros((3, 4, 3), np.uint8), "8-bit RGB, expected 16-bit greyscale"),
    ],
)
def test_depth_map_of_wrong_png_type_raises(picture: np.ndarray, words: str, tmp_path: Path) -> None:
    images = kitti.first_images(1)
    path = kitti.improved_path(tmp_path, images[0])
    path.parent.mkdir(parents=True)
    Image.fromarray(picture).save(path)
    with pytest.raises(DatasetError, match=words):
        read_truth(find_truth(tmp_path, images, "improved")[0][0])


def test_depth_map_that_is_not_png_raises(tmp_path: Path) -> None:
    images = kitti.first_images(1)
    path = kitti.improved_path(tmp_path, images[0])
    path.parent.mkdir(parents=True)
    path.write_bytes(b"no picture")
    with pytest.raises(DatasetError, match=r"\.png: 1 problem\n  - is not a readable image, expected a PNG"):
        find_truth(tmp_path, images, "improved")


def test_truncated_depth_map_raises(tmp_path: Path) -> None:
    images = kitti.first_images(1)
    path = kitti.improved_path(tmp_path, images[0])
    kitti.write_improved(path, np.random.default_rng(0).uniform(0, 80, (30, 40)))
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(DatasetError, match="truncated"):
        read_truth(find_truth(tmp_path, images, "improved")[0][0])


def test_folder_without_ground_truth_names_expected_file(tmp_path: Path) -> None:
    images = kitti.first_images(1)
    with pytest.raises(DatasetError, match=r"has no raw ground truth.*velodyne_points/data/0000000000\.bin"):
        find_truth(tmp_path, images, "raw")
    with pytest.raises(DatasetError, match="no such folder"):
        find_truth(tmp_path / "nowhere", images, "improved")


def test_scan_has_four_floats_per_point(tmp_path: Path) -> None:
    path = tmp_path / "scan.bin"
    path.write_bytes(np.arange(8, dtype="<f4").tobytes())
    assert read_scan(path).tolist() == [[0, 1, 2, 3], [4, 5, 6, 7]]
