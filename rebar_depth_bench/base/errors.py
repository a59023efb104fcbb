"""Exception hierarchy of the project, text of problems for error messages, and the check for optional packages.

A message names the file or entry, what was found and what was expected, in one line for each problem. An
``InputError`` is caused by the user's input (exit status 2); any other ``RebarDepthError`` is caused by this
software or by the machine (exit status 1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Literal, Self

MAX_PROBLEMS_SHOWN = 20
_MAX_TEXT_CHARACTERS, _MAX_LIBRARY_CHARACTERS = 120, 300

ProblemCode = Literal[
    "syntax",  # a file that cannot be parsed at all
    "missing",  # a key, entry or file that is required
    "unreadable",  # a file that exists and cannot be read
    "unknown",  # a key or entry that is not part of the schema or the dataset
    "duplicate",  # a key, id or entry that occurs twice
    "conflict",  # values that are valid alone, but not together
    "invalid",  # a value of the wrong type or outside its range
    "name",  # an entry's name that escapes the archive or cannot be stored
    "kind",  # an entry that is no plain file: linked, encrypted, patch data
    "size",  # a declared or actual size that is too large, or two sizes that differ
    "damaged",  # data that are truncated, overlapping or corrupt
]
"""Kind of a problem, stable across versions, for programs and tests; ``Problem.where`` locates it."""


@dataclass(frozen=True, slots=True)
class Problem:
    """One reason for rejecting an input.

    ``where`` is the entry, view or key (empty: the whole input), ``found`` describes what is there, and
    ``expected`` what should be (empty if it is obvious).
    """

    code: ProblemCode
    where: str
    found: str
    expected: str = ""

    def __str__(self) -> str:
        """Return the problem as one line, ``where: found, expected ...``."""
        place = f"{self.where}: " if self.where else ""
        return f"{place}{self.found}{', expected ' if self.expected else ''}{self.expected}"


class RebarDepthError(Exception):
    """Base class of all errors that the project raises deliberately."""


class InputError(RebarDepthError):
    """Invalid user input: a folder, an archive or an argument.

    ``problems`` lists every reason if the input was validated as a whole; it is empty for other errors.
    """

    problems: tuple[Problem, ...] = ()

    @classmethod
    def from_problems(cls, source: object, problems: Sequence[Problem]) -> Self:
        """Return the error of the input ``source`` (usually a path), whose message lists the problems."""
        error = cls(f"{source}: {problem_summary(problems)}")
        error.problems = tuple(problems)
        return error


class DatasetError(InputError):
    """Dataset folder that is missing, incomplete or inconsistent with its manifest."""


class MeshError(InputError):
    """Mesh file that cannot be used as an assembly of bars."""


class MethodError(InputError):
    """Unknown method, or method whose requirements (package, weights, right image) are not met."""


class SubmissionError(InputError):
    """Rejected submission archive."""


class EntryError(InputError):
    """Rejected entry of an archive; ``problem`` is the reason."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem)  # The arguments of the constructor, so that it can be pickled.
        self.problem = problem
        self.problems = (problem,)


class CalibrationError(InputError):
    """Rejected calibration file."""


class OutputError(RebarDepthError):
    """Output that this machine cannot write: no space, quota or permission left, or past the file-size limit."""


class StorageError(RebarDepthError):
    """Stored data of a leaderboard that are missing or damaged, or a machine that cannot store or score more."""


class HubError(RebarDepthError):
    """Hugging Face Hub that cannot be reached, fails, or gives an answer that cannot be used."""


class BuildError(RebarDepthError):
    """Build failure that is not caused by the user's input."""


class RenderProcessError(BuildError):
    """Render process that died or returned an invalid response twice."""


def problem_summary(problems: Sequence[Problem | str]) -> str:
    """Return the number of problems, the first ``MAX_PROBLEMS_SHOWN`` one per line, and the number omitted."""
    noun = "problem" if len(problems) == 1 else "problems"
    lines = [f"{len(problems)} {noun}", *(f"  - {problem}" for problem in problems[:MAX_PROBLEMS_SHOWN])]
    omitted = len(problems) - MAX_PROBLEMS_SHOWN
    if omitted > 0:
        lines.append(f"  ... and {omitted} more")
    return "\n".join(lines)


def escape_text(text: str) -> str:
    """Return ``text`` for a one-line message: escaped if not printable, truncated to 120 characters."""
    escaped = text if text and text.isprintable() else ascii(text)
    return escaped if len(escaped) <= _MAX_TEXT_CHARACTERS else escaped[:_MAX_TEXT_CHARACTERS] + "..."


def printable(text: str, limit: int = 200) -> str:
    """Return a name from a submission, truncated to ``limit`` characters.

    Control characters and characters that change the text direction become U+FFFD.
    """
    clean = "".join(char if char.isprintable() else "\N{REPLACEMENT CHARACTER}" for char in text[: limit + 1])
    return clean if len(clean) <= limit else clean[: limit - 1] + "…"


def exception_summary(error: Exception) -> str:
    """Return the type of an exception and the first line of its message."""
    first_line = (str(error).strip().splitlines() or [""])[0]
    return f"{type(error).__name__}: {first_line}"


def library_message(error: Exception) -> str:
    """Return the message of another library's exception on one line; of a long one the end, which has the cause.

    It is the name of the exception's type if there is no message.
    """
    message = " ".join(str(error).split()) or type(error).__name__
    message = message if message.isprintable() else ascii(message)
    if len(message) <= _MAX_LIBRARY_CHARACTERS:
        return message
    return f"... {message[-_MAX_LIBRARY_CHARACTERS:]}"


def format_shape(shape: tuple[int, int]) -> str:
    """Return a (height, width) shape formatted as ``H x W``."""
    return f"{shape[0]} x {shape[1]}"


def require_extra(extra: str, modules: Sequence[str]) -> None:
    """Raise ``InputError`` if a module of an extra of this distribution is not installed.

    Modules that need the extra are imported only after this check.
    """
    missing = [name for name in modules if find_spec(name) is None]
    if missing:
        raise InputError(
            f"not installed: {', '.join(missing)}; expected the {extra} extra: {install_command(extra)}"
        )


def install_command(extra: str) -> str:
    """Return how to install an extra of this distribution, which is not on a package index."""
    return f"pip install '.[{extra}]' in a clone of rebar-depth-bench"
