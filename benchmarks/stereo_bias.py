"""Bias of SGBM's disparity on steel and on other textured surfaces.

``python -m benchmarks.stereo_bias ROOT [VIEWS]`` prints, for each config, the median of predicted minus true
disparity f B / z, pixels, over some views, spread evenly (default: 6): of the method ``sgbm``, and of OpenCV's
matcher with the same parameters but without the filter and the check of both views. Errors of 5 px and more are
left out: they are false matches. Steel is what is scored; other surfaces are taken 6 px away from it, where the
image has horizontal gradients.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float64, UInt8
from numpy import ndarray
from scipy.ndimage import binary_dilation

from rebar_depth_bench.base.names import TEST_SPLIT
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.rows import iterate_rows
from rebar_depth_bench.methods import sgbm
from rebar_depth_bench.scoring.protocol import interior

COLUMNS = ("view_id", "left_rgb", "right_rgb", "left_depth", "left_mask", "left_K")
MAX_ERROR_PX = 5.0
MIN_GRADIENT = 20.0
"""Smallest horizontal Sobel gradient of other surfaces, of 8-bit grey; about 5 grey values a pixel."""
Errors = dict[tuple[str, str], list[Float64[ndarray, " n"]]]
"""Errors of disparity, pixels, by measurement and surface."""


def main(root: Path, views: int) -> int:
    """Print the table; return the exit status."""
    print("| config | surface | sgbm | matcher alone |\n|---|---|---|---|")
    for name, config in open_folder(root).config_by_name.items():
        ids = config.of_split(TEST_SPLIT).view_ids
        chosen = [ids[k * len(ids) // views] for k in range(min(views, len(ids)))]
        errors: Errors = {}
        for row in iterate_rows(config, (*COLUMNS, "baseline_m"), chosen):
            _add_errors(row, errors)
        for surface in ("steel", "other"):
            cells = [np.median(np.concatenate(errors[kind, surface])) for kind in ("sgbm", "raw")]
            print(f"| {name} | {surface} |", " | ".join(f"{cell:+.2f}" for cell in cells), "|")
    return 0


def _add_errors(row: Mapping[str, Any], errors: Errors) -> None:
    """Append the errors of one view."""
    depth_m, has_depth = row["left_depth"].astype(np.float64), row["left_depth"] > 0
    true_px = np.divide(
        row["left_K"][0, 0] * row["baseline_m"], depth_m, out=np.zeros_like(depth_m), where=has_depth
    )
    left = cv2.cvtColor(row["left_rgb"], cv2.COLOR_RGB2GRAY)
    is_textured = np.abs(cv2.Sobel(left, cv2.CV_64F, 1, 0)) > MIN_GRADIENT
    steel = row["left_mask"] > 0
    surfaces = {
        "steel": interior(steel) & has_depth,
        "other": ~binary_dilation(steel, iterations=6) & has_depth & is_textured,
    }
    filtered_px, right_px = sgbm.filtered_disparities_px(row["left_rgb"], row["right_rgb"])
    raw_px = _raw_disparity_px(row["left_rgb"], row["right_rgb"])
    measured = {
        "sgbm": (filtered_px - true_px, sgbm.left_right_consistent(filtered_px, right_px)),
        "raw": (raw_px - true_px, raw_px > 0),
    }
    for kind, (error_px, valid) in measured.items():
        for surface, pixels in surfaces.items():
            errors.setdefault((kind, surface), []).append(
                error_px[pixels & valid & (np.abs(error_px) < MAX_ERROR_PX)]
            )


def _raw_disparity_px(
    left_rgb: UInt8[ndarray, "h w 3"], right_rgb: UInt8[ndarray, "h w 3"]
) -> Float64[ndarray, "h w"]:
    """Return the disparity of OpenCV's matcher alone with the parameters of ``sgbm``, <= 0 where there is none."""
    width = left_rgb.shape[1]
    search_px = int(-(-width * sgbm.SEARCH_SHARE_OF_WIDTH // 16) * 16)
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=search_px,
        blockSize=sgbm.BLOCK_PX,
        P1=sgbm.SMALL_STEP_PENALTY * sgbm.BLOCK_PX**2,
        P2=sgbm.LARGE_STEP_PENALTY * sgbm.BLOCK_PX**2,
        preFilterCap=sgbm.PRE_FILTER_CAP,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    pair = [cv2.copyMakeBorder(rgb, 0, 0, search_px, 0, cv2.BORDER_REPLICATE) for rgb in (left_rgb, right_rgb)]
    return np.asarray(matcher.compute(*pair)[:, search_px:], np.float64) / 16


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        sys.exit("usage: python -m benchmarks.stereo_bias ROOT [VIEWS]")
    sys.exit(main(Path(sys.argv[1]), int(sys.argv[2]) if sys.argv[2:] else 6))
