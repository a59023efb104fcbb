"""The templates of the pages: every value escaped, no undefined name passed over."""

from __future__ import annotations

from jinja2 import Environment, PackageLoader, StrictUndefined


def environment() -> Environment:
    """Return the environment that both the report and the studies' pages are rendered in."""
    return Environment(
        loader=PackageLoader("rebar_depth_bench", "report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
