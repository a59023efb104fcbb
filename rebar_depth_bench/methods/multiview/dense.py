"""Dense depth of every registered view, by name in a registry: COLMAP's PatchMatch, or the plane sweep.

What they return is a reader: from a picture's name to its depth on the pinhole grid, in the reconstruction's unit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.files import replacing
from rebar_depth_bench.methods.multiview.consistency import consistent
from rebar_depth_bench.methods.multiview.neighbours import depth_range, neighbours
from rebar_depth_bench.methods.multiview.patch_match import patch_match, read_depth_map, require_cuda
from rebar_depth_bench.methods.multiview.pictures import LeftPictures
from rebar_depth_bench.methods.multiview.plane_sweep import PosedPicture, SweepSpec, sweep
from rebar_depth_bench.methods.multiview.structure import Structure
from rebar_depth_bench.progress import Progress
from rebar_depth_bench.streaming import ordered_map

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
