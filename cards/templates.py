"""Rendering of the cards' Jinja templates."""

from __future__ import annotations

from jinja2 import PackageLoader

from rebar_depth_bench.reporting.html.assets import environment


def render(template: str, **values: object) -> str:
    """Render a Markdown template of this package. Raises ``UndefinedError`` for an undefined name."""
    # The output is Markdown, and all values come from this project.
    markdown_environment = environment(PackageLoader("cards", ".")).overlay(autoescape=False)
    return markdown_environment.get_template(template).render(**values)
