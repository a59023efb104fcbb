"""The templates of the pages: every value escaped, no undefined name passed over."""

from __future__ import annotations

from jinja2 import BaseLoader, ChoiceLoader, Environment, PackageLoader, StrictUndefined


def environment(*loaders: BaseLoader) -> Environment:
    """Return the environment that pages are rendered in: templates of ``loaders``, then the report's."""
    return Environment(
        loader=ChoiceLoader([*loaders, PackageLoader("rebar_depth_bench", "report")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
