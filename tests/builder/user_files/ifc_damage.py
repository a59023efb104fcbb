"""Seeded damage of IFC texts for tests: changed bytes and changed tokens."""

from __future__ import annotations

import random
import re

_TOKEN = re.compile(r"'(?:[^']|'')*'|#?[-+\w.]+|\S")
_NUMBER = re.compile(r"#?[-+]?\d+(\.\d*)?([Ee][-+]?\d+)?")
_CHARACTERS = "0123456789#$*().,;'=/AEc- \x00\xff\n"


def damaged_bytes(text: str, rng: random.Random) -> str:
    """Return the text with one character behind the header changed, removed or inserted."""
    position = rng.randrange(text.index("DATA;") + 5, len(text))
    kept = position + rng.randrange(2)
    return text[:position] + str(rng.choice(["", *_CHARACTERS])) + text[kept:]


def damaged_token(text: str, rng: random.Random) -> str:
    """Return the text with one token behind the header removed, repeated, exchanged for another or replaced."""
    tokens = list(_TOKEN.finditer(text, text.index("DATA;") + 5))
    token, other = rng.choice(tokens), rng.choice(tokens)
    replaced = rng.choice(
        ["", token[0] * 2, f"{token[0]},{token[0]}", other[0], "nan", "1.E999", "()", "#999999", "c1"]
    )
    return text[: token.start()] + str(replaced) + text[token.end() :]


def differs_in_values_only(text: str, damaged: str) -> bool:
    """Return whether all changed tokens are values of one kind before and after: another valid file.

    The kinds are numbers, references, strings and logical values; null (``$``) may be put for any of them and for
    other enumeration values, and the reverse.
    """
    before, after = _TOKEN.findall(text), _TOKEN.findall(damaged)
    return len(before) == len(after) and all(
        None not in (kinds := {_kind(first), _kind(second)}) and len(kinds - {"null"}) == 1
        for first, second in zip(before, after, strict=True)
        if first != second
    )


def _kind(token: str) -> str | None:
    if token in (".T.", ".F."):
        return "logical value"
    if token.startswith("."):
        return f"enumeration {token}"
    if token == "$":
        return "null"
    if token.startswith("'"):
        return "string"
    if _NUMBER.fullmatch(token):
        return "reference" if token.startswith("#") else "number"
    return None
