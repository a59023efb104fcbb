"""The one tree of errors; every message says what is wrong, what was found, what was expected, and where.

``InputError`` is the user's to mend (exit status 2); any other ``RebarDepthError`` is ours or the
machine's (exit status 1).

How a refusal is worded: one sentence with the entry, what was found and what was expected.
"""

from __future__ import annotations

from collections.abc import Sequence

MAX_PROBLEMS_SHOWN = 20


class RebarDepthError(Exception):
    """Root of every error this project raises on purpose."""


class InputError(RebarDepthError):
    """What the user handed in is at fault: a folder, an archive, an argument."""


class DatasetError(InputError):
    """A dataset folder is missing, incomplete or contradicts its own manifest."""


class MeshError(InputError):
    """A mesh file cannot serve as an assembly of bars."""


class MethodError(InputError):
    """A method is unknown, or lacks what it needs (package, weights, a right image)."""


class SubmissionError(InputError):
    """An archive is refused: ``problems`` holds every reason, one sentence each."""

    def __init__(self, archive: str, problems: Sequence[str]) -> None:
        self.archive = archive
        self.problems = tuple(problems)
        super().__init__(f"{archive}: {problem_summary(self.problems)}")


class CalibrationError(InputError):
    """A calibration file is refused: ``problems`` holds every reason, one sentence each."""

    def __init__(self, path: str, problems: Sequence[str]) -> None:
        self.path = path
        self.problems = tuple(problems)
        super().__init__(f"{path}: {problem_summary(self.problems)}")


class BuildError(RebarDepthError):
    """A build could not finish for a reason that is not the user's input."""


class RenderProcessError(BuildError):
    """A render process died or answered nonsense, twice."""


def problem_summary(problems: Sequence[str]) -> str:
    """Return ``N problems`` and up to ``MAX_PROBLEMS_SHOWN`` of them, one a line, then how many are left."""
    noun = "problem" if len(problems) == 1 else "problems"
    lines = [f"{len(problems)} {noun}", *(f"  - {problem}" for problem in problems[:MAX_PROBLEMS_SHOWN])]
    left_over = len(problems) - MAX_PROBLEMS_SHOWN
    if left_over > 0:
        lines.append(f"  ... and {left_over} more")
    return "\n".join(lines)


_SHOWN_CHARACTERS = 120


class EntryError(InputError):
    """One entry of an archive is refused; ``problem`` is the sentence that says why."""

    def __init__(self, problem: str) -> None:
        self.problem = problem
        super().__init__(problem)


def show(text: str) -> str:
    """Return ``text`` fit for a one-line message: control characters escaped, long text cut."""
    shown = text if text and text.isprintable() else ascii(text)
    return shown if len(shown) <= _SHOWN_CHARACTERS else shown[:_SHOWN_CHARACTERS] + "..."


def show_shape(shape: tuple[int, int]) -> str:
    """Return ``H x W``."""
    return f"{shape[0]} x {shape[1]}"
