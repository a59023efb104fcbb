"""Redaction of secrets in text that is logged or printed."""

from __future__ import annotations

import re


def without_password(url: str) -> str:
    """Return ``url`` with the user name and password before its host replaced by ``...``."""
    return re.sub(r"://.*@", "://...@", url)
