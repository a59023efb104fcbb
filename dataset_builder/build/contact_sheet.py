"""The pictures that a dataset folder shows of itself: a contact sheet per config, its scenes side by side."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
from PIL import Image, ImageDraw

from dataset_builder.config.trajectories import subset
from rebar_depth_bench.atomic_io import write_bytes

TILE_PX = (320, 180)
COLUMNS = 6
SHEET_VIEWS = 12
STRIP_PANEL_PX = (640, 360)
_BACKGROUND = (24, 24, 24)


def write_contact_sheet(root: Path, shards: Sequence[str], target: Path) -> None:
    """Write up to ``SHEET_VIEWS`` views spread evenly over a config: colour, and its depth preview below it."""
    rows = _rows(root, shards, subset(_count(root, shards), SHEET_VIEWS))
    width, height = TILE_PX
    lines = -(-len(rows) // COLUMNS)
    sheet = Image.new("RGB", (width * min(COLUMNS, len(rows)), 2 * height * lines), _BACKGROUND)
    for n, row in enumerate(rows):
        left, top = n % COLUMNS * width, n // COLUMNS * 2 * height
        sheet.paste(_labelled(_fitted(row["left_rgb"], TILE_PX), row["view_id"].partition("/")[2]), (left, top))
        sheet.paste(_fitted(row["left_preview"], TILE_PX), (left, top + height))
    _save(sheet, target)


def write_scenes_strip(root: Path, configs: Sequence[Mapping[str, Any]], target: Path) -> None:
    """Write one colour view of each config (a manifest's entry) side by side: the one with median steel."""
    strip = Image.new("RGB", (STRIP_PANEL_PX[0] * len(configs), STRIP_PANEL_PX[1]), _BACKGROUND)
    for n, entry in enumerate(configs):
        by_steel = sorted(range(len(entry["views"])), key=lambda index: entry["views"][index]["steel_px"])
        [row] = _rows(root, entry["shards"], [by_steel[len(by_steel) // 2]])
        strip.paste(_fitted(row["left_rgb"], STRIP_PANEL_PX), (n * STRIP_PANEL_PX[0], 0))
    _save(strip, target)


def _count(root: Path, shards: Sequence[str]) -> int:
    return sum(pq.read_metadata(root / shard).num_rows for shard in shards)


def _rows(root: Path, shards: Sequence[str], wanted: Sequence[int]) -> list[dict[str, Any]]:
    """Return the view id and pictures of some rows of a config, counted over all its shards."""
    rows, first = [], 0
    for shard in shards:
        file = pq.ParquetFile(root / shard)
        here = [index - first for index in wanted if first <= index < first + file.metadata.num_rows]
        for index in here:  # a row group a view
            table = file.read_row_group(index, columns=["view_id", "left_rgb", "left_preview"])
            rows += table.to_pylist()
        first += file.metadata.num_rows
    return rows


def _fitted(cell: Mapping[str, Any], size: tuple[int, int]) -> Image.Image:
    """Return an image column's picture as large as ``size`` allows, on a ground of exactly that size."""
    picture = Image.open(io.BytesIO(cell["bytes"])).convert("RGB")
    scale = min(size[0] / picture.width, size[1] / picture.height)
    fitted = picture.resize(
        (max(1, round(picture.width * scale)), max(1, round(picture.height * scale))), Image.Resampling.LANCZOS
    )
    ground = Image.new("RGB", size, _BACKGROUND)
    ground.paste(fitted, ((size[0] - fitted.width) // 2, (size[1] - fitted.height) // 2))
    return ground


def _labelled(tile: Image.Image, label: str) -> Image.Image:
    draw = ImageDraw.Draw(tile)
    draw.rectangle((0, 0, 9 + 6 * len(label), 14), fill=_BACKGROUND)
    draw.text((4, 1), label, fill=(240, 240, 240))
    return tile


def _save(picture: Image.Image, target: Path) -> None:
    stream = io.BytesIO()
    picture.save(stream, "WEBP", quality=82)
    write_bytes(target, stream.getvalue())
