"""Structure from motion with COLMAP (``pycolmap``): cameras and sparse points in an arbitrary frame and unit.

Source: J. L. Schoenberger, J.-M. Frahm, "Structure-from-Motion Revisited", CVPR 2016. The steps are SIFT,
matching and incremental mapping; the intrinsics are given and fixed.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float64, Int64
from numpy import ndarray

from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.geometry.cameras import rigid
from rebar_depth_bench.parallel import Progress, silent

SEED = 0
SIFT_PEAK_THRESHOLD = 0.003
"""SIFT contrast threshold; COLMAP's default of 0.0067 finds half as many points on smooth steel and paper."""
MIN_REGISTERED_VIEWS = 3
"""Smallest number of registered views of a valid reconstruction."""
COLMAP_PIXEL_CENTRE = 0.5
"""Offset of pixel centres: in COLMAP the centre of the first pixel is (0.5, 0.5)."""


@dataclass(frozen=True, eq=False)
class SparseReconstruction:
    """Sparse points, and poses of registered views and the indices of the points they observe, by image name."""

    cam_from_sfm: Mapping[str, Float64[ndarray, "4 4"]]
    points: Float64[ndarray, "n 3"]
    visible_points: Mapping[str, Int64[ndarray, " m"]]
    reprojection_px: float

    def depths(self, name: str) -> Float64[ndarray, " m"]:
        """Return the planar depths of a view's sparse points, in the reconstruction's unit."""
        pose = self.cam_from_sfm[name]
        return np.asarray(self.points[self.visible_points[name]] @ pose[2, :3] + pose[2, 3])


def reconstruct_sparse(
    images: Path,
    names: Sequence[str],
    K: Float64[ndarray, "3 3"],
    work: Path,
    *,
    pairs: Sequence[tuple[str, str]] | None = None,
    progress: Progress = silent,
) -> SparseReconstruction:
    """Return the largest reconstruction from images of one pinhole camera.

    ``K`` is in pixels with pixel centres at integers. ``pairs`` are the names of the images to match (default: all
    pairs). The result is stored in ``work`` and read from there the next time.

    Raises ``MethodError`` if no two images can be matched or fewer than three are registered.
    """
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    model = work / "model"
    if not model.is_dir():
        _run_colmap(images, names, K, work, pairs, progress)
    reconstruction = _from_pycolmap(pycolmap.Reconstruction(model))
    if len(reconstruction.cam_from_sfm) < MIN_REGISTERED_VIEWS:
        raise MethodError(
            f"COLMAP registered {len(reconstruction.cam_from_sfm)} of {len(names)} images, expected at least "
            f"{MIN_REGISTERED_VIEWS}"
        )
    return reconstruction


def _run_colmap(
    images: Path,
    names: Sequence[str],
    K: Float64[ndarray, "3 3"],
    work: Path,
    pairs: Sequence[tuple[str, str]] | None,
    progress: Progress,
) -> None:
    database, models_folder = work / "database.db", work / "mapped"
    database.unlink(missing_ok=True)
    shutil.rmtree(models_folder, ignore_errors=True)
    models_folder.mkdir()
    stages = "COLMAP: features, matches, mapping"
    progress(stages, 0, 3)
    pycolmap.extract_features(
        database,
        images,
        image_names=list(names),
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=_reader_options(K),
        extraction_options=_extraction_options(),
        device=pycolmap.Device.cpu,
    )
    progress(stages, 1, 3)
    _match(database, pairs, work)
    progress(stages, 2, 3)
    models = pycolmap.incremental_mapping(database, images, models_folder, options=_mapping_options())
    progress(stages, 3, 3)
    if not models:
        raise MethodError(f"COLMAP found no matching pair among {len(names)} images")
    partial_model = work / "model.part"
    shutil.rmtree(partial_model, ignore_errors=True)
    partial_model.mkdir()
    max(models.values(), key=lambda model: model.num_reg_images()).write(partial_model)
    partial_model.rename(work / "model")


def _reader_options(K: Float64[ndarray, "3 3"]) -> pycolmap.ImageReaderOptions:
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "PINHOLE"
    centre = (K[0, 2] + COLMAP_PIXEL_CENTRE, K[1, 2] + COLMAP_PIXEL_CENTRE)
    reader.camera_params = ", ".join(repr(float(value)) for value in (K[0, 0], K[1, 1], *centre))
    return reader


def _extraction_options() -> pycolmap.FeatureExtractionOptions:
    """Return SIFT options with affine shape estimation: rods turn away from the camera within a few views."""
    options = pycolmap.FeatureExtractionOptions()
    options.sift.estimate_affine_shape = True
    options.sift.domain_size_pooling = True
    options.sift.peak_threshold = SIFT_PEAK_THRESHOLD
    return options


def _match(database: Path, pairs: Sequence[tuple[str, str]] | None, work: Path) -> None:
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    if pairs is None:
        pycolmap.match_exhaustive(database, verification_options=verification, device=pycolmap.Device.cpu)
        return
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = work / "pairs.txt"
    (work / "pairs.txt").write_text("".join(f"{name} {other}\n" for name, other in pairs))
    pycolmap.match_image_pairs(
        database, pairing_options=pairing, verification_options=verification, device=pycolmap.Device.cpu
    )


def _mapping_options() -> pycolmap.IncrementalPipelineOptions:
    """Return mapping options with fixed intrinsics."""
    options = pycolmap.IncrementalPipelineOptions()
    options.ba_refine_focal_length = False
    options.ba_refine_extra_params = False
    options.mapper.abs_pose_refine_focal_length = False
    options.mapper.abs_pose_refine_extra_params = False
    options.random_seed = SEED
    options.num_threads = 1  # Results are not reproducible with more threads.
    return options


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
