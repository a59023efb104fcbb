"""What every inline SVG chart is made of: the picture's frame and escaped text."""

from __future__ import annotations

from markupsafe import Markup, escape

WIDTH = 460
"""View box width: small enough that 13 px text stays readable when a phone shrinks the chart."""


def svg_figure(title: str, description: str, height: float, body: str) -> Markup:
    """Return a chart ``WIDTH`` wide with its title and its description in words; ``body`` is markup."""
    return Markup(
        f'<svg class="chart" role="img" viewBox="0 0 {WIDTH} {height:g}">'
        f"<title>{escape(title)}</title><desc>{escape(description)}</desc>{body}</svg>"
    )


def svg_text(x: float, y: float, content: str, classes: str = "start") -> str:
    """Return ``content``, escaped, hung at ``x`` by ``classes``: start, middle or end."""
    return f'<text class="{classes}" x="{x:g}" y="{y:g}">{escape(content)}</text>'
