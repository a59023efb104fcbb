"""Font of pictures of cages, which comes with the package: the same text width on every machine."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from io import BytesIO

from PIL import ImageFont

FONT_FILE = "DejaVuSans-subset.ttf"


@cache
def font(size_px: float) -> ImageFont.FreeTypeFont:
    """Return the font at a size in pixels."""
    content = files("dataset_builder.inspection").joinpath(FONT_FILE).read_bytes()
    return ImageFont.truetype(BytesIO(content), size_px, layout_engine=ImageFont.Layout.BASIC)


def text_width(text: str, size_px: float) -> float:
    """Return the width of a text in pixels."""
    return font(1000).getlength(text) * size_px / 1000


def shortened(text: str, size_px: float, width_px: float) -> str:
    """Return a text that fits into a width, an ellipsis in its middle if need be: names differ at the end."""
    if text_width(text, size_px) <= width_px:
        return text
    for kept in range(len(text) - 1, 1, -1):
        short = f"{text[: (kept + 1) // 2]}…{text[len(text) - kept // 2 :]}"
        if text_width(short, size_px) <= width_px:
            return short
    return "…"
