"""Multi-view methods on rendered images: cameras, scale and depth against ground truth."""

from __future__ import annotations

import json
import shutil
import sqlite3
import zipfile
from contextlib import closing
from pathlib import Path

import pytest

pytest.importorskip("cv2")
pytest.importorskip("pycolmap")

import numpy as np
import pycolmap

from rebar_depth_bench import load, score
from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.base.parallel import silent
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.geometry.cameras import pixel_rays
from rebar_depth_bench.methods import METHODS, ConfigViews, MultiViewMethod
from rebar_depth_bench.methods.multiview import dense
from rebar_depth_bench.methods.run import predict
from tests.bench.methods.predictors import stop_after
from tests.damage import change_manifest, copy_dataset
from tests.data.orbit import write_orbit

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def orbit_root(tmp_path_factory: pytest.TempPathFactory, tiny_root: Path) -> Path:
    """Return a dataset of 24 views of the lattice, 15 degrees apart, with stored images."""
    root = tmp_path_factory.mktemp("orbit") / "dataset"
    write_orbit(root, tiny_root / "meshes" / "lattice.ply")
    return root


@pytest.fixture(scope="module")
def work(orbit_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a run that was interrupted at the fifth view, before ``sweep-aruco.zip`` exists."""
    folder = tmp_path_factory.mktemp("sweep")
    stop = stop_after(5, "sweep-aruco on lattice-orbit")
    with pytest.raises(KeyboardInterrupt):
        predict(multi_view_method("sweep-aruco"), orbit_root, folder / "sweep-aruco.zip", progress=stop)
    assert not (folder / "sweep-aruco.zip").exists()
    shutil.copytree(folder / ".sweep-aruco.zip.views" / "lattice-orbit.work", folder / "kept")
    return folder


@pytest.fixture(scope="module")
def archive(work: Path, orbit_root: Path) -> Path:
    """Resume the run and return its archive; reconstructing cameras or sweeping again would fail."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pycolmap, "extract_features", None)
        patch.setattr(dense, "sweep_depth", None)
        predict(multi_view_method("sweep-aruco"), orbit_root, work / "sweep-aruco.zip")
    assert not (work / ".sweep-aruco.zip.views").exists()
    return work / "sweep-aruco.zip"


def multi_view_method(name: str) -> MultiViewMethod:
    method = METHODS[name]
    assert isinstance(method, MultiViewMethod)
    return method


def test_images_are_numbered_in_order_of_names(work: Path) -> None:
    """COLMAP's results depend on the numbers, which would otherwise follow the order of its threads."""
    with closing(sqlite3.connect(work / "kept" / "database.db")) as database:
        names = [name for (name,) in database.execute("SELECT name FROM images ORDER BY image_id")]
    assert len(names) == 24
    assert names == sorted(names)


def test_notes_report_accurate_cameras_and_scale(archive: Path) -> None:
    with zipfile.ZipFile(archive) as source:
        metadata = json.loads(source.read("submission.json"))
    notes = metadata["notes"]["lattice-orbit"]
    assert notes["views_registered"] == notes["views"] == 24
    assert abs(notes["scale_error_percent"]) < 1
    assert notes["markers"] == [0, 1, 2, 3, 4, 5]
    assert notes["marker_rms_mm"] < 2
    assert notes["centre_error_mm"]["median"] < 8
    assert notes["rotation_error_deg"]["median"] < 1
    assert notes["cameras_compared"] == "in the board's frame"
    assert metadata["runtime"]["preparing"]["lattice-orbit"] > 0


def test_swept_depth_is_metric(archive: Path, orbit_root: Path) -> None:
    table = score(archive, orbit_root).tables["lattice-orbit"]
    assert table["coverage"] > 0.4
    assert table["native.abs_rel"] < 0.09
    assert table["scale_median"] == pytest.approx(1, abs=0.03)


def test_anchored_scale_agrees_with_board_scale(work: Path, orbit_root: Path) -> None:
    views = ConfigViews(open_folder(orbit_root).config("lattice-orbit"))
    by_board, by_truth = (
        multi_view_method(name).prepare(views, work / "kept", silent) for name in ("sweep-aruco", "sweep-anchored")
    )
    assert by_truth.notes["scale_m"] == pytest.approx(by_board.notes["scale_m"], rel=0.02)
    assert "not metric" in by_truth.notes["scale_from"]
    assert by_truth.notes["views_anchored_with"] == 24
    row = {"view_id": views.view_ids[0]}
    depths_m = by_board.predict(row), by_truth.predict(row)
    factor = by_truth.notes["scale_m"] / by_board.notes["scale_m"]
    assert np.allclose(depths_m[0] * factor, depths_m[1], rtol=1e-5, equal_nan=True)


def test_board_plane_matches_visible_board(orbit_root: Path) -> None:
    views = ConfigViews(open_folder(orbit_root).config("lattice-orbit"))
    predictor = multi_view_method("board-plane").prepare(views, orbit_root, silent).predict
    errors_m = []
    for row in load(orbit_root, "lattice-orbit").select(range(4)):
        predicted_m = predictor(row)
        truth_m = row["left_depth"]
        height, width = truth_m.shape
        K, pose = row["left_K"], row["left_cam_from_world"]
        points = (pixel_rays(K, width, height) * truth_m[..., None] - pose[:3, 3]) @ pose[:3, :3]
        on_board = (np.abs(points) < [0.2, 0.14, 1e-4]).all(axis=-1)
        assert on_board.mean() > 0.1
        errors_m.append(np.median(np.abs(predicted_m - truth_m)[on_board]))
        steel = row["left_mask"]
        assert (predicted_m >= truth_m - 0.005)[steel].all(), "what stands on the board is nearer than the board"
    assert max(errors_m) < 0.01, "one marker alone tells little of the far side"
    assert min(errors_m) < 0.002


@pytest.mark.parametrize("name", ["sweep-aruco", "board-plane"])
def test_scene_without_board_raises_before_work(name: str, tiny_root: Path, tmp_path: Path) -> None:
    root = copy_dataset(tiny_root, tmp_path / "dataset")
    for config in ("lattice", "lattice-orbit"):
        change_manifest(root, lambda _, entry: entry["scenes"][0].update(board=None), config)
    with pytest.raises(MethodError, match=r"lattice: the scene has no ArUco board.*--config lattice pile"):
        predict(METHODS[name], root, tmp_path / "out.zip")
    assert [path.name for path in tmp_path.iterdir()] == ["dataset"]


@pytest.mark.skipif(pycolmap.has_cuda, reason="this pycolmap has CUDA: PatchMatch would run")
@pytest.mark.parametrize("name", ["colmap-aruco", "colmap-anchored"])
def test_patch_match_without_cuda_names_package(name: str, tiny_root: Path, tmp_path: Path) -> None:
    with pytest.raises(MethodError, match=r"needs CUDA.*pip install pycolmap-cuda12.*use sweep-aruco"):
        predict(METHODS[name], tiny_root, tmp_path / "out.zip")
    assert METHODS[name].info.untested_note
