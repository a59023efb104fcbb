"""Command ``python -m cards``: writes the benchmark card, measures, results and the table of the README."""

from cards.benchmark import PAGES
from rebar_depth_bench.base.writing import write_text

if __name__ == "__main__":
    for path, text in PAGES.items():
        write_text(path, text())
