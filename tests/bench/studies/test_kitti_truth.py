"""KITTI's ground truth: the split, the projection of a scan against plain Python, and files that are damaged."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rebar_depth_bench.errors import DatasetError, RebarDepthError
from rebar_depth_bench.studies.kitti.ground_truth import (
    KittiCamera,
    find_truth,
    project_scan,
    read_camera,
    read_scan,
    read_truth,
)
from rebar_depth_bench.studies.kitti.metrics import eigen_test_images, read_split
from tests.bench.studies import kitti_folder as kitti


def test_the_split_is_the_published_one() -> None:
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
        ("2011_09_26/2011_09_28_drive_0002_sync 0000000069 l", "line 1 is '2011_09_26/2011_09_28"),
        ("2011_09_26/2011_09_26_drive_0002_sync 69 l", "expected <date>/<drive> <frame>"),
        ("2011_09_26/2011_09_26_drive_0002_sync 0000000069 l\n" * 2, "line 2: .* stands twice"),
    ],
)
def test_a_bad_split_list_names_the_line(text: str, words: str) -> None:
    with pytest.raises(RebarDepthError, match=words):
        read_split(text)


def test_a_scan_falls_where_plain_python_puts_it(tmp_path: Path) -> None:
    kitti.write_day(tmp_path)
    scan = kitti.some_points(7)
    camera = read_camera(tmp_path, 2)
    planar, forward = (project_scan(scan, camera, kind) for kind in ("camera", "velodyne"))
    expected = kitti.projected_by_hand(scan)
    assert len(expected) > 500
    assert set(zip(*(axis.tolist() for axis in np.nonzero(planar)), strict=True)) == set(expected)
    for (row, column), (z_m, x_m) in expected.items():
        assert planar[row, column] == pytest.approx(z_m, abs=1e-4)  # the text's seven digits
        assert forward[row, column] == pytest.approx(x_m, abs=1e-4)
    shift_m = np.median((forward - planar)[planar > 0])
    assert 0.2 < shift_m < 0.35


def test_of_two_points_in_a_pixel_the_nearest_wins_and_pixels_count_from_one() -> None:
    # u = 3 x/z, v = 3 y/z with the scanner's axes as the camera's: (x, y, z) seen at round(3x/z) - 1.
    straight = np.array([[3.0, 0, 0, 0], [0, 3.0, 0, 0], [0, 0, 1.0, 0]])
    camera = KittiCamera(4, 2, straight)
    scan = np.array(
        [[8, 4, 6, 0], [4, 2, 3, 0], [12, 6, 9, 0], [2, 1, 3, 0], [1, 1, 90, 0], [5, 3.5, 3, 0], [1, 1, -3, 0]],
        "<f4",
    )
    # 3 * 4/3 = 4 -> column 3; 3 * 2/3 = 2 -> row 1: depths 6, 3 and 9. Then (2, 1, 3): column 1, row 0, depth 3.
    # (1, 1, 90) rounds to -1, (5, 3.5, 3) to column 4 of 4: outside; the last is behind the camera.
    assert project_scan(scan, camera).tolist() == [[0, 3, 0, 0], [0, 0, 0, 3]]
    # The point's own x decides where its x is the depth: 2 of (2, 1, 3), 4 of (4, 2, 3).
    assert project_scan(scan, camera, "velodyne").tolist() == [[0, 2, 0, 0], [0, 0, 0, 4]]


def test_halves_round_to_even() -> None:
    straight = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0]])
    scan = np.array([[1.5, 1, 1, 0], [2.5, 2, 1, 0]], "<f4")
    assert project_scan(scan, KittiCamera(3, 2, straight)).tolist() == [[0, 1, 0], [0, 1, 0]]


def test_the_right_camera_has_its_own_projection(tmp_path: Path) -> None:
    kitti.write_day(tmp_path)
    left, right = (read_camera(tmp_path, number) for number in (2, 3))
    assert not np.array_equal(left.image_from_velo, right.image_from_velo)


def test_images_without_ground_truth_are_named(tmp_path: Path) -> None:
    images = kitti.some_images(3)
    kitti.write_raw(tmp_path, images[:2])
    found, missing = find_truth(tmp_path, images, "raw")
    assert [one.image for one in found] == list(images[:2])
    assert missing == [images[2].name]
    assert found[0].shape == (kitti.HEIGHT, kitti.WIDTH)


@pytest.mark.parametrize("part", [".", "train", "val", "data_depth_annotated/train", "data_depth_annotated/val"])
def test_improved_maps_are_found_wherever_kitti_was_unpacked(part: str, tmp_path: Path) -> None:
    (image,) = kitti.some_images(1)
    depth_m = np.arange(12).reshape(3, 4) / 2.0
    kitti.write_improved(kitti.improved_path(tmp_path, image, part), depth_m)
    found, missing = find_truth(tmp_path, (image,), "improved")
    assert not missing
    assert found[0].shape == (3, 4)
    assert np.array_equal(read_truth(found[0]), depth_m.astype(np.float32))


def damage_scan(root: Path) -> None:
    path = kitti.scan_path(root, kitti.some_images(1)[0])
    path.write_bytes(path.read_bytes()[:-5])


def empty_scan(root: Path) -> None:
    kitti.scan_path(root, kitti.some_images(1)[0]).write_bytes(b"")


def nan_scan(root: Path) -> None:
    kitti.scan_path(root, kitti.some_images(1)[0]).write_bytes(np.full(4, np.nan, "<f4").tobytes())


def without_key(root: Path) -> None:
    kitti.write_day(root / "2011_09_26", kitti.CAM_TO_CAM.replace("P_rect_02", "P_rect_99"))


def with_words(root: Path) -> None:
    kitti.write_day(root / "2011_09_26", velo_to_cam=kitti.VELO_TO_CAM.replace("T: ", "T: nan "))


def short_rotation(root: Path) -> None:
    kitti.write_day(root / "2011_09_26", velo_to_cam="R: 1 2 3\nT: 0 0 0\n")


def without_calibration(root: Path) -> None:
    (root / "2011_09_26" / "calib_velo_to_cam.txt").unlink()


def absurd_size(root: Path) -> None:
    kitti.write_day(root / "2011_09_26", kitti.CAM_TO_CAM.replace("S_rect_02: 1.24", "S_rect_02: 9.e9 #1.24"))


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (damage_scan, r"0000000000.bin: has 63995 bytes, expected a multiple of 16"),
        (empty_scan, r"has 0 bytes"),
        (nan_scan, r"holds a coordinate that is not finite"),
        (without_key, r"calib_cam_to_cam.txt: has no P_rect_02, expected 12 numbers"),
        (with_words, r"calib_velo_to_cam.txt: T is 'nan -4.069766e-03 .*', expected 3 finite numbers"),
        (short_rotation, r"R is '1 2 3', expected 9 finite numbers"),
        (without_calibration, r"calib_velo_to_cam.txt: cannot be read: No such file"),
        (absurd_size, r"S_rect_02 is '9.e9 #.*', expected 2 finite numbers"),
    ],
)
def test_damaged_raw_data_is_refused_in_words(damage: object, words: str, tmp_path: Path) -> None:
    images = kitti.some_images(1)
    kitti.write_raw(tmp_path, images)
    assert callable(damage)
    damage(tmp_path)
    with pytest.raises(DatasetError, match=words):
        read_truth(find_truth(tmp_path, images, "raw")[0][0])


@pytest.mark.parametrize(
    ("picture", "words"),
    [
        (np.zeros((3, 4), np.uint8), "8-bit greyscale, expected 16-bit greyscale"),
        (np.zeros((3, 4, 3), np.uint8), "8-bit RGB, expected 16-bit greyscale"),
    ],
)
def test_a_depth_map_of_another_kind_is_refused(picture: np.ndarray, words: str, tmp_path: Path) -> None:
    images = kitti.some_images(1)
    path = kitti.improved_path(tmp_path, images[0])
    path.parent.mkdir(parents=True)
    Image.fromarray(picture).save(path)
    with pytest.raises(DatasetError, match=words):
        read_truth(find_truth(tmp_path, images, "improved")[0][0])


def test_a_depth_map_that_is_no_png_is_refused(tmp_path: Path) -> None:
    images = kitti.some_images(1)
    path = kitti.improved_path(tmp_path, images[0])
    path.parent.mkdir(parents=True)
    path.write_bytes(b"no picture")
    with pytest.raises(DatasetError, match=r"\.png: says 0 x 0 pixels, expected a PNG"):
        find_truth(tmp_path, images, "improved")


def test_a_truncated_depth_map_is_refused(tmp_path: Path) -> None:
    images = kitti.some_images(1)
    path = kitti.improved_path(tmp_path, images[0])
    kitti.write_improved(path, np.random.default_rng(0).uniform(0, 80, (30, 40)))
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(DatasetError, match="truncated"):
        read_truth(find_truth(tmp_path, images, "improved")[0][0])


def test_a_folder_without_any_ground_truth_says_what_was_expected(tmp_path: Path) -> None:
    images = kitti.some_images(1)
    with pytest.raises(DatasetError, match=r"raw ground truth of no image.*velodyne_points/data/0000000000\.bin"):
        find_truth(tmp_path, images, "raw")
    with pytest.raises(DatasetError, match="no such folder"):
        find_truth(tmp_path / "nowhere", images, "improved")


def test_a_scan_is_four_floats_a_point(tmp_path: Path) -> None:
    path = tmp_path / "scan.bin"
    path.write_bytes(np.arange(8, dtype="<f4").tobytes())
    assert read_scan(path).tolist() == [[0, 1, 2, 3], [4, 5, 6, 7]]
