"""Elements of a drawing in points (1/72 inch), x to the right and y down, and the width of its texts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from io import BytesIO
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont

Point = tuple[float, float]
INK, GREY, PALE, PAPER = "#000000", "#595959", "#d9d9d9", "#ffffff"
FONT_FILE = "DejaVuSans-subset.ttf"


@dataclass(frozen=True)
class Path:
    """Line through points, or a closed shape; ``dash`` are the lengths of dashes and gaps, none if empty."""

    points: tuple[Point, ...]
    stroke: str | None = INK
    width: float = 0.75
    fill: str | None = None
    dash: tuple[float, ...] = ()
    closed: bool = False


@dataclass(frozen=True)
class Text:
    """Line of text whose baseline starts, has its middle or ends at ``at``; ``turned`` text reads upwards."""

    at: Point
    content: str
    size: float
    anchor: Literal["start", "middle", "end"] = "start"
    turned: bool = False
    colour: str = INK


@dataclass(frozen=True)
class Marker:
    """Group of paths around ``at``, with what it stands for: a class name and a description."""

    at: Point
    role: str
    description: str
    paths: tuple[Path, ...]


Element = Path | Text | Marker


@dataclass(frozen=True)
class Drawing:
    """Drawing of a size, with title and description for screen readers, and its elements from back to front."""

    width: float
    height: float
    title: str
    description: str
    elements: tuple[Element, ...]


@cache
def font(size_px: float) -> FreeTypeFont:
    """Return the font of figures, which comes with the package: the same text width on every machine."""
    from PIL import ImageFont

    content = files("rebar_depth_bench.reporting.figure").joinpath(FONT_FILE).read_bytes()
    return ImageFont.truetype(BytesIO(content), size_px, layout_engine=ImageFont.Layout.BASIC)


def text_width(text: str, size: float) -> float:
    """Return the width of a text in points."""
    return font(1000).getlength(text) * size / 1000


def wrapped(text: str, size: float, width: float) -> list[str]:
    """Return a text in lines of at most ``width`` points; a longer word gets a line of its own."""
    lines: list[str] = []
    for word in text.split(" "):
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and text_width(longer, size) <= width:
            lines[-1] = longer
        else:
            lines.append(word)
    return lines


def shortened(text: str, size: float, width: float) -> str:
    """Return a text that fits into ``width``, an ellipsis in its middle if need be: names differ at the end."""
    if text_width(text, size) <= width:
        return text
    for kept in range(len(text) - 1, 1, -1):
        short = f"{text[: (kept + 1) // 2]}…{text[len(text) - kept // 2 :]}"
        if text_width(short, size) <= width:
            return short
    return "…"
