"""Generators of the Markdown cards and of ``eval.yaml``: those of each dataset folder, and the benchmark card."""

from cards.benchmark import benchmark_card
from cards.dataset import dataset_card
from cards.tasks import benchmark_tasks

__all__ = ["benchmark_card", "benchmark_tasks", "dataset_card"]
