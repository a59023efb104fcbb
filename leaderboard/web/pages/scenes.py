"""Pictures of the dataset's configs: the left image of the first view, reduced."""

from __future__ import annotations

import io

from PIL import Image

from rebar_depth_bench.data.dataset import iterate_undecoded
from rebar_depth_bench.data.decoding import RowDecoder
from rebar_depth_bench.data.manifest import DatasetFolder

PICTURE_WIDTH = 480


def scene_webp(folder: DatasetFolder, config: str) -> bytes | None:
    """Return the picture of a config as WebP, or None if the config has no colour.

    Raises ``DatasetError`` if the shard cannot be read.
    """
    shown = folder.config(config)
    decoder = RowDecoder.of(shown)
    row = next(iter(iterate_undecoded(shown, ("view_id", "left_rgb"))), None)
    rgb = None if row is None else decoder.row(row)["left_rgb"]
    if rgb is None:
        return None
    image = Image.fromarray(rgb)
    image.thumbnail((PICTURE_WIDTH, PICTURE_WIDTH))
    out = io.BytesIO()
    image.save(out, "WEBP", quality=80)
    return out.getvalue()
