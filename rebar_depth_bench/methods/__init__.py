"""The methods that come with the bench, by name."""

from __future__ import annotations

from collections.abc import Mapping

from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods.constant import CONSTANT
from rebar_depth_bench.methods.method import Method, MethodInfo, Predictor
from rebar_depth_bench.methods.sgbm import SGBM

METHODS: Mapping[str, Method] = {method.info.name: method for method in (SGBM, CONSTANT)}

__all__ = ["METHODS", "Method", "MethodInfo", "Predictor", "find_method"]


def find_method(name: str) -> Method:
    """Return a method by name; raise ``MethodError`` for an unknown one."""
    try:
        return METHODS[name]
    except KeyError:
        raise MethodError(f"no method {name!r}, expected one of {', '.join(METHODS)}") from None
