"""Accuracy of structure from motion on the rendered images: camera poses, and scale from the marker board.

python -m benchmarks.sfm ROOT [CONFIG]

COLMAP (pycolmap) receives the left images and their true K, which stays fixed, as in the methods ``colmap-*`` and
``sweep-*``. In scenes with a marker board, its markers define scale and frame.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import pycolmap

from benchmarks.timing import machine_description, print_markdown
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.methods import ConfigViews
from rebar_depth_bench.methods.multiview.pipeline import (
    camera_errors,
    fit_board,
)
from rebar_depth_bench.methods.multiview.sfm import reconstruct, write_left_images


def main(root: str, config: str = "lattice-orbit") -> None:
    print(f"{config} of {root}; pycolmap {pycolmap.__version__}; {machine_description()}\n")
    views = ConfigViews(open_folder(root).config(config))
    with tempfile.TemporaryDirectory() as scratch:
        pictures = write_left_images(views, Path(scratch) / "images")
        start = time.perf_counter()
        structure = reconstruct(pictures, views.board, Path(scratch))
        seconds = time.perf_counter() - start
    rows = [
        ("registered", f"{len(structure.cam_from_sfm)} of {len(pictures.names)}"),
        ("points", f"{len(structure.points)}"),
        ("mean reprojection error", f"{structure.reprojection_px:.3f} px"),
        ("features, matches, mapping", f"{seconds:.1f} s"),
    ]
    report = camera_errors(structure.cam_from_sfm, pictures.cam_from_world, scale_m=1.0)
    rows += _error_rows(report, "after the best similarity")
    if views.board is not None:
        fit = fit_board(pictures.markers, structure.cam_from_sfm, pictures.grid.K, views.board)
        report = camera_errors(structure.cam_from_sfm, pictures.cam_from_world, fit.metric.scale, fit.metric)
        rows += [
            ("markers", f"{len(fit.markers)} of {views.board.markers}, {1000 * fit.rms_m:.3f} mm rms"),
            ("scale from the board", f"{report['scale_error_percent']:+.4f} % off"),
            *_error_rows(report, "in the board's frame"),
        ]
    print_markdown(["", ""], rows)


def _error_rows(report: dict[str, dict[str, float]], frame: str) -> list[tuple[str, str]]:
    return [
        (f"{label}, {frame}", f"{report[key]['median']:.3f} {unit} median, {report[key]['largest']:.3f} largest")
        for label, key, unit in (
            ("centre error", "centre_error_mm", "mm"),
            ("rotation error", "rotation_error_deg", "deg"),
        )
    ]


if __name__ == "__main__":
    main(*sys.argv[1:])
