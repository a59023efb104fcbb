"""Generators of the Markdown cards: the dataset card of each dataset folder, and the benchmark card."""

from cards.benchmark import benchmark_card
from cards.dataset import dataset_card

__all__ = ["benchmark_card", "dataset_card"]
