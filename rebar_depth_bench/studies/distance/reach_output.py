"""Reach at crossings in the distance study: JSON, sentences and tables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any

from rebar_depth_bench.errors import printable
from rebar_depth_bench.extended.crossings.config import ConfigReaches
from rebar_depth_bench.extended.crossings.reach import SHARE, Reach
from rebar_depth_bench.extended.predictions import NATIVE
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.crossing_texts import (
    reach_interval_text,
    reach_sentence,
    reach_text,
    tested_text,
)
from rebar_depth_bench.reporting.html.study_page import Columns, PageTable, page_table

Row = tuple[str, str, Reach]
"""Config, alignment and reach."""


def reaches_json(found: ConfigReaches) -> dict[str, Any]:
    """Return the JSON object of a config: the file of the crossings, and the reaches by alignment."""
    reaches = {name: [reach.to_dict() for reach in of_one] for name, of_one in found.by_alignment.items()}
    return {"crossings": asdict(found.source), **reaches}


def reach_sentences(reaches: Mapping[str, ConfigReaches]) -> list[str]:
    """Return the native reach within the largest limit of each config, as sentences."""
    return [
        f"{printable(config)}, {reach_sentence(NATIVE, found.by_alignment[NATIVE][0])}"
        for config, found in reaches.items()
    ]


def reach_tables(reaches: Mapping[str, ConfigReaches]) -> tuple[PageTable, PageTable]:
    """Return the table of reaches, and that of the shares by distance."""
    rows = [
        (config, alignment, reach)
        for config, found in reaches.items()
        for alignment, of_one in found.by_alignment.items()
        for reach in of_one
    ]
    columns: Columns[Row] = (
        ("Config", "", lambda row: printable(row[0])),
        ("Alignment", "", lambda row: row[1]),
        ("Limit", "mm", lambda row: str(row[2].limit_mm)),
        ("Reach", "", lambda row: reach_text(row[2])),
        ("Reach", "95 % interval, m", lambda row: reach_interval_text(row[2])),
        ("Tested", "m, from to", lambda row: tested_text(row[2])),
    )
    caption = (
        f"Reach: distance up to which {100 * SHARE:g} % of the judged crossings of bars are within the limit."
    )
    return page_table(caption, columns, rows), _share_table(reaches)


def _share_table(reaches: Mapping[str, ConfigReaches]) -> PageTable:
    """Return the shares within each limit by bin of distance."""
    heads = [("Config", ""), ("Distance", "m, from to"), ("Judged", "crossings"), ("Views", ""), ("Tested", "")]
    first = next(iter(reaches.values()))
    heads += [
        (f"within {reach.limit_mm} mm", f"{alignment}, %")
        for alignment, of_one in first.by_alignment.items()
        for reach in of_one
    ]
    caption = "Share of the judged crossings within a limit, by the true depth of the tie point."
    return PageTable(caption, heads, [row for config, found in reaches.items() for row in _rows(config, found)])


def _rows(config: str, found: ConfigReaches) -> Iterator[list[str]]:
    of_all = [reach for of_one in found.by_alignment.values() for reach in of_one]
    for bins in zip(*(reach.bins for reach in of_all), strict=True):
        one = bins[0]
        head = [printable(config), f"{one.low_m:g} to {one.high_m:g}", str(one.crossings), str(one.views)]
        yield [*head, "yes" if one.tested else "no", *(formatting.number(100 * bin_.share, 1) for bin_ in bins)]
