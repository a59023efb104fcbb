"""Dense depth of every registered view, by name in a registry: COLMAP's PatchMatch, or the plane sweep.

What they return is a reader: from a picture's name to its depth on the pinhole grid, in the reconstruction's unit.

Depth that several views agree on: each pixel's point is looked up in the neighbours' own depth.

Which views to match a view with, and between which depths: both from the sparse points.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from numpy import ndarray

from rebar_depth_bench.atomic_io import replacing
from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.geometry.cameras import camera_centre, inverse_rigid, pixel_rays, project, transform
from rebar_depth_bench.methods.multiview.images import LeftPictures
from rebar_depth_bench.methods.multiview.patch_match import patch_match, read_depth_map, require_cuda
from rebar_depth_bench.methods.multiview.plane_sweep import PosedPicture, SweepSpec, sweep
from rebar_depth_bench.methods.multiview.sfm import Structure
from rebar_depth_bench.parallel import ordered_map
from rebar_depth_bench.progress import Progress

AGREEMENT = 0.01
"""Two views agree where their depths of a point differ by at most this share."""


def consistent(
    depth: Float32[ndarray, "h w"],
    cam_from_sfm: Float64[ndarray, "4 4"],
    neighbours: Sequence[tuple[Float32[ndarray, "h w"], Float64[ndarray, "4 4"]]],
    K: Float64[ndarray, "3 3"],
    least: int,
) -> Bool[ndarray, "h w"]:
    """Tell which pixels at least ``least`` of the neighbours (their depth and pose) confirm."""
    height, width = depth.shape
    known = np.isfinite(depth)
    points = transform(
        inverse_rigid(cam_from_sfm), pixel_rays(K, width, height)[known] * depth[known][:, None].astype(np.float64)
    )
    votes = np.zeros(len(points), np.int64)
    for other, pose in neighbours:
        seen = transform(pose, points)
        in_front = seen[:, 2] > 0
        places = np.full((len(points), 2), -1.0)
        places[in_front] = project(K, seen[in_front])
        u, v = np.rint(places).astype(np.int64).T
        inside = in_front & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        there = np.full(len(points), np.nan)
        there[inside] = other[v[inside], u[inside]]
        with np.errstate(invalid="ignore"):
            votes += np.abs(there - seen[:, 2]) <= AGREEMENT * seen[:, 2]
    agreed = np.zeros(depth.shape, bool)
    agreed[known] = votes >= least
    return agreed


NEIGHBOURS = 4
BEST_ANGLE_DEG = 12.0
NARROWER_DEG, WIDER_DEG = 6.0, 10.0
"""How fast a pair's worth falls off below and above the best angle between its rays."""
RANGE_MARGIN = 0.15
RANGE_PERCENTILES = (1.0, 99.0)


def neighbours(structure: Structure) -> Mapping[str, tuple[str, ...]]:
    """Return each view's neighbours, best first: shared points, each weighed by the angle between its two rays.

    Source of the weighing: Y. Yao et al., "MVSNet", ECCV 2018, section 4.1.
    """
    names = list(structure.cam_from_sfm)
    centres = {name: camera_centre(structure.cam_from_sfm[name]) for name in names}
    found = {}
    for name in names:
        worth = {other: _worth(structure, name, other, centres) for other in names if other != name}
        ranked = sorted((other for other in worth if worth[other] > 0), key=lambda other: -worth[other])
        found[name] = tuple(ranked[:NEIGHBOURS])
    return found


def depth_range(structure: Structure, name: str) -> tuple[float, float]:
    """Return the nearest and farthest depth worth looking at in a view, with a margin."""
    near, far = np.percentile(structure.depths(name), RANGE_PERCENTILES)
    return float(near) * (1 - RANGE_MARGIN), float(far) * (1 + RANGE_MARGIN)


def _worth(structure: Structure, one: str, other: str, centres: Mapping[str, np.ndarray]) -> float:
    shared = np.intersect1d(structure.seen[one], structure.seen[other], assume_unique=True)
    if not len(shared):
        return 0.0
    first = structure.points[shared] - centres[one]
    second = structure.points[shared] - centres[other]
    cosine = (first * second).sum(axis=1) / (np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1))
    angle_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    width = np.where(angle_deg < BEST_ANGLE_DEG, NARROWER_DEG, WIDER_DEG)
    return float(np.exp(-(((angle_deg - BEST_ANGLE_DEG) / width) ** 2) / 2).sum())


SWEEP = SweepSpec()
CONFIRMATIONS = 1
"""Neighbours, of four, that must confirm a pixel of the sweep."""

DepthReader = Callable[[str], Float32[ndarray, "h w"]]


@dataclass(frozen=True)
class Dense:
    """A way to dense depth: ``check`` raises ``MethodError`` where it cannot run; ``run`` makes the reader."""

    check: Callable[[], None]
    run: Callable[[LeftPictures, Structure, Path, Progress], DepthReader]


def _patch_match(pictures: LeftPictures, structure: Structure, work: Path, progress: Progress) -> DepthReader:
    progress("COLMAP: PatchMatch stereo", 0, len(structure.cam_from_sfm))
    maps = patch_match(pictures.folder, work / "model", work)
    nothing = np.full((pictures.grid.height, pictures.grid.width), np.nan, np.float32)

    def read(name: str) -> Float32[ndarray, "h w"]:
        path = maps / f"{name}.geometric.bin"
        return read_depth_map(path) if path.is_file() else nothing  # a view without neighbours has no map

    return read


def _plane_sweep(pictures: LeftPictures, structure: Structure, work: Path, progress: Progress) -> DepthReader:
    folder = work / "sweep"
    folder.mkdir(exist_ok=True)
    near = neighbours(structure)

    def keep(name: str) -> None:
        kept = folder / f"{name}.npy"
        if not kept.is_file():
            depth = _swept(pictures, structure, name, near[name])
            with replacing(kept) as temporary, temporary.open("wb") as stream:
                np.save(stream, depth)

    for done, _ in enumerate(ordered_map(keep, list(structure.cam_from_sfm), None), start=1):
        progress("plane sweep", done, len(structure.cam_from_sfm))

    def read(name: str) -> Float32[ndarray, "h w"]:
        poses = structure.cam_from_sfm
        depth = np.load(folder / f"{name}.npy")
        others = [(np.load(folder / f"{other}.npy"), poses[other]) for other in near[name]]
        agreed = consistent(depth, poses[name], others, pictures.grid.K, CONFIRMATIONS)
        return np.where(agreed, depth, np.float32(np.nan))

    return read


def _swept(
    pictures: LeftPictures, structure: Structure, name: str, near: tuple[str, ...]
) -> Float32[ndarray, "h w"]:
    if not near or not len(structure.seen[name]):
        return np.full((pictures.grid.height, pictures.grid.width), np.nan, np.float32)
    view, *others = (
        PosedPicture(_grey(pictures.folder / one), structure.cam_from_sfm[one]) for one in (name, *near)
    )
    return sweep(view, others, pictures.grid.K, depth_range(structure, name), SWEEP)


def _grey(path: Path) -> UInt8[ndarray, "h w"]:
    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if grey is None:
        raise MethodError(f"{path}: cannot be read")
    return np.asarray(grey)


DENSE: Mapping[str, Dense] = {
    "colmap": Dense(require_cuda, _patch_match),
    "sweep": Dense(lambda: None, _plane_sweep),
}
