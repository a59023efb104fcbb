"""Methods by name: those that come with the bench, and anyone's."""

from rebar_depth_bench.methods.finding import METHODS, all_methods, find_method
from rebar_depth_bench.methods.method import Method, MethodInfo, Predictor

__all__ = ["METHODS", "Method", "MethodInfo", "Predictor", "all_methods", "find_method"]
