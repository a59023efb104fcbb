"""Options, tables, files and figures of the scripts."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import pandas as pd

from rebar_depth_bench.base.errors import InputError, printable
from rebar_depth_bench.base.writing import write_output
from rebar_depth_bench.cli.console import add_output_file, prints_table, run_program
from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.extended.estimates import ViewMeasures
from rebar_depth_bench.reporting.figure import check_figure, figure_bytes, figure_style
from rebar_depth_bench.scoring.columns import METRICS, rounded
from rebar_depth_bench.scoring.metrics import mean
from rebar_depth_bench.scoring.spreadsheet import Sheet

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Number = TypeVar("Number", int, float)
_MAX_LINE = 10_000
"""Largest number of characters in a printed line."""


def number(kind: type[Number], low: float, high: float = math.inf) -> Callable[[str], Number]:
    """Return the ``type`` of an option that is a finite number of ``kind`` from ``low`` to ``high``."""

    def convert(text: str) -> Number:
        value = kind(text)
        if not (math.isfinite(value) and low <= value <= high):
            raise argparse.ArgumentTypeError(f"{text} is not a number from {low:g} to {high:g}")
        return value

    return convert


def only_config(path: str, configs: Sequence[DatasetConfig], wanted: str | None) -> DatasetConfig:
    """Return the config ``wanted``, or the only one if it is None. Raises ``InputError`` if there is none."""
    names = [config.name for config in configs]
    name = wanted or names[0]
    if name not in names or (wanted is None and len(names) > 1):
        raise InputError(f"{path}: holds {', '.join(names)}, expected --config with one of them")
    return configs[names.index(name)]


def add_outputs(parser: argparse.ArgumentParser) -> None:
    """Add the options ``--json``, ``--csv`` and ``--figure``."""
    add_output_file(parser, "--json", "write every number as JSON")
    add_output_file(parser, "--csv", "write the table as CSV")
    add_output_file(parser, "--figure", "write the figure (.svg, .png or .pdf)")


def run_script(
    parser: argparse.ArgumentParser,
    run: Callable[[argparse.Namespace], None],
    arguments: Sequence[str] | None = None,
) -> int:
    """Run a script with its arguments; return its exit status: 2 for invalid input, which is printed."""

    def checked(options: argparse.Namespace) -> None:
        if options.figure:
            check_figure(options.figure)
        run(options)

    parser.set_defaults(run=checked)
    return run_program(parser, arguments)


def flat_table(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Return nested rows as a table: ``{a: {value, interval}}`` becomes the columns a, a_low and a_high."""
    table = pd.json_normalize([*rows], sep="_").rename(columns=lambda name: name.removesuffix("_value"))
    for name in [name for name in table if name.endswith(("_interval", "_range"))]:
        ends = [pair or (math.nan, math.nan) for pair in table[name]]
        place, stem = table.columns.get_loc(name), name.removesuffix("_interval")
        table.insert(place, f"{stem}_low", [low for low, _ in ends])
        table.insert(place + 1, f"{stem}_high", [high for _, high in ends])
        table = table.drop(columns=name)
    return table


def single_bar_means(views: Sequence[ViewMeasures]) -> dict[str, Any]:
    """Return share, coverage and metrics of the single-bar interior, means of the views that have a value."""

    def mean_of(align: str, name: str) -> float | None:
        values = [view[align][f"single_bar_{name}"] for view in views if view]
        return rounded(mean([value for value in values if value is not None]))

    metrics = {align: {name: mean_of(align, name) for name in METRICS} for align in ("native", "scaled")}
    known = {align: one if one["abs_rel"] is not None else None for align, one in metrics.items()}
    return {"share": mean_of("native", "share") or 0.0, "coverage": mean_of("native", "coverage"), **known}


def write_outputs(
    options: argparse.Namespace,
    content: Mapping[str, Any],
    table: pd.DataFrame,
    shown: Sequence[str],
    notes: Sequence[str],
    draw: Callable[[Figure], None],
) -> None:
    """Write the requested files; print the columns ``shown`` and the notes unless a file is standard output.

    ``content`` is the JSON object, with its provenance; ``table`` the CSV; ``draw`` draws into an empty figure.
    """
    if options.json:
        text = json.dumps(_round(content), indent=1, ensure_ascii=False, allow_nan=False)
        write_output(options.json, f"{text}\n")
    if options.csv:
        cells = table.astype(object).where(table.notna(), None)
        write_output(options.csv, Sheet(list(table.columns), cells.values.tolist()).to_csv())
    if options.figure:
        from matplotlib.figure import Figure

        with figure_style():
            figure = Figure(figsize=(9, 4.5), layout="constrained")
            draw(figure)
            write_output(options.figure, figure_bytes(figure, options.figure))
    if prints_table(options):
        rows = table[[*shown]].map(plain_name).to_string(index=False, na_rep="-", float_format="{:.4g}".format)
        archives = [f"{printable(one['method'])}: sha256:{one['sha256']}" for one in content["submissions"]]
        dataset = [f"dataset {content['dataset']['digest']}"] if content["dataset"] else []
        lines = "\n".join([rows, "", *notes, content["protocol"], *dataset, *archives]).split("\n")
        print("\n".join(printable(line, _MAX_LINE) for line in lines))


def plain_name(value: Any) -> Any:
    """Return a name with its control characters as escapes; other values unchanged."""
    return printable(value) if isinstance(value, str) else value


def _round(value: Any) -> Any:
    """Return a JSON value with 12 significant digits of each number, and null for undefined numbers."""
    if isinstance(value, float):
        return rounded(value)
    if isinstance(value, Mapping):
        return {key: _round(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_round(item) for item in value]
    return value
