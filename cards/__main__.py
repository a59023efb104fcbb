"""Command ``python -m cards``: writes the benchmark card and the pages of measures and results."""

from cards.benchmark import PAGES
from rebar_depth_bench.base.writing import write_text

if __name__ == "__main__":
    for path, text in PAGES.items():
        write_text(path, text())
