"""Rendering of the cards' Jinja templates."""

from __future__ import annotations

from jinja2 import Environment, PackageLoader, StrictUndefined


def render(template: str, **values: object) -> str:
    """Render a Markdown template of this package. Raises ``UndefinedError`` for an undefined name."""
    environment = Environment(
        loader=PackageLoader("cards", "."),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,  # The output is Markdown, and all values come from this project.
    )
    return environment.get_template(template).render(**values)
