"""Drawings as SVG. The same drawing gives the same bytes: no dates, no random ids."""

from __future__ import annotations

from collections.abc import Sequence

from markupsafe import escape

from rebar_depth_bench.reporting.figure.drawing import PAPER, Drawing, Element, Marker, Path, Point, Text

_FONTS = "DejaVu Sans, Verdana, Arial, sans-serif"


def svg_bytes(drawing: Drawing) -> bytes:
    """Return a drawing as an SVG document, whose size is that in print."""
    width, height = _number(drawing.width), _number(drawing.height)
    body = "\n".join(_element(element) for element in drawing.elements)
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}pt" height="{height}pt" '
        f'viewBox="0 0 {width} {height}" role="img" font-family="{_FONTS}" xml:space="preserve">\n'
        f"<title>{escape(drawing.title)}</title>\n<desc>{escape(drawing.description)}</desc>\n"
        f'<rect width="{width}" height="{height}" fill="{PAPER}"/>\n{body}\n</svg>\n'
    ).encode()


def _element(element: Element) -> str:
    if isinstance(element, Path):
        return _path(element)
    if isinstance(element, Text):
        return _text(element)
    return _marker(element)


def _marker(marker: Marker) -> str:
    paths = "".join(map(_path, marker.paths))
    return (
        f'<g class="{escape(marker.role)}" transform="translate({_pair(marker.at)})">'
        f"<title>{escape(marker.description)}</title>{paths}</g>"
    )


def _path(path: Path) -> str:
    stroke = f' stroke="{path.stroke}" stroke-width="{_number(path.width)}"' if path.stroke else ""
    dash = f' stroke-dasharray="{_numbers(path.dash)}"' if path.dash else ""
    data = "M" + "L".join(map(_pair, path.points)) + ("Z" if path.closed else "")
    return f'<path d="{data}" fill="{path.fill or "none"}"{stroke}{dash}/>'


def _text(text: Text) -> str:
    anchor = f' text-anchor="{text.anchor}"' if text.anchor != "start" else ""
    turned = f' transform="rotate(-90 {_pair(text.at)})"' if text.turned else ""
    x, y = map(_number, text.at)
    return (
        f'<text x="{x}" y="{y}" font-size="{_number(text.size)}" fill="{text.colour}"{anchor}{turned}>'
        f"{escape(text.content)}</text>"
    )


def _pair(point: Point) -> str:
    return _numbers(point)


def _numbers(values: Sequence[float]) -> str:
    return " ".join(map(_number, values))


def _number(value: float) -> str:
    return f"{round(value, 3) + 0:g}"
