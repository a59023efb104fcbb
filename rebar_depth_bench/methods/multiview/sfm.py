"""Structure from motion with COLMAP (``pycolmap``): cameras and sparse points in a frame and unit of their own.

Source: J. L. Schoenberger, J.-M. Frahm, "Structure-from-Motion Revisited", CVPR 2016. SIFT, matching, incremental
mapping; the intrinsics are given and kept.
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
from rebar_depth_bench.progress import Progress, silent

SEED = 0
PEAK_THRESHOLD = 0.003
"""SIFT's least contrast; COLMAP's 0.0067 finds half as many points on smooth steel and paper."""
LEAST_REGISTERED = 3
PIXEL_CENTRE = 0.5
"""COLMAP has the first pixel's centre at (0.5, 0.5)."""


@dataclass(frozen=True, eq=False)
class Structure:
    """Registered views by picture name: their poses, the sparse points, and which of these each view sees."""

    cam_from_sfm: Mapping[str, Float64[ndarray, "4 4"]]
    points: Float64[ndarray, "n 3"]
    seen: Mapping[str, Int64[ndarray, " m"]]
    reprojection_px: float

    def depths(self, name: str) -> Float64[ndarray, " m"]:
        """Return the planar depths at which a view sees its sparse points, in the reconstruction's unit."""
        pose = self.cam_from_sfm[name]
        return np.asarray(self.points[self.seen[name]] @ pose[2, :3] + pose[2, 3])


def find_structure(
    images: Path,
    names: Sequence[str],
    K: Float64[ndarray, "3 3"],
    work: Path,
    *,
    pairs: Sequence[tuple[str, str]] | None = None,
    progress: Progress = silent,
) -> Structure:
    """Return the largest reconstruction from pictures of one pinhole camera; K in pixels, centres at integers.

    ``pairs`` are the names of those to match, all with all by default.

    What was found stays in ``work`` and is read from there the next time. Raises ``MethodError`` where no two
    pictures could be brought together, or fewer than three were.
    """
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    model = work / "model"
    if not model.is_dir():
        _reconstruct(images, names, K, work, pairs, progress)
    structure = _structure(pycolmap.Reconstruction(model))
    if len(structure.cam_from_sfm) < LEAST_REGISTERED:
        raise MethodError(
            f"COLMAP registers {len(structure.cam_from_sfm)} of {len(names)} pictures, expected at least "
            f"{LEAST_REGISTERED}"
        )
    return structure


def _reconstruct(
    images: Path,
    names: Sequence[str],
    K: Float64[ndarray, "3 3"],
    work: Path,
    pairs: Sequence[tuple[str, str]] | None,
    progress: Progress,
) -> None:
    database, mapped = work / "database.db", work / "mapped"
    database.unlink(missing_ok=True)
    shutil.rmtree(mapped, ignore_errors=True)
    mapped.mkdir()
    stages = "COLMAP: features, matches, mapping"
    progress(stages, 0, 3)
    pycolmap.extract_features(
        database,
        images,
        image_names=list(names),
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=_reader(K),
        extraction_options=_extraction(),
        device=pycolmap.Device.cpu,
    )
    progress(stages, 1, 3)
    _match(database, pairs, work)
    progress(stages, 2, 3)
    models = pycolmap.incremental_mapping(database, images, mapped, options=_mapping())
    progress(stages, 3, 3)
    if not models:
        raise MethodError(f"COLMAP finds no two of {len(names)} pictures that belong together")
    found = work / "model.part"
    shutil.rmtree(found, ignore_errors=True)
    found.mkdir()
    max(models.values(), key=lambda model: model.num_reg_images()).write(found)
    found.rename(work / "model")


def _reader(K: Float64[ndarray, "3 3"]) -> pycolmap.ImageReaderOptions:
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "PINHOLE"
    centre = (K[0, 2] + PIXEL_CENTRE, K[1, 2] + PIXEL_CENTRE)
    reader.camera_params = ", ".join(repr(float(value)) for value in (K[0, 0], K[1, 1], *centre))
    return reader


def _extraction() -> pycolmap.FeatureExtractionOptions:
    """Return SIFT that follows the local affine shape: rods turn away from the camera within a few views."""
    options = pycolmap.FeatureExtractionOptions()
    options.sift.estimate_affine_shape = True
    options.sift.domain_size_pooling = True
    options.sift.peak_threshold = PEAK_THRESHOLD
    return options


def _match(database: Path, pairs: Sequence[tuple[str, str]] | None, work: Path) -> None:
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    if pairs is None:
        pycolmap.match_exhaustive(database, verification_options=verification, device=pycolmap.Device.cpu)
        return
    listed = pycolmap.ImportedPairingOptions()
    listed.match_list_path = work / "pairs.txt"
    (work / "pairs.txt").write_text("".join(f"{one} {other}\n" for one, other in pairs))
    pycolmap.match_image_pairs(
        database, pairing_options=listed, verification_options=verification, device=pycolmap.Device.cpu
    )


def _mapping() -> pycolmap.IncrementalPipelineOptions:
    """Return mapping that leaves the intrinsics as they are."""
    options = pycolmap.IncrementalPipelineOptions()
    options.ba_refine_focal_length = False
    options.ba_refine_extra_params = False
    options.mapper.abs_pose_refine_focal_length = False
    options.mapper.abs_pose_refine_extra_params = False
    options.random_seed = SEED
    options.num_threads = 1  # with more, the same database gives other points from run to run
    return options


def _structure(model: pycolmap.Reconstruction) -> Structure:
    ids = sorted(model.points3D)
    index = {point_id: place for place, point_id in enumerate(ids)}
    posed = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    poses, seen = {}, {}
    for image in posed:
        pose = image.cam_from_world()
        poses[image.name] = rigid(pose.rotation.matrix(), pose.translation)
        found = {index[point.point3D_id] for point in image.get_observation_points2D()}
        seen[image.name] = np.array(sorted(found), np.int64)
    points = np.array([model.points3D[point_id].xyz for point_id in ids]).reshape(-1, 3)
    return Structure(poses, points, seen, float(model.compute_mean_reprojection_error()))
