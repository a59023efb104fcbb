"""README picture: colour, depth and bar ids of one view of a dataset folder, side by side.

python scripts/readme_picture.py ROOT docs/lattice.webp
"""

from __future__ import annotations

import sys

import numpy as np
from PIL import Image

import rebar_depth_bench as rdb
from rebar_depth_bench.reporting.colormap import DEPTH_COLOURS, colour_indices

PANEL = (640, 360)
VIEW = 0


def main(root: str, target: str) -> None:
    """Write the picture of the dataset folder ``root`` to the WebP file ``target``."""
    row = rdb.load(root, "lattice", columns=["left_rgb", "left_depth", "left_bars"])[VIEW]
    steel = row["left_bars"] > 0
    near_m, far_m = row["left_depth"][steel].min(), row["left_depth"][steel].max()
    depth = DEPTH_COLOURS[colour_indices(-row["left_depth"], -far_m, -near_m)]
    hues = np.random.default_rng(1).integers(70, 240, (np.iinfo(np.uint16).max + 1, 3)).astype(np.uint8)
    bars = np.where(steel[..., None], hues[row["left_bars"]], np.uint8(24))
    panels = [
        Image.fromarray(panel).resize(PANEL, Image.Resampling.LANCZOS) for panel in (row["left_rgb"], depth, bars)
    ]
    strip = Image.new("RGB", (PANEL[0] * len(panels), PANEL[1]))
    for n, panel in enumerate(panels):
        strip.paste(panel, (n * PANEL[0], 0))
    strip.save(target, "WEBP", quality=82)


if __name__ == "__main__":
    main(*sys.argv[1:])
