"""Lines of keys in text files, for problems whose location is a key: TOML, INI, YAML, JSON and XML."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice

from rebar_depth_bench.errors import Problem

_LOCATION_PART = re.compile(r"([^\s.:]+)(?: (\d+)(?::|$))?")
"""Key of a location as ``validation.format_location`` writes it, and the index of a table with that key."""
_MAX_TEXT_CHARACTERS = 1_000_000


def with_lines(problems: Sequence[Problem], content: bytes, name: str = "") -> list[Problem]:
    """Return problems whose key occurs in the content of a file with its line, "line 3: got ...".

    ``name`` is that of the file if locations begin with it; problems of other files are left as they are.
    """
    text = content[:_MAX_TEXT_CHARACTERS].decode("utf-8", "replace")
    located = []
    for problem in problems:
        is_here = problem.where.startswith(f"{name}: ") if name else bool(problem.where)
        line = key_line(text, problem.where[len(name) :].removeprefix(": ")) if is_here else None
        if line is not None and not problem.found.startswith("line "):
            problem = replace(problem, found=f"line {line}: {problem.found}")
        located.append(problem)
    return located


def key_line(text: str, where: str) -> int | None:
    """Return the number of the line of the key at a location, from 1, or None if the text has no such key.

    Keys are searched in the order of the location, each after its table; commented lines are left out. The n-th
    item of a list is the n-th table of that name, or else in the line of the list.
    """
    position = 0
    for name, index in _LOCATION_PART.findall(where):
        matches = list(islice(_keys(text, name, position), int(index or 1)))
        if not matches:
            return None
        position = matches[-1 if len(matches) == int(index or 1) else 0].end()
    return 1 + text.count("\n", 0, position) if position else None


def _keys(text: str, name: str, position: int) -> Iterator[re.Match[str]]:
    """Yield the matches of ``[key]``, ``key =``, ``"key":`` and ``<key`` after ``position``, up to their ends."""
    key = re.escape(name)
    pattern = re.compile(rf"<{key}(?![\w.-])|(?<![\w-]){key}(?=[\"']?\s*[\].:=])", re.IGNORECASE)
    for match in pattern.finditer(text, position):
        line_start = 1 + text.rfind("\n", 0, match.start())
        if not text[line_start : match.start()].lstrip().startswith(("#", ";", "%")):
            yield match
