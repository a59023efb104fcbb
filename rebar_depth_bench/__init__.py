"""Metric depth on steel reinforcement: load the dataset, write a submission, score it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rebar_depth_bench.dataset import load
from rebar_depth_bench.errors import (
    DatasetError,
    InputError,
    MethodError,
    RebarDepthError,
    SubmissionError,
)
from rebar_depth_bench.result import Result, Table, ViewScore
from rebar_depth_bench.scoring import score
from rebar_depth_bench.submission import SubmissionWriter

if TYPE_CHECKING:
    from rebar_depth_bench.torch_data import torch_loader

__all__ = [
    "DatasetError",
    "InputError",
    "MethodError",
    "RebarDepthError",
    "Result",
    "SubmissionError",
    "SubmissionWriter",
    "Table",
    "ViewScore",
    "load",
    "score",
    "torch_loader",
]


def __getattr__(name: str) -> Any:
    """Import what needs torch only when it is asked for."""
    if name == "torch_loader":
        from rebar_depth_bench.torch_data import torch_loader

        return torch_loader
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
