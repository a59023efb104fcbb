"""KITTI check on a small folder: the list, projection of scans, metrics, methods, known scales and bad input."""

from __future__ import annotations

import json
import math
from argparse import Namespace
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image as Picture

import kitti

pytest.importorskip("cv2")

from rebar_depth_bench import SubmissionWriter
from tests.examples import scripts as folder_of
from tests.examples.scripts import refusal, repeated_files, result_of

COUNT = 96
FACTORS = np.linspace(0.4, 1.6, COUNT)
NOISE = 0.08
Depths = dict[str, NDArray[Any]]


def truth_of(root: Path, image: folder_of.Image, lidar_depth: str = "camera") -> NDArray[Any]:
    view = SimpleNamespace(**vars(image), truth=folder_of.scan_path(root, image))
    return kitti.read_truth(view, root, lidar_depth)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the raw data of the first images of the split and return the folder."""
    folder = tmp_path_factory.mktemp("kitti")
    folder_of.write_raw(folder, folder_of.first_images(COUNT))
    return folder


@pytest.fixture(scope="module")
def truths(root: Path) -> Depths:
    """Return the raw ground truth in metres by image name."""
    return {image.name: truth_of(root, image) for image in folder_of.first_images(COUNT)}


def predictions(truths: Depths, noise: float = 0.0) -> Depths:
    """Return ground truth divided by each image's factor, with multiplicative noise; 7 m outside ground truth."""
    rng = np.random.default_rng(5)
    return {
        name: np.where(z_m > 0, z_m / factor * np.exp(noise * rng.standard_normal(z_m.shape)), 7.0).astype(
            np.float32
        )
        for (name, z_m), factor in zip(truths.items(), FACTORS, strict=True)
    }


def write_npy(folder: Path, depths: Depths) -> Path:
    folder.mkdir()
    for name, depth_m in depths.items():
        np.save(folder / f"{name}.npy", depth_m)
    return folder


def check(out: Path, predictions: Path, root: Path, *options: str | Path) -> dict[str, Any]:
    arguments = ("--predictions", predictions, "--kitti", root, "--ground-truth", "raw", *options)
    return result_of(kitti, out, *arguments)


def scored_mask(z_m: NDArray[Any], cap_m: float = 80.0) -> NDArray[np.bool_]:
    """Return the pixels inside the crop of Garg et al. with ground truth from 1 mm to the cap."""
    height, width = z_m.shape
    mask = np.zeros(z_m.shape, bool)
    rows = slice(int(0.40810811 * height), int(0.99189189 * height))
    mask[rows, int(0.03594771 * width) : int(0.96405229 * width)] = True
    return np.asarray(mask & (z_m > 1e-3) & (z_m < cap_m))


def test_list_is_the_published_eigen_split() -> None:
    images = kitti.read_images(kitti.EIGEN_SPLIT)
    assert len(images) == images.index.nunique() == 697
    drives = Counter(images["drive"])
    assert len(drives) == 28
    assert drives.pop("2011_09_26_drive_0048_sync") == 22
    assert set(drives.values()) == {25}
    assert images.index[0] == "2011_09_26_drive_0002_sync_0000000000_l"
    assert list(images.index) == sorted(images.index)


def test_scan_projection_matches_plain_python(tmp_path: Path) -> None:
    [image] = folder_of.first_images(1)
    folder_of.write_raw(tmp_path, (image,))
    planar, forward = (truth_of(tmp_path, image, depth) for depth in ("camera", "velodyne"))
    expected = folder_of.project_reference(folder_of.random_scan(0))
    assert len(expected) > 500
    assert set(zip(*(axis.tolist() for axis in np.nonzero(planar)), strict=True)) == set(expected)
    for (row, column), (z_m, x_m) in expected.items():
        assert planar[row, column] == pytest.approx(z_m, abs=1e-4)  # The calibration text has seven digits.
        assert forward[row, column] == pytest.approx(x_m, abs=1e-4)
    assert 0.2 < np.median((forward - planar)[planar > 0]) < 0.35


def test_nearest_lidar_point_wins_and_halves_round_to_even(tmp_path: Path) -> None:
    # Scanner and camera axes coincide: a point (x, y, z) falls into column round(3 x/z) - 1, row round(3 y/z) - 1.
    [image] = folder_of.first_images(1)
    cam = "S_rect_02: 4 2\nP_rect_02: 3 0 0 0 0 3 0 0 0 0 1 0\nR_rect_00: 1 0 0 0 1 0 0 0 1\n"
    folder_of.write_day(tmp_path / image.date, cam, "R: 1 0 0 0 1 0 0 0 1\nT: 0 0 0\n")
    path = folder_of.scan_path(tmp_path, image)
    path.parent.mkdir(parents=True)
    points = np.array([[8, 4, 6], [4, 2, 3], [12, 6, 9], [2, 1, 3], [1, 1, 90], [5, 3.5, 3], [1, 1, -3]])
    np.insert(points, 3, 0, axis=1).astype("<f4").tofile(path)
    # 3 * 4/3 = 4 -> column 3; 3 * 2/3 = 2 -> row 1: depths 6, 3 and 9. Then (2, 1, 3): column 1, row 0, depth 3.
    # (1, 1, 90) rounds to -1, (5, 3.5, 3) to column 4 of 4: outside; the last is behind the camera.
    assert truth_of(tmp_path, image).tolist() == [[0, 3, 0, 0], [0, 0, 0, 3]]
    # With velodyne depth, the value is the point's x: 2 of (2, 1, 3) and 4 of (4, 2, 3).
    assert truth_of(tmp_path, image, "velodyne").tolist() == [[0, 2, 0, 0], [0, 0, 0, 4]]
    np.array([[1.5, 1, 3, 0], [2.5, 2, 3, 0]], "<f4").tofile(path)
    assert truth_of(tmp_path, image).tolist() == [[0, 3, 0, 0], [0, 3, 0, 0]]


@pytest.mark.parametrize(
    ("crop", "rows", "columns"),
    [
        # 375 times 0.40810811 = 153.04, times 0.99189189 = 371.96;
        # 1242 times 0.03594771 = 44.65, times 0.96405229 = 1197.35
        ("garg", (153, 371), (44, 1197)),
        # 0.3324324 * 375 = 124.66, 0.91351351 * 375 = 342.57
        ("eigen", (124, 342), (44, 1197)),
        ("none", (0, 375), (0, 1242)),
    ],
)
def test_crops_have_the_published_pixels(
    crop: str, rows: tuple[int, int], columns: tuple[int, int], tmp_path: Path
) -> None:
    truth = np.full((375, 1242), 2560, np.uint16)
    Picture.fromarray(truth).save(tmp_path / "a.png")
    truth_m = np.full(truth.shape, np.nan)
    truth_m[slice(*rows), slice(*columns)] = 11.0
    source = SimpleNamespace(read=lambda _: truth_m)
    image = SimpleNamespace(Index="a", truth=tmp_path / "a.png")
    options = Namespace(kitti=tmp_path, lidar_depth="camera", crop=crop, cap=80.0)
    row = kitti.score_image(image, source, options)  # type: ignore[arg-type]
    assert row["scored_px"] == (rows[1] - rows[0]) * (columns[1] - columns[0])
    assert (row["coverage"], row["scale"]) == (1.0, pytest.approx(10 / 11))
    assert row["native"]["abs_rel"] == pytest.approx(0.1)


def test_metrics_of_known_pixels() -> None:
    found = kitti.errors(np.array([2.0, 200.0, 1e-9]), np.array([1.0, 40.0, 2e-3]), 80.0)
    assert found["abs_rel"] == pytest.approx((1 + 1 + 0.5) / 3)
    assert found["rmse_m"] == pytest.approx(math.sqrt((1 + 1600 + 1e-6) / 3))
    assert found["log_rmse"] == pytest.approx(math.log(2))
    assert [found[f"delta{power}"] for power in (1, 2, 3)] == [0, 0, 0]
    assert kitti.errors(np.array([1.5]), np.array([1.0]), 80.0)["delta2"] == 1


def test_known_scales_are_recovered(root: Path, truths: Depths, tmp_path: Path) -> None:
    result = check(tmp_path, write_npy(tmp_path / "mono", predictions(truths)), root)
    assert result["method"] == "mono"
    assert result["kitti"]["found"] == COUNT
    assert len(result["kitti"]["missing"]) == 697 - COUNT
    assert [image["scale"] for image in result["images"]] == pytest.approx(list(FACTORS), rel=1e-6)
    table = result["table"]
    assert table["complete"]
    assert table["scale_median"] == pytest.approx(np.median(FACTORS))
    assert table["scaled"]["abs_rel"] < 1e-6
    errors = [
        np.mean(np.abs(np.minimum(z_m / factor, 80) - z_m) / z_m)
        for (z_map, factor) in zip(truths.values(), FACTORS, strict=True)
        for z_m in [z_map[scored_mask(z_map)].astype(np.float64)]
    ]
    assert table["native"]["abs_rel"] == pytest.approx(np.mean(errors), rel=1e-6)


def test_known_noise_lies_within_the_interval(root: Path, truths: Depths, tmp_path: Path) -> None:
    folder = write_npy(tmp_path / "mono", predictions(truths, NOISE))
    intervals = check(tmp_path, folder, root, "--cap", "1e4")["table"]["intervals"]
    expected = np.abs(np.exp(NOISE * np.random.default_rng(0).standard_normal(1_000_000)) - 1).mean()
    low, high = intervals["scaled.abs_rel"]
    assert low < 1.02 * expected, "noise of the scales adds up to 2 %"
    assert expected < high
    assert high - low < 0.2 * expected
    low, high = intervals["scale_median"]
    assert low < np.median(FACTORS) < high


def test_missing_predictions_make_result_incomplete(root: Path, truths: Depths, tmp_path: Path) -> None:
    holed = predictions(truths, NOISE)
    for depth_m in holed.values():
        depth_m[:, :62] = np.nan
    holed[next(iter(holed))][:] = 0
    table = check(tmp_path, write_npy(tmp_path / "holed", holed), root)["table"]
    assert (table["complete"], table["images"], table["images_scored"]) == (False, COUNT, COUNT - 1)
    coverages = [scored_mask(z_m)[:, 62:].sum() / scored_mask(z_m).sum() for z_m in truths.values()]
    assert table["coverage"] == pytest.approx(sum(coverages[1:]) / COUNT)


def test_list_of_images_is_not_overwritten(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    listed = tmp_path / "list.txt"
    listed.write_text("precious")
    words = ("--predictions", root, "--kitti", root, "--ground-truth", "raw", "--images", listed, "--json", listed)
    assert "which is an input" in refusal(kitti, capsys, *words)
    assert listed.read_text() == "precious"


@pytest.mark.slow
def test_archive_and_png_folder_score_alike(root: Path, truths: Depths, tmp_path: Path) -> None:
    depths = {name: np.round(depth_m * 256).clip(1, 65535) / 256 for name, depth_m in predictions(truths).items()}
    archive, other = tmp_path / "mono.zip", folder_of.first_images(COUNT + 1)[-1].name
    with SubmissionWriter(archive, method="mono") as writer:
        for name, depth_m in depths.items():
            writer.add(f"kitti/{name}", depth_m)
        writer.add(f"kitti/{other}", np.ones((3, 5)))  # An image without ground truth is allowed.
    folder = tmp_path / "pngs"
    folder.mkdir()
    for name, depth_m in depths.items():
        Picture.fromarray((depth_m * 256).astype(np.uint16)).save(folder / f"{name}.png")
    tables = [check(tmp_path, path, root)["table"] for path in (archive, folder)]
    assert tables[0] == tables[1]


@pytest.mark.parametrize("part", [".", "train", "val", "data_depth_annotated/train", "data_depth_annotated/val"])
def test_improved_ground_truth_is_used_unchanged(part: str, tmp_path: Path) -> None:
    images = folder_of.first_images(2)
    z_m = np.full((38, 124), 10.0)
    for image in images:
        folder_of.write_improved(folder_of.improved_path(tmp_path / "kitti", image, part), z_m)
    folder = write_npy(tmp_path / "mono", {image.name: z_m * 1.1 for image in images})
    arguments = ("--predictions", folder, "--kitti", tmp_path / "kitti", "--ground-truth", "improved")
    result = result_of(kitti, tmp_path, *arguments)
    assert result["table"]["native"]["abs_rel"] == pytest.approx(0.1)
    assert result["kitti"]["found"] == 2


def test_method_predicts_pairs_of_the_day(tmp_path: Path) -> None:
    images, root = folder_of.first_images(2), tmp_path / "kitti"
    folder_of.write_raw(root, images)
    pictures = [folder_of.write_picture(root, image, camera) for image in images for camera in (2, 3)]
    listed = "".join(f"{one.date}/{one.drive} {one.frame} {one.side}\n" for one in images)
    (tmp_path / "list.txt").write_text(listed)
    found = kitti.read_images(tmp_path / "list.txt")
    [views] = kitti.image_views(root, found)
    row = next(views.rows("left_rgb", "right_rgb", "left_K", "baseline_m"))
    assert row["view_id"] == f"kitti/{images[0].name}"
    assert row["baseline_m"] == pytest.approx((folder_of.PX + 33.95242) / folder_of.FX)
    fx, cx, cy = folder_of.FX, folder_of.CX, folder_of.CY
    assert row["left_K"].tolist() == [[fx, 0, cx], [0, fx, cy], [0, 0, 1]]
    for eye, path in zip(("left", "right"), pictures, strict=False):
        assert np.array_equal(row[f"{eye}_rgb"], np.asarray(Picture.open(path)))
    options = ("--images", tmp_path / "list.txt", "--method", "sgbm-filled")
    result = check(tmp_path, tmp_path / "a.zip", root, *options)
    assert (result["method"], result["table"]["images"]) == ("sgbm-filled", 2)
    pictures[1].unlink()
    [views] = kitti.image_views(root, found)
    assert not views.right


@pytest.mark.slow
def test_outputs_are_deterministic(
    root: Path, truths: Depths, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_npy(tmp_path / "mono", predictions(truths, NOISE))
    arguments = ("--predictions", folder, "--kitti", root, "--ground-truth", "raw", "--lidar-depth", "velodyne")
    files = repeated_files(kitti, tmp_path, *arguments, again=("--workers", "1"))
    assert json.loads(files["json"])["protocol"] == "rebar-kitti-eigen-1"
    assert files["csv"].startswith(b"alignment,abs_rel,rmse_m,log_rmse,delta1,delta2,delta3\nnative,")
    assert "Metric3D v2 AbsRel 0.0926" in capsys.readouterr().out


@pytest.fixture(scope="module")
def folders(truths: Depths, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write sound predictions, and folders with a single one, none, and images of another size."""
    folder = tmp_path_factory.mktemp("predictions")
    write_npy(folder / "mono", predictions(truths))
    write_npy(folder / "short", dict(list(predictions(truths).items())[:1]))
    write_npy(folder / "large", dict.fromkeys(list(truths), np.ones((20, 30), np.float32)))
    (folder / "empty").mkdir()
    relative = write_npy(folder / "relative", predictions(truths))
    (relative / "submission.json").write_text('{"method": "net", "prediction": "affine-disparity"}')
    return folder


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("--predictions", "nowhere.zip"), "does not exist"),
        (("--kitti", "nowhere"), "nowhere: has no raw ground truth of the 697 images"),
        (("--ground-truth", "improved"), "has no improved ground truth"),
        (("--predictions", "short"), "95 views have no file, among them kitti/2011_09_26_drive_0002_sync_00000"),
        (("--predictions", "empty"), "no depth file of any view was found"),
        (("--predictions", "relative"), "of the kind affine-disparity, expected metric ones: the paper's errors"),
        (("--predictions", "large"), r"2011_09_26_drive_0002_sync_0000000000_l.npy: "),
    ],
)
def test_bad_input_exits_with_status_2(
    change: tuple[str, str],
    words: str,
    root: Path,
    folders: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(folders)
    options = {"--predictions": "mono", "--kitti": str(root), "--ground-truth": "raw"} | dict([change])
    assert words in refusal(kitti, capsys, *(part for pair in options.items() for part in pair))
