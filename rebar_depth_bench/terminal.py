"""Plain replacements of characters that a terminal cannot show, in place of an error.

A terminal that is not UTF-8 (``LC_ALL=C``, code page 1252) lacks arrows and mathematical signs; no terminal shows
the undecodable bytes of a file name. Files are always UTF-8.
"""

from __future__ import annotations

import codecs
import io
import sys
import unicodedata

_REPLACEMENTS = str.maketrans(
    {
        "↓": "v",
        "↑": "^",
        "→": ">",
        "−": "-",
        "–": "-",
        "—": "-",
        "×": "x",
        "±": "+-",
        "†": "+",
        "‡": "#",
        "§": "$",
        "δ": "d",
        "µ": "u",
        "μ": "u",
        "°": " deg",
        "∞": "inf",
        "…": "...",
        "≤": "<=",
        "≥": ">=",
        "\N{REPLACEMENT CHARACTER}": "?",
    }
)
"""Replacements by character; those of headings and marks have one character, so that columns stay aligned."""


def use_plain_characters() -> None:
    """Let standard output and standard error replace characters that their encoding lacks."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors=_HANDLER)


def plain_characters(text: str) -> str:
    """Return text in ASCII: known signs by name or look, letters without their accents, ``?`` for all others."""
    decomposed = unicodedata.normalize("NFKD", text.translate(_REPLACEMENTS))
    kept = (character for character in decomposed if not unicodedata.combining(character))
    return "".join(character if character.isascii() else "?" for character in kept)


def _replace_unencodable(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return plain_characters(error.object[error.start : error.end]), error.end


_HANDLER = "rebar-plain"
codecs.register_error(_HANDLER, _replace_unencodable)
