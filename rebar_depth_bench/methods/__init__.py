"""Public interface of depth methods: descriptions, loaders and lookup by name."""

from rebar_depth_bench.data.rows import ConfigViews, Views
from rebar_depth_bench.methods.base import AnyMethod, Method, MethodInfo, MultiViewMethod, Predictor, Prepared
from rebar_depth_bench.methods.registry import METHODS, all_methods, find_method, own_methods

__all__ = [
    "METHODS",
    "AnyMethod",
    "ConfigViews",
    "Method",
    "MethodInfo",
    "MultiViewMethod",
    "Predictor",
    "Prepared",
    "Views",
    "all_methods",
    "find_method",
    "own_methods",
]
