"""Multi-view methods: structure from motion on the left views, metric scale and dense depth.

There are four methods. Cameras are always estimated by COLMAP. Dense depth is computed by COLMAP's PatchMatch, as
in the paper (needs CUDA), or by this project's plane sweep on the CPU, which is not part of COLMAP. Metric scale
comes from the ArUco board, or from the median of ground truth, which is not a metric result (the paper's dagger).
"""

from __future__ import annotations

import importlib
from pathlib import Path

from rebar_depth_bench.base.parallel import Progress
from rebar_depth_bench.data.rows import Views
from rebar_depth_bench.methods.base import MethodInfo, MultiViewMethod, Prepared, import_optional

PIPELINE = "rebar_depth_bench.methods.multiview.pipeline"
"""Module that needs pycolmap and OpenCV; it is imported when a method is used."""


def _method(name: str, *, uses_patch_match: bool, is_anchored: bool) -> MultiViewMethod:
    choices = {"uses_patch_match": uses_patch_match, "is_anchored": is_anchored}

    def check(views: Views) -> None:
        pipeline = import_optional(PIPELINE, "multi-view methods need pycolmap and OpenCV", "multiview")
        pipeline.check(views, name, **choices)

    def prepare(views: Views, work: Path, progress: Progress) -> Prepared:
        prepared: Prepared = importlib.import_module(PIPELINE).prepare(views, work, progress, **choices)
        return prepared

    if uses_patch_match:
        dense, source, licence = "COLMAP's PatchMatch, which needs CUDA", "pycolmap", "BSD-3-Clause"
        untested_note = "PatchMatch is not tested: no CUDA GPU was available"
    else:
        dense, source = (
            "a plane sweep on the CPU, which is not COLMAP's",
            "pycolmap, and this project's plane sweep",
        )
        licence, untested_note = "BSD-3-Clause, Apache-2.0", ""
    scale = "median-anchored to ground truth, no metric result" if is_anchored else "metres from the ArUco board"
    info = MethodInfo(
        name=name,
        summary=f"COLMAP's cameras from the left views, K known; dense depth by {dense}; {scale}",
        columns=(),
        uses_intrinsics=True,
        source=source,
        licence=licence,
        uses_ground_truth=is_anchored,
        untested_note=untested_note,
    )
    return MultiViewMethod(info, prepare, check)


COLMAP_ARUCO = _method("colmap-aruco", uses_patch_match=True, is_anchored=False)
COLMAP_ANCHORED = _method("colmap-anchored", uses_patch_match=True, is_anchored=True)
SWEEP_ARUCO = _method("sweep-aruco", uses_patch_match=False, is_anchored=False)
SWEEP_ANCHORED = _method("sweep-anchored", uses_patch_match=False, is_anchored=True)
