"""Words that several parts share."""

from __future__ import annotations

import re


def without_password(url: str) -> str:
    """Return a URL as it may be shown: without what stands before its host."""
    return re.sub(r"://.*@", "://...@", url)
