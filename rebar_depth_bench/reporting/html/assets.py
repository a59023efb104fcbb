"""Inline script with its Content-Security-Policy, and the Jinja environment of the pages."""

from __future__ import annotations

import base64
import hashlib
from dataclasses import dataclass
from importlib.resources import files

from jinja2 import BaseLoader, ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from rebar_depth_bench.base.errors import printable
from rebar_depth_bench.scoring import columns, formatting


@dataclass(frozen=True)
class InlineScript:
    """Script of a page: ``text`` is its unescaped source, ``policy`` the page's Content-Security-Policy."""

    text: Markup
    policy: str


def inline_script(*names: str) -> InlineScript:
    """Return the concatenated scripts ``names`` of this package, and a policy that allows them by digest.

    The policy uses a hash source (W3C Content Security Policy Level 3, section 2.3.1). It forbids other scripts
    and all requests; images must be data URIs.
    """
    folder = files("rebar_depth_bench.reporting.html")
    text = "\n" + "".join(folder.joinpath(name).read_text(encoding="utf-8") for name in names)
    digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    policy = f"default-src 'none'; script-src 'sha256-{digest}'; img-src data:; style-src 'unsafe-inline'"
    return InlineScript(Markup(text), policy)  # noqa: S704 -- Scripts of this package.


def environment(*loaders: BaseLoader) -> Environment:
    """Return the Jinja environment of pages, which looks templates up in ``loaders``, then in this package.

    All values are escaped, and undefined names raise an error. Templates make the cells of tables from
    ``columns``.
    """
    pages = Environment(
        loader=ChoiceLoader([*loaders, PackageLoader("rebar_depth_bench.reporting", "html")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    pages.globals.update(columns=columns, dash_note=formatting.DASH_NOTE, reference_note=formatting.REFERENCE_NOTE)
    pages.filters.update(data_uri=data_uri, printable=printable, thousands=thousands)
    return pages


def data_uri(image: bytes, kind: str) -> str:
    """Return an encoded image as a data URI; ``kind`` is the part of its media type after ``image/``."""
    return f"data:image/{kind};base64,{base64.b64encode(image).decode()}"


def thousands(count: int) -> str:
    """Return a number with spaces between its thousands."""
    return f"{count:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")
