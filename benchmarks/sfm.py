"""Whether structure from motion recovers the true cameras, and the board their scale, from the rendered pictures.

python -m benchmarks.sfm ROOT [CONFIG]

COLMAP (pycolmap) gets the left pictures and the one true K, which it keeps, as in the methods ``colmap-*`` and
``sweep-*``. Where there is a board, its markers give scale and frame.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import pycolmap

from benchmarks.timing import machine, print_markdown
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.methods import ConfigViews
from rebar_depth_bench.methods.multiview.images import write_pictures
from rebar_depth_bench.methods.multiview.metric_scale import board_fit
from rebar_depth_bench.methods.multiview.pipeline import pictured_structure
from rebar_depth_bench.methods.multiview.pose_errors import placed_report, scaled_report, true_similarity


def main(root: str, config: str = "lattice-orbit") -> None:
    print(f"{config} of {root}; pycolmap {pycolmap.__version__}; {machine()}\n")
    views = ConfigViews(open_folder(root), config)
    with tempfile.TemporaryDirectory() as scratch:
        pictures = write_pictures(views, Path(scratch) / "images")
        start = time.perf_counter()
        structure = pictured_structure(views, pictures, Path(scratch))
        seconds = time.perf_counter() - start
    rows = [
        ("registered", f"{len(structure.cam_from_sfm)} of {len(pictures.names)}"),
        ("points", f"{len(structure.points)}"),
        ("mean reprojection error", f"{structure.reprojection_px:.3f} px"),
        ("features, matches, mapping", f"{seconds:.1f} s"),
    ]
    true = true_similarity(structure.cam_from_sfm, pictures.cam_from_world)
    found = scaled_report(structure.cam_from_sfm, pictures.cam_from_world, true.scale)
    rows += _told(found, "after the best similarity")
    if views.board is not None:
        fit = board_fit(pictures.markers, structure.cam_from_sfm, pictures.grid.K, views.board)
        found = placed_report(structure.cam_from_sfm, pictures.cam_from_world, fit.metric)
        rows += [
            ("markers", f"{len(fit.markers)} of {views.board.markers}, {1000 * fit.rms_m:.3f} mm rms"),
            ("scale from the board", f"{found['scale_error_percent']:+.4f} % off"),
            *_told(found, "in the board's frame"),
        ]
    print_markdown(["", ""], rows)


def _told(found: dict[str, dict[str, float]], frame: str) -> list[tuple[str, str]]:
    return [
        (f"{label}, {frame}", f"{found[key]['median']:.3f} {unit} median, {found[key]['largest']:.3f} largest")
        for label, key, unit in (
            ("centre error", "centre_error_mm", "mm"),
            ("rotation error", "rotation_error_deg", "deg"),
        )
    ]


if __name__ == "__main__":
    main(*sys.argv[1:])
