"""Command ``python -m cards``: prints the benchmark card."""

from cards.benchmark import benchmark_card

if __name__ == "__main__":
    print(benchmark_card(), end="")
