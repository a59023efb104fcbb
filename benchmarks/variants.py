"""Levels of the pictures of appearance variants beside the standard look, and a sheet with one picture of each.

python -m benchmarks.variants ROOT [SHEET.png]

ROOT holds configs built with and without ``--variant``. The sheet has a tile for each config: the middle one of
its views, and below it the middle of the picture at full size, where noise can be seen.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

import rebar_depth_bench as rdb
from benchmarks.timing import print_markdown
from rebar_depth_bench.data.manifest import DatasetConfig, open_folder

TILE_PX = (480, 270)
"""Width and height of a tile, pixels."""
COLUMNS = 4
WHITE_LEVEL, BLACK_LEVEL = 250, 8


def main(root: str, sheet: str | None = None) -> None:
    configs = sorted(open_folder(root).config_by_name.values(), key=lambda config: config.name)
    pictures = {
        config.name: np.stack([row["left_rgb"] for row in rdb.load(root, config.name)]) for config in configs
    }
    headings = ["config", "mean level", "minus standard", "5 %", "95 %", "white, %", "black, %"]
    print_markdown(headings, [_row(config, pictures) for config in configs])
    if sheet is not None:
        tiles = [_tile(name, views[len(views) // 2]) for name, views in pictures.items()]
        _joined(tiles).save(Path(sheet))


def _row(config: DatasetConfig, pictures: Mapping[str, Any]) -> tuple[str, ...]:
    rgb = pictures[config.name]
    suffix = "".join(f"-{name}" for name in config.scene.appearance.variants)
    standard = pictures.get(config.name.removesuffix(suffix))
    low, high = np.percentile(rgb, (5, 95))
    return (
        config.name,
        f"{rgb.mean():.0f}",
        "-" if standard is None else f"{rgb.mean() - standard.mean():+.0f}",
        f"{low:.0f}",
        f"{high:.0f}",
        f"{100 * (rgb.min(axis=-1) >= WHITE_LEVEL).mean():.2f}",
        f"{100 * (rgb.max(axis=-1) <= BLACK_LEVEL).mean():.2f}",
    )


def _tile(name: str, rgb: Any) -> Image.Image:
    """Return a picture above its middle at full size, with the name of its config."""
    width, height = TILE_PX
    picture = Image.fromarray(rgb)
    tile = Image.new("RGB", (width, 2 * height))
    tile.paste(picture.resize(TILE_PX, Image.Resampling.LANCZOS), (0, 0))
    left, top = (picture.width - width) // 2, (picture.height - height) // 2
    tile.paste(picture.crop((left, top, left + width, top + height)), (0, height))
    ImageDraw.Draw(tile).text((4, 2), name, fill=(255, 255, 0))
    return tile


def _joined(tiles: list[Image.Image]) -> Image.Image:
    width, height = tiles[0].size
    sheet = Image.new("RGB", (width * min(COLUMNS, len(tiles)), height * -(-len(tiles) // COLUMNS)))
    for n, tile in enumerate(tiles):
        sheet.paste(tile, (n % COLUMNS * width, n // COLUMNS * height))
    return sheet


if __name__ == "__main__":
    main(*sys.argv[1:])
