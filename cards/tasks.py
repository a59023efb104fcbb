"""Benchmark tasks of a dataset: the ``eval.yaml`` of its repository on the Hugging Face Hub.

Source: https://huggingface.co/docs/hub/eval-results, whose keys these are. The format has no key for a metric or
for its direction, so the description states both.
"""

from __future__ import annotations

from collections.abc import Iterable

from cards.dataset import PRETTY_NAME
from rebar_depth_bench.reporting.eval_results import EVALUATION_FRAMEWORK, task_id, yaml_text
from rebar_depth_bench.reporting.formatting import RANK_ERROR_NOTE
from rebar_depth_bench.scoring.protocol import PROTOCOL
from rebar_depth_bench.view_ids import TEST_SPLIT

_DESCRIPTION = (
    "Metric depth on steel reinforcement, scored against exact synthetic ground truth. Each task is a config, and "
    f"its value is the rank_error of protocol {PROTOCOL}: from 0 to 1, lower is better. {RANK_ERROR_NOTE}"
)


def benchmark_tasks(configs: Iterable[str]) -> str:
    """Return the text of the ``eval.yaml`` of a dataset folder, with one task per config."""
    return yaml_text(
        {
            "name": PRETTY_NAME,
            "description": _DESCRIPTION,
            "evaluation_framework": EVALUATION_FRAMEWORK,
            "tasks": [{"id": task_id(config), "config": config, "split": TEST_SPLIT} for config in configs],
        }
    )
