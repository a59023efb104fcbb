"""Lines of keys in text files, for problems whose location is a key: TOML, YAML, JSON and XML."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

from rebar_depth_bench.errors import Problem
from rebar_depth_bench.reading import MAX_NESTING

_MAX_TEXT_CHARACTERS = 1_000_000

_Path = tuple[str, ...]
"""Keys from the top of a file to a value; the n-th table of a list has the key "name n"."""

# Possessive quantifiers and the end of the text as an end of everything keep the search linear.
_TOKEN = re.compile(
    r"""
    (?P<newline>\n)
    | ^[ \t]*+\[(?P<list>\[)?+(?P<table>[\w."' -]++)\]
    | (?P<key>"[^"\\\n]*+"|'[^'\n]*+'|(?<![\w.-])[\w.-]++)[ \t]*+(?P<separator>[:=])
    | (?P<skipped>"{3}[\s\S]*?(?:"{3}|\Z)|'{3}[\s\S]*?(?:'{3}|\Z)|<!--[\s\S]*?(?:-->|\Z)|\#[^\n]*+
        |"(?:[^"\\\n]|\\.)*+"?|'[^'\n]*+'?)
    | (?P<open>[\[{])
    | <(?P<element>[\w.-]++)
    | (?P<close>[]}]|</|/>)
    """,
    re.VERBOSE | re.MULTILINE,
)


def with_lines(problems: Sequence[Problem], content: bytes, name: str = "") -> list[Problem]:
    """Return problems whose key occurs in the content of a file with its line, "line 3: got ...".

    ``name`` is that of the file if locations begin with it; problems of other files are left as they are. An item
    of a list that is not written as a table of its own has the line of the list. The time is linear in the size of
    the file and the number of problems.
    """
    lines = _key_lines(content[:_MAX_TEXT_CHARACTERS].decode("utf-8-sig", "replace"))
    located = []
    for problem in problems:
        is_here = problem.where.startswith(f"{name}: ") if name else bool(problem.where)
        line = _line(lines, problem.where[len(name) :].removeprefix(": ")) if is_here else None
        if line is not None and not problem.found.startswith("line "):
            problem = replace(problem, found=f"line {line}: {problem.found}")
        located.append(problem)
    return located


def _line(lines: Mapping[_Path, int], where: str) -> int | None:
    """Return the line at a location as ``validation.format_location`` writes it, or None if it has no line."""
    path: _Path = ()
    for part in re.split(r"\.|: ", where):
        path = (*path, part)
        if path not in lines:
            name, _, index = part.rpartition(" ")
            return lines.get((*path[:-1], name)) if index.isdecimal() else None
    return lines[path]


def _key_lines(text: str) -> dict[_Path, int]:
    """Return the number of the first line of each key, from 1.

    Keys of TOML are in the last ``[table]`` and in open braces, those of YAML below a key with less indentation,
    and those of XML in open elements; the outermost element of XML is the file.
    """
    lines: dict[_Path, int] = {}
    tables: Counter[_Path] = Counter()
    table: _Path = ()
    key: _Path = ()
    containers: list[_Path] = []
    indented: list[tuple[int, _Path]] = []
    line, line_start = 1, 0
    for token in _TOKEN.finditer(text):
        kind = token.lastgroup
        if kind == "newline":
            line, line_start = line + 1, token.end()
        elif kind == "skipped":
            line += token[0].count("\n")
        elif kind == "table" and not containers:
            indented.clear()
            table = ()
            names = _names(token["table"])
            for depth, name in enumerate(names, start=1):
                table = _below(lines, table, name, line)
                tables[table] += bool(token["list"] and depth == len(names))
                if tables[table]:
                    table = _below(lines, table[:-1], f"{name} {tables[table]}", line)
        elif kind == "separator":
            column = token.start() - line_start
            while indented and (indented[-1][0] >= column or token["separator"] == "="):
                indented.pop()
            key = containers[-1] if containers else indented[-1][1] if indented else table
            for name in _names(token["key"]):
                key = _below(lines, key, name, line)
            if token["separator"] == ":" and not containers:
                indented.append((column, key))
        elif kind == "element":
            key = _below(lines, containers[-1], token["element"], line) if containers else ()
            containers.append(key)
        elif kind == "open":
            containers.append(key)
        elif kind == "close" and containers:
            key = containers.pop()
    return lines


def _names(dotted: str) -> list[str]:
    return [name.strip("\"' ") for name in dotted.split(".")[:MAX_NESTING]]


def _below(lines: dict[_Path, int], path: _Path, name: str, line: int) -> _Path:
    """Return the path of a key below another, whose line is noted if it is the first; not below a deep one."""
    if len(path) < MAX_NESTING:
        path = (*path, name)
        lines.setdefault(path, line)
    return path
