"""How a refusal is worded: one sentence with the entry, what was found and what was expected."""

from __future__ import annotations

from rebar_depth_bench.errors import InputError

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
