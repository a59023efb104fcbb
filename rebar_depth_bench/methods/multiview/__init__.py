"""Multi-view methods: structure from motion on the left views, metric scale and dense depth.

There are four methods. Cameras are always estimated by COLMAP. Dense depth is computed by COLMAP's PatchMatch, as
in the paper (needs CUDA), or by this project's plane sweep on the CPU, which is not part of COLMAP. Metric scale
comes from the ArUco board, or from the median of ground truth, which is not a metric result (the paper's dagger).
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

from rebar_depth_bench.data.rows import Views
from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods.base import MethodInfo, MultiViewMethod, Prepared
from rebar_depth_bench.parallel import Progress

_DENSE_SUMMARIES = {
    "colmap": "dense depth by COLMAP's PatchMatch, which needs CUDA",
    "sweep": "dense depth by a plane sweep on the CPU, which is not COLMAP's",
}
_SCALE_SUMMARIES = {
    "aruco": "metres from the ArUco board",
    "anchored": "median-anchored to ground truth, no metric result",
}
_UNTESTED_NOTES = {"colmap": "PatchMatch is not tested: no CUDA GPU was available", "sweep": ""}


def _import_pipeline() -> ModuleType:
    """Return the ``pipeline`` module. Raises ``MethodError`` if pycolmap or OpenCV is not installed."""
    try:
        from rebar_depth_bench.methods.multiview import pipeline
    except ImportError as error:
        raise MethodError(
            f"multi-view methods need pycolmap and OpenCV ({error}): pip install 'rebar-depth-bench[multiview]'"
        ) from None
    return pipeline


def _method(dense: str, scale_source: str) -> MultiViewMethod:
    def prepare(views: Views, work: Path, progress: Progress) -> Prepared:
        prepared: Prepared = _import_pipeline().prepare(views, work, progress, dense, scale_source)
        return prepared

    info = MethodInfo(
        name=f"{dense}-{scale_source}",
        summary=f"COLMAP's cameras from the left views, K known; {_DENSE_SUMMARIES[dense]}; "
        f"{_SCALE_SUMMARIES[scale_source]}",
        columns=(),
        uses_intrinsics=True,
        source="pycolmap" if dense == "colmap" else "pycolmap, and this project's plane sweep",
        licence="BSD-3-Clause" if dense == "colmap" else "BSD-3-Clause, Apache-2.0",
        uses_ground_truth=scale_source == "anchored",
        untested_note=_UNTESTED_NOTES[dense],
    )
    return MultiViewMethod(info, prepare, lambda views: _import_pipeline().check(views, dense, scale_source))


COLMAP_ARUCO, COLMAP_ANCHORED = _method("colmap", "aruco"), _method("colmap", "anchored")
SWEEP_ARUCO, SWEEP_ANCHORED = _method("sweep", "aruco"), _method("sweep", "anchored")
