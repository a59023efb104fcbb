"""JSON that people can read: a short head, then a long list with one entry a line."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

_EMPTY_END = "[]\n}"


def json_lines(head: Mapping[str, Any], name: str, entries: Sequence[Mapping[str, Any]]) -> str:
    """Return ``head`` as a JSON object with one more member ``name``: the list of ``entries``, a line each."""
    outline = json.dumps({**head, name: []}, indent=1, allow_nan=False).removesuffix(_EMPTY_END)
    lines = ",\n".join(json.dumps(entry, allow_nan=False) for entry in entries)
    return f"{outline}[\n{lines}\n]}}\n"
