"""Loading of single-view methods, and interruption of prediction runs."""

from __future__ import annotations

from rebar_depth_bench.base.parallel import Progress
from rebar_depth_bench.methods import AnyMethod, Method, Predictor, find_method


def load_predictor(method: AnyMethod | str) -> Predictor:
    """Load a single-view method, given by name or as an object."""
    single_view_method = find_method(method) if isinstance(method, str) else method
    assert isinstance(single_view_method, Method)
    return single_view_method.load()


def stop_after(views: int, task: str = "") -> Progress:
    """Return a progress function that interrupts a task of this name, or any, after so many steps."""

    def progress(name: str, done: int, _: int) -> None:
        if done == views and task in name:
            raise KeyboardInterrupt

    return progress
