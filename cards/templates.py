"""Loads the cards' templates."""

from __future__ import annotations

from jinja2 import Environment, PackageLoader, StrictUndefined


def render(template: str, **values: object) -> str:
    """Render a Markdown template of this package; an undefined name is an error."""
    environment = Environment(
        loader=PackageLoader("cards", "."),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,  # Markdown, from our own values only
    )
    return environment.get_template(template).render(**values)
