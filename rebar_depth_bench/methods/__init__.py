"""Methods by name: those that come with the bench, and anyone's."""

from rebar_depth_bench.methods.config_views import ConfigViews
from rebar_depth_bench.methods.finding import METHODS, all_methods, find_method, own_methods
from rebar_depth_bench.methods.method import (
    AnyMethod,
    Method,
    MethodInfo,
    MultiViewMethod,
    Predictor,
    Prepared,
)

__all__ = [
    "METHODS",
    "AnyMethod",
    "ConfigViews",
    "Method",
    "MethodInfo",
    "MultiViewMethod",
    "Predictor",
    "Prepared",
    "all_methods",
    "find_method",
    "own_methods",
]
