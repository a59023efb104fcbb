"""Cameras from the left images of a config: undistortion, selection of pairs and COLMAP (``pycolmap``).

All images are resampled to one pinhole camera; depth on its grid is transferred back to the grid of the left
camera. COLMAP computes cameras and sparse points in an arbitrary frame and unit, by SIFT, matching and incremental
mapping; the intrinsics are given and fixed.

Image pairs are matched only if their relative rotation, measured with the markers of the board, is small. A
lattice looks nearly the same after a quarter or half turn. On 24 views of it (512 x 288), opposite views match
with up to 74 inliers, while neighbours 15 degrees apart have 85 to 177: no threshold on inliers separates them at
every image size, and COLMAP registers views on the wrong side. Unlike steel, markers have unique ids.

Source: J. L. Schoenberger, J.-M. Frahm, "Structure-from-Motion Revisited", CVPR 2016.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float32, Float64, Int64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.base.parallel import Progress, silent
from rebar_depth_bench.base.writing import write_bytes
from rebar_depth_bench.data.rows import Views
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.geometry.aruco_detection import Corners, board_pose, detected_corners_px
from rebar_depth_bench.geometry.cameras import rigid
from rebar_depth_bench.geometry.rectification import PinholeGrid, pinhole_grid, pinhole_image


def row_columns(views: Views) -> tuple[str, ...]:
    """Return the columns that are read; the poses, where there are any, serve only for error reports."""
    columns = ("left_rgb", "left_K", "left_distortion")
    return (*columns, "left_cam_from_world") if views.has_poses else columns


Poses = Mapping[str, Float64[ndarray, "4 4"]]
"""Camera poses (cam_from_...) by image name."""


@dataclass(frozen=True, eq=False)
class LeftImages:
    """Undistorted images in ``folder``, with the pinhole grid that they share.

    ``names`` maps view ids to image names; ``markers`` and ``cam_from_world`` are keyed by image name. The true
    poses are used only for error reports; there are none of captures without poses.
    """

    folder: Path
    names: Mapping[str, str]
    grid: PinholeGrid
    markers: Mapping[str, Corners]
    cam_from_world: Poses

    @property
    def no_depth(self) -> Float32[ndarray, "h w"]:
        """Depth map without values on the pinhole grid."""
        return np.full((self.grid.height, self.grid.width), np.nan, np.float32)


def write_left_images(views: Views, folder: Path) -> LeftImages:
    """Write all left images, undistorted if the lens has distortion, and detect the markers of the board.

    Raises ``MethodError`` if the views differ in K or distortion or if there are none, and ``OutputError`` if an
    image cannot be written.
    """
    folder.mkdir(exist_ok=True)
    height, width = views.grid
    first, grid = None, None
    names, markers, poses = {}, {}, {}
    for row in views.rows(*row_columns(views)):
        if first is None or grid is None:
            first, grid = row, pinhole_grid(row, width, height)
        if any(not np.array_equal(row[column], first[column]) for column in ("left_K", "left_distortion")):
            raise MethodError(
                f"{row['view_id']}: K or distortion differs from the previous view, expected one camera"
            )
        name = names[row["view_id"]] = row["view_id"].rpartition("/")[2] + ".png"
        rgb = pinhole_image(row, grid)
        write_bytes(folder / name, cv2.imencode(".png", rgb[..., ::-1])[1].tobytes())
        markers[name] = detected_corners_px(rgb, views.board.dictionary) if views.board else {}
        if views.has_poses:
            poses[name] = row["left_cam_from_world"]
    if grid is None:
        raise MethodError(f"{views.config}: has no views, expected three or more")
    return LeftImages(folder, names, grid, markers, poses)


MAX_PAIR_ROTATION_DEG = 60.0
"""Largest relative rotation of two images that are matched."""


def select_pairs(
    markers: Mapping[str, Corners], board: BoardSpec, K: Float64[ndarray, "3 3"]
) -> list[tuple[str, str]]:
    """Return the pairs of image names to match; images without a board pose are matched with all others.

    ``markers`` are detections in pinhole images with intrinsics ``K``, pixels.
    """
    poses = {name: board_pose(corners, board, K) for name, corners in markers.items()}
    pairs = []
    for name, other in combinations(sorted(markers), 2):
        pose, other_pose = poses[name], poses[other]
        if pose is not None and other_pose is not None:
            turn = Rotation.from_matrix(other_pose[:3, :3] @ pose[:3, :3].T)
            if np.degrees(turn.magnitude()) > MAX_PAIR_ROTATION_DEG:
                continue
        pairs.append((name, other))
    return pairs


SEED = 0
SIFT_PEAK_THRESHOLD = 0.003
"""SIFT contrast threshold; COLMAP's default of 0.0067 finds half as many points on smooth steel and paper."""
MIN_REGISTERED_VIEWS = 3
"""Smallest number of registered views of a valid reconstruction."""
CAMERA_MODEL = "PINHOLE"
"""COLMAP's name of a camera without distortion."""
COLMAP_PIXEL_CENTRE = 0.5
"""Offset of pixel centres: in COLMAP the centre of the first pixel is (0.5, 0.5)."""


@dataclass(frozen=True, eq=False)
class SparseReconstruction:
    """Sparse points, and poses of registered views and the indices of the points they observe, by image name."""

    cam_from_sfm: Poses
    points: Float64[ndarray, "n 3"]
    visible_points: Mapping[str, Int64[ndarray, " m"]]
    reprojection_px: float

    def depths(self, name: str) -> Float64[ndarray, " m"]:
        """Return the planar depths of a view's sparse points, in the reconstruction's unit."""
        pose = self.cam_from_sfm[name]
        return np.asarray(self.points[self.visible_points[name]] @ pose[2, :3] + pose[2, 3])


def reconstruct(
    left_images: LeftImages, board: BoardSpec | None, work: Path, progress: Progress = silent
) -> SparseReconstruction:
    """Return the largest reconstruction from the images; markers of the board, if any, select the pairs to match.

    The result is stored in ``work`` and read from there the next time.

    Raises ``MethodError`` if no two images can be matched or fewer than three are registered.
    """
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    model = work / "model"
    if not model.is_dir():
        _run_colmap(left_images, board, work, progress)
    reconstruction = _from_pycolmap(pycolmap.Reconstruction(model))
    if len(reconstruction.cam_from_sfm) < MIN_REGISTERED_VIEWS:
        raise MethodError(
            f"COLMAP registered {len(reconstruction.cam_from_sfm)} of {len(left_images.names)} images, "
            f"expected at least {MIN_REGISTERED_VIEWS}"
        )
    return reconstruction


def _run_colmap(left_images: LeftImages, board: BoardSpec | None, work: Path, progress: Progress) -> None:
    images, names, K = left_images.folder, list(left_images.names.values()), left_images.grid.K
    database, models_folder = work / "database.db", work / "mapped"
    database.unlink(missing_ok=True)
    shutil.rmtree(models_folder, ignore_errors=True)
    models_folder.mkdir()
    stages = "COLMAP: features, matches, mapping"
    progress(stages, 0, 3)
    # Extraction numbers the images in the order in which its threads finish, and results depend on the numbers.
    pycolmap.Database.open(database).close()
    pycolmap.import_images(
        database,
        images,
        image_names=names,
        camera_mode=pycolmap.CameraMode.SINGLE,
        options=pycolmap.ImageReaderOptions(
            camera_model=CAMERA_MODEL, camera_params=", ".join(map(repr, camera_parameters(K)))
        ),
    )
    # With affine shape estimation: rods turn away from the camera within a few views.
    sift = {"estimate_affine_shape": True, "domain_size_pooling": True, "peak_threshold": SIFT_PEAK_THRESHOLD}
    pycolmap.extract_features(
        database,
        images,
        image_names=names,
        extraction_options=pycolmap.FeatureExtractionOptions(sift=sift),
        device=pycolmap.Device.cpu,
    )
    progress(stages, 1, 3)
    verification = pycolmap.TwoViewGeometryOptions(ransac={"random_seed": SEED})
    if board is None:
        pycolmap.match_exhaustive(database, verification_options=verification, device=pycolmap.Device.cpu)
    else:
        pairs = select_pairs(left_images.markers, board, K)
        match_list = work / "pairs.txt"
        match_list.write_text("".join(f"{name} {other}\n" for name, other in pairs))
        pairing = pycolmap.ImportedPairingOptions(match_list_path=match_list)
        pycolmap.match_image_pairs(
            database, pairing_options=pairing, verification_options=verification, device=pycolmap.Device.cpu
        )
    progress(stages, 2, 3)
    mapping = pycolmap.IncrementalPipelineOptions(
        ba_refine_focal_length=False,
        ba_refine_extra_params=False,
        mapper={"abs_pose_refine_focal_length": False, "abs_pose_refine_extra_params": False},
        random_seed=SEED,
        num_threads=1,  # Results are not reproducible with more threads.
    )
    models = pycolmap.incremental_mapping(database, images, models_folder, options=mapping)
    progress(stages, 3, 3)
    if not models:
        raise MethodError(f"COLMAP found no matching pair among {len(names)} images")
    partial_model = work / "model.part"
    shutil.rmtree(partial_model, ignore_errors=True)
    partial_model.mkdir()
    max(models.values(), key=lambda model: model.num_reg_images()).write(partial_model)
    partial_model.rename(work / "model")


def camera_parameters(K: Float64[ndarray, "3 3"]) -> list[float]:
    """Return fx, fy and the principal point, pixels, of ``CAMERA_MODEL``."""
    centre = K[:2, 2] + COLMAP_PIXEL_CENTRE
    return [float(K[0, 0]), float(K[1, 1]), *centre.tolist()]


def _from_pycolmap(model: pycolmap.Reconstruction) -> SparseReconstruction:
    ids = sorted(model.points3D)
    index = {point_id: position for position, point_id in enumerate(ids)}
    registered = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    poses, visible_points = {}, {}
    for image in registered:
        pose = image.cam_from_world()
        poses[image.name] = rigid(pose.rotation.matrix(), pose.translation)
        point_indices = {index[point.point3D_id] for point in image.get_observation_points2D()}
        visible_points[image.name] = np.array(sorted(point_indices), np.int64)
    points = np.array([model.points3D[point_id].xyz for point_id in ids]).reshape(-1, 3)
    return SparseReconstruction(poses, points, visible_points, float(model.compute_mean_reprojection_error()))
