"""Parsing and validation of ``submission.json``, the metadata of a submission."""

from __future__ import annotations

import math
from typing import Annotated, Any
from urllib.parse import urlsplit

from pydantic import ConfigDict

from rebar_depth_bench.errors import Problem
from rebar_depth_bench.reading import parse_json
from rebar_depth_bench.validation import Expected, Flag, StrictModel, text, validate_table

METADATA_NAME = "submission.json"
DEPTH_SCALE = f"{METADATA_NAME}: depth_scale"
"""Location of the key that an archive with PNG entries requires."""
MAX_METADATA_BYTES = 4 * 1024 * 1024
MAX_METHOD_CHARACTERS = 200
_MAX_URL_CHARACTERS = 2000


def is_http_url(url: str) -> bool:
    """Return whether ``url`` is a printable HTTP or HTTPS address of at most 2000 characters."""
    try:
        parts = urlsplit(url)
        valid = parts.scheme in ("http", "https") and bool(parts.hostname)
    except ValueError:
        return False
    return valid and url.isprintable() and " " not in url and len(url) <= _MAX_URL_CHARACTERS


# PostgreSQL cannot store NUL.
_Description = Annotated[str, Expected("text without NUL", lambda value: "\0" not in value)]
_HttpUrl = Annotated[
    str,
    Expected(
        f"an http:// or https:// address without spaces, at most {_MAX_URL_CHARACTERS} characters", is_http_url
    ),
]
_Scale = Annotated[
    float, Expected("a finite number of metres per unit above 0", lambda value: 0 < value < math.inf)
]
_Runtime = Annotated[dict[Any, Any] | str | int | float, Expected("an object, text or a number")]


class SubmissionMeta(StrictModel):
    """Values declared in ``submission.json``; None where a key is absent. Unknown keys are ignored.

    ``depth_scale`` is in metres per unit of a PNG value. ``runtime`` is the author's own report, kept unchanged;
    nothing is computed from it.
    """

    model_config = ConfigDict(extra="ignore")

    method: Annotated[str, text(MAX_METHOD_CHARACTERS, "a printable name")]
    description: _Description | None = None
    url: _HttpUrl | None = None
    uses_intrinsics: Flag | None = None
    depth_scale: _Scale | None = None
    runtime: _Runtime | None = None


def parse_metadata(data: bytes) -> tuple[SubmissionMeta | None, list[Problem]]:
    """Return the validated content of ``submission.json``, or None and all its problems; null means absent."""
    if len(data) > MAX_METADATA_BYTES:
        return None, [Problem("size", METADATA_NAME, "it is too large", f"at most {MAX_METADATA_BYTES} bytes")]
    values, problems = parse_json(data, METADATA_NAME)
    if problems:
        return None, problems
    if not isinstance(values, dict):
        expected = 'an object like {"method": "name"}'
        return None, [Problem("invalid", METADATA_NAME, "the JSON is not an object", expected)]
    present = {key: value for key, value in values.items() if value is not None}
    return validate_table(SubmissionMeta, present, problems, f"{METADATA_NAME}:"), problems
