"""Names of methods and submitters: normalisation, characters that are refused, and mixed scripts.

Names are compared and shown in Unicode normalisation form NFKC. Invisible characters and stacked combining marks
are refused, as in the restriction levels of Unicode Technical Standard #39; letters of several scripts, with which
a name can imitate another one, are allowed and marked.
"""

from __future__ import annotations

import unicodedata

MAX_MARKS = 2
"""Maximum number of successive combining marks; more overlap the lines above and below."""
_BLANK = frozenset("\u1680\u115f\u1160\u17b4\u17b5\u2800\u3164\uffa0\u034f\u061c\u180e\ufe0f")
"""Characters of visible categories that are drawn blank."""
_CONFUSED_SCRIPTS = frozenset({"LATIN", "CYRILLIC", "GREEK", "ARMENIAN", "CHEROKEE"})
"""Scripts with letters that look like those of another of them."""


def normalised(name: str) -> str:
    """Return the name in form NFKC without white space at its ends."""
    return unicodedata.normalize("NFKC", name).strip()


def name_problem(name: str) -> str | None:
    """Return what is wrong with a normalised name, or None."""
    marks = 0
    for character in name:
        category = unicodedata.category(character)
        if character in _BLANK or category in ("Cc", "Cf", "Cn", "Co", "Cs", "Zl", "Zp"):
            return f"it has the character U+{ord(character):04X}, which is invisible"
        marks = marks + 1 if category in ("Mn", "Me") else 0
        if marks > MAX_MARKS:
            return f"it has more than {MAX_MARKS} combining marks in succession"
    if not any(unicodedata.category(character)[0] in "LNSP" for character in name):
        return "it has no visible character"
    return None


def confused_scripts(name: str) -> list[str]:
    """Return the scripts of a name's letters if it mixes those that resemble each other, otherwise no script."""
    first_words = (unicodedata.name(character, "").partition(" ")[0] for character in name if character.isalpha())
    scripts = sorted(_CONFUSED_SCRIPTS.intersection(first_words))
    return [script.capitalize() for script in scripts] if len(scripts) > 1 else []
