"""Rendering of the cards' Jinja templates."""

from __future__ import annotations

import re
import textwrap

from jinja2 import PackageLoader

from rebar_depth_bench.reporting.html.assets import environment

_LINE_WIDTH = 120


def render(template: str, **values: object) -> str:
    """Render a template of this package, Markdown or YAML. Raises ``UndefinedError`` for an undefined name."""
    # The output is no HTML. In YAML, the template writes the texts of imported data as JSON strings.
    markdown_environment = environment(PackageLoader("cards", ".")).overlay(autoescape=False)
    return markdown_environment.get_template(template).render(**values)


def wrapped(markdown: str) -> str:
    """Return Markdown with paragraphs and list items filled to 120 columns, and one blank line between blocks."""
    blocks = re.split(r"(^```.*?^```$)|\n\n+", markdown, flags=re.DOTALL | re.MULTILINE)
    return "\n\n".join(filter(None, (_filled(block.strip("\n")) for block in blocks if block))) + "\n"


def _filled(block: str) -> str:
    """Return a block with full lines; code, tables, comments and headings stay as they are."""
    if block.startswith(("```", "|", "<", "#")):
        return block
    items = re.split(r"\n(?=- )", block)
    return "\n".join(
        textwrap.fill(
            # No line begins with a minus sign, which would begin a list.
            " ".join(item.split()).replace(" - ", "\0- "),
            _LINE_WIDTH,
            subsequent_indent="  " if item.startswith("- ") else "",
            break_long_words=False,
            break_on_hyphens=False,
        ).replace("\0", " ")
        for item in items
    )
