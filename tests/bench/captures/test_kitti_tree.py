"""KITTI's raw data as views: rectified images of a list by day and side, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rebar_depth_bench.captures.kitti import is_kitti, open_kitti
from rebar_depth_bench.captures.kitti_calibration import read_pair
from rebar_depth_bench.captures.kitti_images import KittiImage, eigen_test_images, read_images
from rebar_depth_bench.captures.opening import open_images

from rebar_depth_bench.errors import DatasetError, InputError
from tests.bench.studies import kitti_folder as kitti

LEFT = eigen_test_images()
RIGHT = replace(LEFT[0], side="r")
SIZE = (kitti.WIDTH, kitti.HEIGHT)


def write_image(
    root: Path, image: KittiImage, camera: int, *, size: tuple[int, int] = (kitti.WIDTH, kitti.HEIGHT)
) -> None:
    kitti.write_day(root / image.date)
    folder = root / image.date / image.drive / f"image_{camera:02d}" / "data"
    folder.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(camera).integers(0, 255, (size[1], size[0], 3), np.uint8)
    Image.fromarray(pixels).save(folder / f"{image.frame}.png")


def test_pairs_and_right_images_are_views_of_their_day(tmp_path: Path) -> None:
    images = (LEFT[0], LEFT[1], RIGHT)
    for image in images:
        write_image(tmp_path, image, 2)
        write_image(tmp_path, image, 3)
    assert is_kitti(tmp_path)
    by_config = {views.config: views for views in open_kitti(tmp_path, images)}
    assert set(by_config) == {f"kitti-{image.date}-{image.side}" for image in images}
    left = by_config[f"kitti-{LEFT[0].date}-l"]
    row = next(left.rows("left_rgb", "right_rgb", "left_K", "baseline_m"))
    assert row["view_id"] == f"kitti/{LEFT[0].drive}_{LEFT[0].frame}_l"
    assert row["baseline_m"] == pytest.approx((kitti.PX + 33.95242) / kitti.FX)
    assert row["left_K"].tolist() == [[kitti.FX, 0, kitti.CX], [0, kitti.FX, kitti.CY], [0, 0, 1]]
    assert not np.array_equal(row["left_rgb"], row["right_rgb"])
    right = by_config[f"kitti-{RIGHT.date}-r"]
    assert not right.right
    [shown] = right.rows("left_rgb")
    expected = np.asarray(Image.open(right.left[shown["view_id"]]))
    assert "image_03" in str(right.left[shown["view_id"]])
    assert np.array_equal(shown["left_rgb"], expected)


def test_without_right_images_these_are_images_of_one_camera(tmp_path: Path) -> None:
    write_image(tmp_path, LEFT[0], 2)
    [views] = open_kitti(tmp_path, eigen_test_images())
    with pytest.raises(InputError, match="sgbm needs right_rgb"):
        views.check_columns(("left_rgb", "right_rgb"), "sgbm")


def test_tree_without_images_of_the_list_is_refused(tmp_path: Path) -> None:
    kitti.write_day(tmp_path / LEFT[0].date)
    with pytest.raises(DatasetError, match=r"none of the 697 images of the list, expected for example .*\.png"):
        open_kitti(tmp_path, eigen_test_images())


def test_images_that_do_not_fit_the_calibration_are_refused(tmp_path: Path) -> None:
    write_image(tmp_path, LEFT[0], 2, size=(kitti.WIDTH, kitti.HEIGHT + 2))
    with pytest.raises(DatasetError) as caught:
        open_kitti(tmp_path, eigen_test_images())
    [problem] = caught.value.problems
    assert problem.code == "conflict"
    assert "calib_cam_to_cam.txt" in problem.expected


@pytest.mark.parametrize(
    ("old", "new", "where", "line"),
    [
        ("P_rect_03: 7.215377e+01", "P_rect_03: -7.2e+01", "P_rect_03", 8),
        ("-3.395242e+01", "3.395242e+02", "P_rect_03", 8),
        ("S_rect_03: 1.24", "S_rect_03: 1.25", "S_rect_03", 7),
        ("P_rect_02:", "P_rect_12:", "P_rect_02", None),
    ],
)
def test_invalid_pair_is_refused_with_its_line(
    old: str, new: str, where: str, line: int | None, tmp_path: Path
) -> None:
    text = kitti.CAM_TO_CAM
    assert old in text
    kitti.write_day(tmp_path, text.replace(old, new))
    with pytest.raises(DatasetError, match=r"calib_cam_to_cam\.txt") as caught:
        read_pair(tmp_path)
    problem = caught.value.problems[0]
    assert problem.where == where
    assert problem.found.startswith(f"line {line}: ") == (line is not None)


@pytest.mark.parametrize(
    "text",
    [
        "2011_09_26/2011_09_27_drive_0002_sync 0000000069 l\n",
        "2011_09_26/2011_09_26_drive_0002_sync 69 l\n",
        "2011_09_26/2011_09_26_drive_0002_sync 0000000069 x\n",
        "../2011_09_26_drive_0002_sync 0000000069 l\n",
        2 * "2011_09_26/2011_09_26_drive_0002_sync 0000000069 l\n",
        "",
        "\0",
    ],
)
def test_invalid_list_of_images_is_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "images.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=r"images\.txt"):
        read_images(path)


def test_list_is_for_kitti_only(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="raw data only"):
        open_images(tmp_path, tmp_path / "images.txt")
