"""What a method is: a description, the columns it needs, and a way to load its predictor."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jaxtyping import Float32
from numpy import ndarray

from rebar_depth_bench.data.dataset import ConfigViews
from rebar_depth_bench.progress import Progress

Predictor = Callable[[Mapping[str, Any]], Float32[ndarray, "h w"]]
"""From a decoded row to the left view's planar depth, metres, on the left grid; NaN where it has no answer."""


@dataclass(frozen=True)
class MethodInfo:
    """What people should know of a method before they run it or read its numbers.

    ``reads_truth``: it is told some of what it is asked, so its numbers stand for no instrument. ``unexercised``
    says what of it never ran where it was written: weights or hardware that were not there.
    """

    name: str
    summary: str
    columns: tuple[str, ...]
    uses_intrinsics: bool
    source: str
    licence: str
    reads_truth: bool = False
    unexercised: str = ""

    def __post_init__(self) -> None:
        if isinstance(self.columns, str):  # a forgotten comma
            raise TypeError(f"columns is the text {self.columns!r}, expected a tuple of names")


@dataclass(frozen=True)
class Method:
    """A method and how to load it. ``load`` raises ``MethodError`` where a package or weights are missing."""

    info: MethodInfo
    load: Callable[[], Predictor]


@dataclass(frozen=True)
class Prepared:
    """A predictor made from all views of a config, and what was found on the way, as plain JSON values."""

    predict: Predictor
    notes: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class MultiViewMethod:
    """A method that sees all views of a config before it answers for any of them.

    ``check(views)`` raises ``MethodError`` for a config that cannot serve it (one without a board, say) or where
    a package is missing; it is asked of every config before work begins. ``prepare(views, work, progress)`` makes
    the predictor from all views: ``views.rows("left_rgb", "left_K")`` yields them decoded, ``view_ids``, ``grid``,
    ``board`` and ``mesh`` are there too; ``progress("what", done, total)`` tells how far it is. What it leaves in
    the folder ``work`` is there again when an interrupted run goes on. The predictor's rows hold ``view_id`` and
    ``info.columns``.
    """

    info: MethodInfo
    prepare: Callable[[ConfigViews, Path, Progress], Prepared]
    check: Callable[[ConfigViews], None]


AnyMethod = Method | MultiViewMethod
