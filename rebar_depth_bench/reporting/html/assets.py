"""The page's one inline script and the policy that lets this script run and nothing else.

The templates of the pages: every value escaped, no undefined name passed over.
"""

from __future__ import annotations

import base64
import hashlib
from dataclasses import dataclass
from importlib.resources import files

from jinja2 import BaseLoader, ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup


@dataclass(frozen=True)
class InlineScript:
    """``text`` stands between the script's tags as it is; ``policy`` is the page's Content-Security-Policy."""

    text: Markup
    policy: str


def inline_script(*names: str) -> InlineScript:
    """Return the scripts of this package of these ``names`` as one, and a policy that allows it by its digest.

    The policy follows W3C Content Security Policy Level 3, section 2.3.1 (hash source): no other script, no
    request, images from the page itself.
    """
    folder = files("rebar_depth_bench.reporting.html")
    text = "\n" + "".join(folder.joinpath(name).read_text(encoding="utf-8") for name in names)
    digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    policy = f"default-src 'none'; script-src 'sha256-{digest}'; img-src data:; style-src 'unsafe-inline'"
    return InlineScript(Markup(text), policy)


def environment(*loaders: BaseLoader) -> Environment:
    """Return the environment that pages are rendered in: templates of ``loaders``, then the report's."""
    return Environment(
        loader=ChoiceLoader([*loaders, PackageLoader("rebar_depth_bench.reporting", "html")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
