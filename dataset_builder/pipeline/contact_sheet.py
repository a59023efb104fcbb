"""Overview pictures of a dataset folder: a contact sheet per config, and a strip of its scenes."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from jaxtyping import UInt8
from numpy import ndarray
from PIL import Image, ImageDraw

from dataset_builder.cameras.trajectories import subset
from rebar_depth_bench.base.writing import write_bytes
from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.data.rows import iterate_rows

TILE_PX = (320, 180)
"""Width and height of a tile, pixels."""
COLUMNS = 6
SHEET_VIEWS = 12
STRIP_PANEL_PX = (640, 360)
"""Width and height of a panel of the strip, pixels."""
_BACKGROUND = (24, 24, 24)
_SHOWN_COLUMNS = ("view_id", "left_rgb", "left_preview")


def write_contact_sheet(config: DatasetConfig, target: Path) -> None:
    """Write a WebP of up to ``SHEET_VIEWS`` views spread evenly over a config: colour above the depth preview.

    A config without colour has the depth preview only.
    Raises ``DatasetError`` if a shard is damaged.
    """
    positions = subset(len(config.views), SHEET_VIEWS)
    width, height = TILE_PX
    lines = -(-len(positions) // COLUMNS)
    shown = ("left_rgb", "left_preview") if config.colour is not None else ("left_preview",)
    line_height = len(shown) * height
    sheet = Image.new("RGB", (width * min(COLUMNS, len(positions)), line_height * lines), _BACKGROUND)
    for n, row in enumerate(_decoded_rows(config, positions)):
        left, top = n % COLUMNS * width, n // COLUMNS * line_height
        tiles = [_letterboxed(row[column], TILE_PX) for column in shown]
        _draw_label(tiles[0], row["view_id"].partition("/")[2])
        for position, tile in enumerate(tiles):
            sheet.paste(tile, (left, top + position * height))
    _save_webp(sheet, target)


def write_scenes_strip(configs: Sequence[DatasetConfig], target: Path) -> None:
    """Write a WebP with one view per config, in colour if it has any: the view with the median steel pixels.

    Raises ``DatasetError`` if a shard is damaged.
    """
    strip = Image.new("RGB", (STRIP_PANEL_PX[0] * len(configs), STRIP_PANEL_PX[1]), _BACKGROUND)
    for n, config in enumerate(configs):
        by_steel = sorted(range(len(config.views)), key=lambda index: config.views[index].steel_px or 0)
        [row] = _decoded_rows(config, [by_steel[len(by_steel) // 2]])
        picture = row["left_rgb" if config.colour is not None else "left_preview"]
        strip.paste(_letterboxed(picture, STRIP_PANEL_PX), (n * STRIP_PANEL_PX[0], 0))
    _save_webp(strip, target)


def _decoded_rows(config: DatasetConfig, positions: Sequence[int]) -> Iterator[dict[str, Any]]:
    """Yield view id, colour and depth preview of the views at ``positions``; other scenes are not opened."""
    return iterate_rows(config, _SHOWN_COLUMNS, [config.views[position].view_id for position in positions])


def _letterboxed(rgb: UInt8[ndarray, "h w 3"], size: tuple[int, int]) -> Image.Image:
    """Return an image, scaled to fit ``size`` (width, height) and padded to that size."""
    picture = Image.fromarray(rgb)
    scale = min(size[0] / picture.width, size[1] / picture.height)
    resized = picture.resize(
        (max(1, round(picture.width * scale)), max(1, round(picture.height * scale))), Image.Resampling.LANCZOS
    )
    canvas = Image.new("RGB", size, _BACKGROUND)
    canvas.paste(resized, ((size[0] - resized.width) // 2, (size[1] - resized.height) // 2))
    return canvas


def _draw_label(tile: Image.Image, label: str) -> None:
    draw = ImageDraw.Draw(tile)
    draw.rectangle((0, 0, 9 + 6 * len(label), 14), fill=_BACKGROUND)
    draw.text((4, 1), label, fill=(240, 240, 240))


def _save_webp(picture: Image.Image, target: Path) -> None:
    stream = io.BytesIO()
    picture.save(stream, "WEBP", quality=82)
    write_bytes(target, stream.getvalue())
