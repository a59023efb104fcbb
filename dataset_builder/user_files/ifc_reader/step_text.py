"""Text of a STEP file (ISO 10303-21): schema name, instances, and the arguments of an instance.

All patterns have possessive quantifiers, which never backtrack: a damaged text takes linear time and no recursion.
The syntax of instances is checked for the whole file, since a lost quote or semicolon hides the instances that
follow it.
"""

from __future__ import annotations

import re
from array import array
from bisect import bisect_left

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from rebar_depth_bench.base.errors import MeshError, escape_text

MAX_SCHEMA_NAME = 64
"""Largest length of a schema's name; ifcopenshell crashes on one of 1,000 letters."""

_GAP = r"(?:\s++|/\*(?:[^*]++|\*(?!/))*+\*/)*+"
# A string that contains the beginning of an instance has lost its closing quote.
_STRING = r"'(?:[^';]++|''|;(?!\s*+#\d))*+'"
_BODY = rf"(?:[^'/;=]++|{_STRING}|/\*(?:[^*]++|\*(?!/))*+\*/|/(?!\*))*+"
_HEADER = re.compile(
    rf"\ufeff?\s*+ISO-10303-21{_GAP};(?:{_GAP}(?!DATA{_GAP};)[A-Za-z_]{_BODY};)*+{_GAP}DATA{_GAP};"
)
_SCHEMA = re.compile(rf"FILE_SCHEMA{_GAP}({_BODY});")
_INSTANCE = re.compile(rf"{_GAP}#(\d{{1,18}}){_GAP}={_GAP}(!?+[A-Za-z]\w*+{_GAP}\({_BODY});", re.ASCII)
_FOOTER = re.compile(rf"{_GAP}ENDSEC{_GAP};{_GAP}END-ISO-10303-21{_GAP};\s*+\Z")
_CLASS = re.compile(rf"(!?+[A-Za-z]\w*+){_GAP}", re.ASCII)
# ISO 10303-21 requires a digit before the point; the parser reads numbers without it after a sign only.
_NUMBER = r"[-+]?+(?:\d++(?:\.\d*+)?+|\.\d++)(?:[Ee][-+]?+\d++)?+"
_VALUE = rf"{_STRING}|\#\d++|{_NUMBER}|\.[A-Za-z]\w*+\.|[A-Za-z]\w*+(?={_GAP}\()|\"[0-9A-Fa-f]*+\"|[$*(),]"
_TOKEN = re.compile(rf"{_GAP}({_VALUE}){_GAP}", re.ASCII)
_TOKENS = re.compile(rf"(?:{_GAP}(?:{_VALUE}){_GAP})*+", re.ASCII)


class StepText:
    """Instances of a STEP file's text by their numbers.

    Raises ``MeshError`` if the text does not begin and end as STEP, names no plausible schema, or has anything
    but instances with distinct numbers in its DATA section.
    """

    def __init__(self, text: str) -> None:
        self._text = text
        numbers, starts, ends = self._scan(_end_of_header(text))
        order = np.argsort(numbers, kind="stable")
        self.numbers: Int64[ndarray, " n"] = numbers[order]
        repeated = self.numbers[1:][self.numbers[1:] == self.numbers[:-1]]
        if len(repeated):
            raise MeshError(f"instance #{repeated[0]} is defined twice, expected once")
        # Arrays of the standard library are searched several times faster than those of numpy.
        self._numbers, self._starts, self._ends = (
            array("q", values[order].tobytes()) for values in (numbers, starts, ends)
        )

    def _scan(self, position: int) -> tuple[Int64[ndarray, " n"], Int64[ndarray, " n"], Int64[ndarray, " n"]]:
        """Return the number, begin and end of each instance, without number and semicolon, in the text's order."""
        numbers, starts, ends = array("q"), array("q"), array("q")
        text, find = self._text, _INSTANCE.match
        while found := find(text, position):
            numbers.append(int(found[1]))
            starts.append(found.start(2))
            ends.append(found.end(2))
            position = found.end()
        if not _FOOTER.match(text, position):
            line = text.count("\n", 0, position) + 1
            previous = f" after #{numbers[-1]}" if numbers else ""
            excerpt = text[position : position + 80].strip().partition("\n")[0]
            raise MeshError(
                f"the text{previous} (line {line}) is {escape_text(excerpt)}, expected an instance such as "
                "#7=IFCDIRECTION((0.,0.,1.)); or the end of the file"
            )
        return np.array(numbers, np.int64), np.array(starts, np.int64), np.array(ends, np.int64)

    def instance(self, number: int) -> str:
        """Return the text of an instance: its class and, in parentheses, its arguments."""
        index = bisect_left(self._numbers, number)
        return self._text[self._starts[index] : self._ends[index]]


def _end_of_header(text: str) -> int:
    """Return the position after ``DATA;``; raise ``MeshError`` if begin, end or header are not those of an IFC."""
    if not text[:1000].lstrip("\ufeff \t\r\n").startswith("ISO-10303-21"):
        raise MeshError("does not begin with ISO-10303-21, expected an IFC file in STEP format")
    if not text[-1000:].rstrip().removesuffix(";").rstrip().endswith("END-ISO-10303-21"):
        raise MeshError("does not end with END-ISO-10303-21, expected a complete IFC file: is it truncated?")
    header = _HEADER.match(text)
    if header is None:
        raise MeshError("has no complete header, expected FILE_SCHEMA, ENDSEC and DATA")
    schema = _SCHEMA.search(header[0])
    names = [] if schema is None else re.findall(r"'([^']*+)'", schema[1])
    if not names or any(not re.fullmatch(rf"\w{{1,{MAX_SCHEMA_NAME}}}", name) for name in names):
        found = escape_text(", ".join(names)) if names else "missing"
        raise MeshError(f"the name of the schema is {found}, expected for example IFC4")
    return header.end()


def class_name(instance: str) -> str:
    """Return the class of an instance's text, in upper case."""
    found = _CLASS.match(instance)
    return found[1].upper() if found else ""


def tokens(instance: str) -> list[str]:
    """Return the class of an instance's text and the tokens of its arguments; none if it has anything else."""
    found = _CLASS.match(instance)
    if not found or not _TOKENS.fullmatch(instance, found.end()):
        return []
    return [found[1], *_TOKEN.findall(instance, found.end())]


def split_arguments(instance: list[str]) -> list[list[str]]:
    """Return the tokens of each argument of an instance's tokens; no argument if they are not in parentheses."""
    arguments: list[list[str]] = [[]]
    depth = 1
    for token in instance[2:-1]:
        depth += (token == "(") - (token == ")")
        if depth == 0:
            return []
        if token == "," and depth == 1:
            arguments.append([])
        else:
            arguments[-1].append(token)
    return arguments if depth == 1 and (instance[1:2], instance[-1:]) == (["("], [")"]) else []


def same_tokens(first: list[str], second: list[str]) -> bool:
    """Return whether two lists of tokens have the same values; the content of strings is not compared."""
    return len(first) == len(second) and all(
        a == b or _same_token(a, b) for a, b in zip(first, second, strict=True)
    )


def _same_token(first: str, second: str) -> bool:
    if first[0] == second[0] == "'":  # Writers encode the same string in different ways.
        return True
    try:
        return float(first) == float(second)
    except ValueError:
        return first.upper() == second.upper()
