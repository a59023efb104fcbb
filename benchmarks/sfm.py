"""Whether structure from motion recovers the true cameras from the rendered pictures, on the CPU.

python -m benchmarks.sfm ROOT [CONFIG]

The config is exported; COLMAP (pycolmap) gets the left pictures and the one true K, which it keeps, and finds the
poses: SIFT, exhaustive matching, incremental mapping. Its camera centres are then laid on the true ones of the
exported model by a similarity, for such a reconstruction has no scale of its own.

The lattice looks the same after half a turn: views from opposite sides match as well, with up to 83 inliers where
neighbours 15 degrees apart have 400 and more. COLMAP's own settings (pairs from 15 inliers on, half the features)
then register all views of the ring and put some of them on its wrong side.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float64
from numpy import ndarray

from benchmarks.timing import machine, print_markdown
from dataset_builder.export import export

SEED = 0
PEAK_THRESHOLD = 0.003
"""SIFT's least contrast; COLMAP's 0.0067 finds half as many points on smooth steel and paper."""

PAIR_INLIERS = 90
"""Inliers that make two pictures a pair: more than those of opposite sides."""


def similarity(
    source: Float64[ndarray, "n 3"], target: Float64[ndarray, "n 3"]
) -> tuple[float, Float64[ndarray, "3 3"], Float64[ndarray, " 3"]]:
    """Return scale, rotation and translation with ``target ~ scale * rotation @ source + translation``.

    Least squares, for three or more points that are not on one line; those of a plane are fine.
    Source: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991.
    """
    source_middle, target_middle = source.mean(axis=0), target.mean(axis=0)
    centred = source - source_middle
    u, singular, vt = np.linalg.svd((target - target_middle).T @ centred)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])  # a rotation, no mirror
    rotation = u @ np.diag(signs) @ vt
    scale = float(singular @ signs / np.sum(centred**2))
    return scale, rotation, target_middle - scale * rotation @ source_middle


def rotation_deg(rotation: Float64[ndarray, "3 3"]) -> float:
    """Return the angle of a rotation, degrees."""
    skew = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    return float(np.degrees(np.arctan2(np.linalg.norm(skew), np.trace(rotation) - 1)))


def reconstruct(
    images: Path, names: list[str], camera: pycolmap.Camera, work: Path
) -> tuple[pycolmap.Reconstruction, dict[str, float]]:
    """Return the largest reconstruction from the named pictures with known intrinsics, and the stages' seconds."""
    seconds: dict[str, float] = {}
    database = work / "database.db"
    start = time.perf_counter()
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = camera.model_name
    reader.camera_params = ", ".join(repr(float(value)) for value in camera.params)
    pycolmap.extract_features(
        database,
        images,
        image_names=names,
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=_extraction_options(),
        device=pycolmap.Device.cpu,
    )
    seconds["features"] = time.perf_counter() - start
    start = time.perf_counter()
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    verification.min_num_inliers = PAIR_INLIERS
    pycolmap.match_exhaustive(database, verification_options=verification, device=pycolmap.Device.cpu)
    seconds["matches"] = time.perf_counter() - start
    start = time.perf_counter()
    models = pycolmap.incremental_mapping(database, images, work, options=_mapping_options())
    seconds["mapping"] = time.perf_counter() - start
    if not models:
        raise SystemExit("COLMAP found no model")
    return max(models.values(), key=lambda model: model.num_reg_images()), seconds


def _extraction_options() -> pycolmap.FeatureExtractionOptions:
    """Return SIFT that follows the local affine shape: rods turn away from the camera within a few views."""
    options = pycolmap.FeatureExtractionOptions()
    options.sift.estimate_affine_shape = True
    options.sift.domain_size_pooling = True
    options.sift.peak_threshold = PEAK_THRESHOLD
    return options


def _mapping_options() -> pycolmap.IncrementalPipelineOptions:
    """Return mapping that leaves the intrinsics as they are."""
    options = pycolmap.IncrementalPipelineOptions()
    options.ba_refine_focal_length = False
    options.ba_refine_extra_params = False
    options.mapper.abs_pose_refine_focal_length = False
    options.mapper.abs_pose_refine_extra_params = False
    options.random_seed = SEED
    return options


def pose_errors(
    found: pycolmap.Reconstruction, truth: pycolmap.Reconstruction
) -> tuple[Float64[ndarray, " n"], Float64[ndarray, " n"], float]:
    """Return each registered camera's centre error (metres) and rotation error (degrees), and the scale.

    Both after the similarity that lays the found centres on the true ones.
    """
    by_name = {image.name: image for image in truth.images.values()}
    pairs = [(image, by_name[image.name]) for image in found.images.values() if image.has_pose]
    found_centres = np.array([image.projection_center() for image, _ in pairs])
    true_centres_m = np.array([image.projection_center() for _, image in pairs])
    scale, rotation, translation_m = similarity(found_centres, true_centres_m)
    aligned_m = scale * found_centres @ rotation.T + translation_m
    turns = [
        rotation_deg(
            true.cam_from_world().rotation.matrix() @ rotation @ image.cam_from_world().rotation.matrix().T
        )
        for image, true in pairs
    ]
    return np.linalg.norm(aligned_m - true_centres_m, axis=1), np.array(turns), scale


def main(root: str, config: str = "lattice-orbit") -> None:
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    print(f"{config} of {root}; pycolmap {pycolmap.__version__}; {machine()}\n")
    with tempfile.TemporaryDirectory() as scratch:
        exported = export(root, Path(scratch) / "export", [config]).folder / config
        truth = pycolmap.Reconstruction(exported / "sparse" / "0")
        lefts = [image for image in truth.images.values() if image.name.endswith("_left.png")]
        names = sorted(image.name for image in lefts)
        found, seconds = reconstruct(exported / "images", names, lefts[0].camera, Path(scratch))
        centre_m, turn_deg, scale = pose_errors(found, truth)
    rows = [
        ("registered", f"{found.num_reg_images()} of {len(names)}"),
        ("points", f"{found.num_points3D()}"),
        ("mean reprojection error", f"{found.compute_mean_reprojection_error():.3f} px"),
        ("scale to metres", f"{scale:.6f}"),
        ("centre error, median", f"{1e3 * np.median(centre_m):.3f} mm"),
        ("centre error, largest", f"{1e3 * centre_m.max():.3f} mm"),
        ("rotation error, median", f"{np.median(turn_deg):.4f} deg"),
        ("rotation error, largest", f"{turn_deg.max():.4f} deg"),
        *((f"{stage}", f"{spent:.1f} s") for stage, spent in seconds.items()),
    ]
    print_markdown(["", "after a similarity"], rows)


if __name__ == "__main__":
    main(*sys.argv[1:])
