"""Loading of single-view methods."""

from __future__ import annotations

from rebar_depth_bench.methods import AnyMethod, Method, Predictor, find_method


def load_predictor(method: AnyMethod | str) -> Predictor:
    """Load a single-view method, given by name or as an object."""
    single_view_method = find_method(method) if isinstance(method, str) else method
    assert isinstance(single_view_method, Method)
    return single_view_method.load()
