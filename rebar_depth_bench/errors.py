"""Exception hierarchy of the project, and helpers that format problems for error messages.

Every message is one sentence that names the file or entry, the value found and the value expected. An
``InputError`` is caused by the user's input (exit status 2); any other ``RebarDepthError`` is caused by this
software or by the machine (exit status 1).
"""

from __future__ import annotations

from collections.abc import Sequence

MAX_PROBLEMS_SHOWN = 20


class RebarDepthError(Exception):
    """Base class of all errors that the project raises deliberately."""


class InputError(RebarDepthError):
    """Invalid user input: a folder, an archive or an argument."""


class DatasetError(InputError):
    """Dataset folder that is missing, incomplete or inconsistent with its manifest."""


class MeshError(InputError):
    """Mesh file that cannot be used as an assembly of bars."""


class MethodError(InputError):
    """Unknown method, or method whose requirements (package, weights, right image) are not met."""


class SubmissionError(InputError):
    """Rejected submission archive; ``problems`` lists every reason, one sentence each."""

    def __init__(self, archive: str, problems: Sequence[str]) -> None:
        self.archive = archive
        self.problems = tuple(problems)
        super().__init__(f"{archive}: {problem_summary(self.problems)}")


class CalibrationError(InputError):
    """Rejected calibration file; ``problems`` lists every reason, one sentence each."""

    def __init__(self, path: str, problems: Sequence[str]) -> None:
        self.path = path
        self.problems = tuple(problems)
        super().__init__(f"{path}: {problem_summary(self.problems)}")


class BuildError(RebarDepthError):
    """Build failure that is not caused by the user's input."""


class RenderProcessError(BuildError):
    """Render process that died or returned an invalid response twice."""


def problem_summary(problems: Sequence[str]) -> str:
    """Return the number of problems, the first ``MAX_PROBLEMS_SHOWN`` one per line, and the number omitted."""
    noun = "problem" if len(problems) == 1 else "problems"
    lines = [f"{len(problems)} {noun}", *(f"  - {problem}" for problem in problems[:MAX_PROBLEMS_SHOWN])]
    omitted = len(problems) - MAX_PROBLEMS_SHOWN
    if omitted > 0:
        lines.append(f"  ... and {omitted} more")
    return "\n".join(lines)


_MAX_TEXT_CHARACTERS = 120


class EntryError(InputError):
    """Rejected entry of an archive; ``problem`` is the reason, one sentence."""

    def __init__(self, problem: str) -> None:
        self.problem = problem
        super().__init__(problem)


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


def format_shape(shape: tuple[int, int]) -> str:
    """Return a (height, width) shape formatted as ``H x W``."""
    return f"{shape[0]} x {shape[1]}"
