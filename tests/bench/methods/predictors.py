"""A method of single views, loaded."""

from __future__ import annotations

from rebar_depth_bench.methods import AnyMethod, Method, Predictor, find_method


def loaded(method: AnyMethod | str) -> Predictor:
    """Load a method, by name or as it is, that takes one view at a time."""
    found = find_method(method) if isinstance(method, str) else method
    assert isinstance(found, Method)
    return found.load()
