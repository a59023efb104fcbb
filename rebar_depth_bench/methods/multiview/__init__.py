"""Depth from all views of a config: structure from motion, a scale, and dense depth on its cameras.

COLMAP as in the paper, and its stand-in on a CPU: cameras from the left views, a scale, dense depth.

Four methods: dense depth by COLMAP's PatchMatch (CUDA) or by a plane sweep that is not COLMAP's; metres from the
ArUco board, or from the median of ground truth, which is no metric result (the paper's dagger).
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

from rebar_depth_bench.data.dataset import ConfigViews
from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods.base import MethodInfo, MultiViewMethod, Prepared
from rebar_depth_bench.progress import Progress

_DENSE = {
    "colmap": "dense depth by COLMAP's PatchMatch, which needs CUDA",
    "sweep": "dense depth by a plane sweep on the CPU, which is not COLMAP's",
}
_METRES = {
    "aruco": "metres from the ArUco board",
    "anchored": "median-anchored to ground truth, no metric result",
}
_UNEXERCISED = {"colmap": "PatchMatch never ran where this was written: there is no CUDA", "sweep": ""}


def _run() -> ModuleType:
    try:
        from rebar_depth_bench.methods.multiview import pipeline
    except ImportError as error:
        raise MethodError(
            f"multi-view methods need pycolmap and OpenCV ({error}): pip install 'rebar-depth-bench[multiview]'"
        ) from None
    return pipeline


def _method(dense: str, anchoring: str) -> MultiViewMethod:
    def prepare(views: ConfigViews, work: Path, progress: Progress) -> Prepared:
        prepared: Prepared = _run().prepare(views, work, progress, dense, anchoring)
        return prepared

    info = MethodInfo(
        name=f"{dense}-{anchoring}",
        summary=f"COLMAP's cameras from the left views, K known; {_DENSE[dense]}; {_METRES[anchoring]}",
        columns=(),
        uses_intrinsics=True,
        source="pycolmap" if dense == "colmap" else "pycolmap, and this project's plane sweep",
        licence="BSD-3-Clause" if dense == "colmap" else "BSD-3-Clause, Apache-2.0",
        reads_truth=anchoring == "anchored",
        unexercised=_UNEXERCISED[dense],
    )
    return MultiViewMethod(info, prepare, lambda views: _run().check(views, dense, anchoring))


COLMAP_ARUCO, COLMAP_ANCHORED = _method("colmap", "aruco"), _method("colmap", "anchored")
SWEEP_ARUCO, SWEEP_ANCHORED = _method("sweep", "aruco"), _method("sweep", "anchored")
