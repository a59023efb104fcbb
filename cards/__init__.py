"""Generators of the Markdown cards: those of dataset folders, and the benchmark card."""

from cards.benchmark import benchmark_card
from cards.dataset import dataset_card

__all__ = ["benchmark_card", "dataset_card"]
