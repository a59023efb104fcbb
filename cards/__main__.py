"""Command ``python -m cards``: prints the benchmark card."""

from cards import benchmark_card

if __name__ == "__main__":
    print(benchmark_card(), end="")
