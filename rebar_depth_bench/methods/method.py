"""What a method is: a description, the columns it needs, and a way to load its predictor."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from jaxtyping import Float32
from numpy import ndarray

Predictor = Callable[[Mapping[str, Any]], Float32[ndarray, "h w"]]
"""From a decoded row to the left view's planar depth, metres, on the left grid; NaN where it has no answer."""


@dataclass(frozen=True)
class MethodInfo:
    """What people should know of a method before they run it or read its numbers."""

    name: str
    summary: str
    columns: tuple[str, ...]
    uses_intrinsics: bool
    source: str
    licence: str


@dataclass(frozen=True)
class Method:
    """A method and how to load it. ``load`` raises ``MethodError`` where a package or weights are missing."""

    info: MethodInfo
    load: Callable[[], Predictor]
