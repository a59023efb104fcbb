"""Benchmark of metric depth on steel reinforcement: load the dataset, write a submission, score it."""

from __future__ import annotations

from importlib import import_module, metadata
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rebar_depth_bench.bar_crossings.crossings_file import crossings
    from rebar_depth_bench.base.errors import (
        CalibrationError,
        DatasetError,
        InputError,
        MethodError,
        Problem,
        RebarDepthError,
        SubmissionError,
    )
    from rebar_depth_bench.data.bars import bars
    from rebar_depth_bench.data.loading import load
    from rebar_depth_bench.data.torch import torch_loader
    from rebar_depth_bench.evaluator import Evaluator, evaluate
    from rebar_depth_bench.scorer import score
    from rebar_depth_bench.scoring.result import Result
    from rebar_depth_bench.scoring.table import Table, ViewScore
    from rebar_depth_bench.submission import SubmissionWriter

__all__ = [
    "CalibrationError",
    "DatasetError",
    "Evaluator",
    "InputError",
    "MethodError",
    "Problem",
    "RebarDepthError",
    "Result",
    "SubmissionError",
    "SubmissionWriter",
    "Table",
    "ViewScore",
    "bars",
    "crossings",
    "evaluate",
    "load",
    "score",
    "torch_loader",
]

_MODULE_BY_NAME = {
    "bars": "data.bars",
    "crossings": "bar_crossings.crossings_file",
    "evaluate": "evaluator",
    "load": "data.loading",
    "score": "scorer",
    "torch_loader": "data.torch",
    "Evaluator": "evaluator",
    "SubmissionWriter": "submission",
    "Result": "scoring.result",
    "Table": "scoring.table",
    "ViewScore": "scoring.table",
}


DISTRIBUTION = "rebar-depth-bench"


def software_version() -> str:
    """Return the version of the installed distribution."""
    return metadata.version(DISTRIBUTION)


def __dir__() -> list[str]:
    """Return the public names, including those not imported yet."""
    return sorted(__all__)


def __getattr__(name: str) -> Any:
    """Import a public name on first access, because its dependencies take seconds to import.

    Raises ``AttributeError`` for a name that is not in ``__all__``.
    """
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_BY_NAME.get(name, 'base.errors')}"), name)
