"""The cards that people read: one travels with every dataset folder, one describes the benchmark."""

from cards.benchmark import benchmark_card
from cards.dataset import dataset_card

__all__ = ["benchmark_card", "dataset_card"]
