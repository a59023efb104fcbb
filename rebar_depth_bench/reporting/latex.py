r"""Results as a LaTeX table in the layout of the paper's Table I: for each scene RMSE, AbsRel, AbsRel_s and s.

The text needs ``\usepackage{booktabs}`` and nothing else. Letters beyond Latin need XeLaTeX or LuaLaTeX.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from rebar_depth_bench.errors import InputError
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.published import PublishedRow, load_published, paper_scene, published_rows
from rebar_depth_bench.scoring.protocol import MIN_RANKED_COVERAGE, PROTOCOL
from rebar_depth_bench.scoring.result import Result, Table

CONFIGS_ABREAST = 3
"""Configs side by side, as in the paper; more of them go below in further blocks of the same table."""

_COLUMNS = 4
_MISSING = "--"
_UNRANKED = r"$^{\ddagger}$"
_ANCHORED = r"$^{\dagger}$"
_HEADS = (r"RMSE $\downarrow$", r"AbsRel $\downarrow$", r"AbsRel$_s$ $\downarrow$", "$s$")
_SPECIAL = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "`": r"\textasciigrave{}",
    '"': r"\char34{}",
    "\N{REPLACEMENT CHARACTER}": "?",
    **{char: f"\\{char}" for char in "&%$#_{}"},
    # Bare, "[" or "*" at a row's start is an argument of the \\ before it.
    **{char: f"{{{char}}}" for char in "[]*"},
}
_LIGATURE = re.compile(r"([-',])(?=\1)")


@dataclass(frozen=True)
class _Line:
    """One row of a block: its spelled name and its cells, ``_COLUMNS`` of each config."""

    name: str
    cells: list[str]


def latex_table(results: Sequence[Result], *, published: bool, intervals: bool = False) -> str:
    r"""Return ``results`` as a LaTeX ``table*``: one row each, four columns a config.

    RMSE (cm) and AbsRel are native, AbsRel_s is after the oracle scale, s its median over views. The best number
    of a column is bold where two or more ranked rows stand in it; a row that is not ranked carries a double dagger
    and is never bold. With ``published`` the paper's rows of the same scenes follow below a line, marked, in no
    contest. With ``intervals`` the 95 % intervals stand beside the numbers, one config below the other.

    Raises ``InputError`` for no results, or results of different datasets: they do not belong in one table.
    """
    digests = {result.dataset_digest for result in results}
    if len(digests) != 1:
        found = ", ".join(sorted(map(formatting.short_digest, digests))) or "no result"
        raise InputError(f"LaTeX table: results of {len(digests)} datasets ({found}), expected one dataset")
    configs = list(dict.fromkeys(config for result in results for config in result.tables))
    abreast = 1 if intervals else CONFIGS_ABREAST
    blocks = [configs[start : start + abreast] for start in range(0, len(configs), abreast)]
    lines = [
        r"% needs \usepackage{booktabs}",
        r"\begin{table*}[t]",
        r"\centering",
        rf"\caption{{{_caption(results, configs, published=published, intervals=intervals)}}}",
        r"\label{tab:rebar-depth}",
        r"\setlength{\tabcolsep}{4pt}",
        r"\small",
        "\n\n\\medskip\n".join(_block(results, block, published, intervals) for block in blocks),
        r"\end{table*}",
    ]
    return "\n".join(lines) + "\n"


def escaped(text: str) -> str:
    """Return a text of an archive as LaTeX that prints it: nothing in it is a command, one line, no controls."""
    return _LIGATURE.sub(r"\1{}", "".join(_SPECIAL.get(char, char) for char in formatting.printable(text)))


def _block(results: Sequence[Result], configs: Sequence[str], published: bool, intervals: bool) -> str:
    groups = [rf"\multicolumn{{{_COLUMNS}}}{{c}}{{{_config_title(config)}}}" for config in configs]
    rules = [
        rf"\cmidrule(lr){{{first}-{first + _COLUMNS - 1}}}"
        for first in range(2, 2 + _COLUMNS * len(configs), _COLUMNS)
    ]
    own = _own_lines(results, configs, intervals)
    paper = _paper_lines(configs) if published else []
    mark = escaped(load_published().parts["synthetic"].mark)
    width = 1 + _COLUMNS * len(configs)
    return "\n".join(
        [
            rf"\begin{{tabular}}{{l{'r' * _COLUMNS * len(configs)}}}",
            r"\toprule",
            rf" & {' & '.join(groups)} \\",
            " ".join(rules),
            rf"Method & {' & '.join(_HEADS * len(configs))} \\",
            r"\midrule",
            *(_spelled(line) for line in own),
            *([r"\midrule", rf"\multicolumn{{{width}}}{{l}}{{\emph{{Published, {mark}}}}} \\"] if paper else []),
            *(_spelled(line) for line in paper),
            r"\bottomrule",
            r"\end{tabular}",
        ]
    )


def _spelled(line: _Line) -> str:
    return rf"{line.name} & {' & '.join(line.cells)} \\"


def _config_title(config: str) -> str:
    """Return a config's heading, with the working distance where it is the paper's own dome."""
    scenes = load_published().scenes
    if config not in scenes:
        return escaped(config)
    return f"{escaped(config)} ({scenes[config].distance.replace('–', '--')})"


def _own_lines(results: Sequence[Result], configs: Sequence[str], intervals: bool) -> list[_Line]:
    best = {config: _best_texts([result.tables.get(config) for result in results]) for config in configs}
    lines = []
    for result in results:
        tables = {config: result.tables.get(config) for config in configs}
        if any(tables.values()):
            cells = [cell for config in configs for cell in _cells(tables[config], best[config], intervals)]
            lines.append(_Line(escaped(result.method), cells))
    return lines


def _cells(table: Table | None, best: Sequence[str | None], intervals: bool) -> list[str]:
    """Return a config's four cells; ``best`` holds each column's best number as spelled, None where none is."""
    if table is None:
        return [_MISSING] * _COLUMNS
    cells = []
    ends = _intervals(table) if intervals else [""] * _COLUMNS
    for text, winner, interval in zip(_texts(table), best, ends, strict=True):
        number = rf"\textbf{{{text}}}" if table.ranked and text == winner else text
        cells.append(number + (rf" {{\tiny[{interval}]}}" if interval else ""))
    return cells if table.ranked else [cells[0] + _UNRANKED, *cells[1:]]


def _texts(table: Table) -> list[str]:
    native, scaled = formatting.metric_cells(table.native), formatting.metric_cells(table.scaled)
    texts = (native[1], native[0], scaled[0], formatting.scale_cell(table.scale_median))
    return [_MISSING if text == formatting.DASH else text for text in texts]


def _intervals(table: Table) -> list[str]:
    native, scaled = (formatting.metric_interval_cells(table.intervals, kind) for kind in ("native", "scaled"))
    scale = formatting.interval_cell(table.intervals.get("scale_median"), 3)
    return [text.replace(" – ", ", ") for text in (native[1], native[0], scaled[0], scale)]


def _best_texts(tables: Iterable[Table | None]) -> list[str | None]:
    """Return the spelled least RMSE, AbsRel and AbsRel_s of the ranked rows; None of fewer than two, and of s."""
    ranked = [table for table in tables if table is not None and table.ranked]
    if len(ranked) < 2:
        return [None] * _COLUMNS
    least = (min(ranked, key=key) for key in (_rmse_cm, _abs_rel, _abs_rel_scaled))
    return [*(_texts(table)[column] for column, table in enumerate(least)), None]


def _rmse_cm(table: Table) -> float:
    return table.native.rmse_cm if table.native else float("inf")


def _abs_rel(table: Table) -> float:
    return table.native.abs_rel if table.native else float("inf")


def _abs_rel_scaled(table: Table) -> float:
    return table.scaled.abs_rel if table.scaled else float("inf")


def _paper_lines(configs: Sequence[str]) -> list[_Line]:
    by_config = {config: _published_by_method(config) for config in configs}
    methods = dict.fromkeys(method for rows in by_config.values() for method in rows)
    return [
        _Line(
            escaped(method), [cell for config in configs for cell in _paper_cells(by_config[config].get(method))]
        )
        for method in methods
    ]


def _published_by_method(config: str) -> Mapping[str, PublishedRow]:
    return {row.method: row for row in published_rows(paper_scene(config) or "")}


def _paper_cells(row: PublishedRow | None) -> list[str]:
    if row is None:
        return [_MISSING] * _COLUMNS
    return [row.rmse_cm + (_ANCHORED if row.median_anchored else ""), row.abs_rel, row.abs_rel_scaled, row.scale]


def _counted(views: int) -> str:
    return "1 view" if views == 1 else f"{views} views"


def _caption(results: Sequence[Result], configs: Sequence[str], *, published: bool, intervals: bool) -> str:
    """Return the caption: protocol, views, alignment, dataset, and what each mark in the table means."""
    tables = [(config, result.tables[config]) for result in results for config in result.tables]
    views = dict(tables)
    counts = ", ".join(f"{escaped(config)} {_counted(views[config].views)}" for config in configs)
    digest = escaped(formatting.short_digest(results[0].dataset_digest, 16))
    version = escaped(results[0].dataset_version)
    sentences = [
        f"Depth on steel, protocol {escaped(PROTOCOL)}, dataset {version} ({digest}): {counts}.",
        "RMSE in cm and AbsRel are native, without any alignment; AbsRel$_s$ is after the oracle scale"
        r" $s = \mathrm{med}(\mathrm{GT})/\mathrm{med}(\mathrm{pred})$ of each view; means over views,"
        " $s$: median over views.",
    ]
    if any(not table.ranked for _, table in tables):
        least = f"{MIN_RANKED_COVERAGE * 100:.0f}"
        sentences.append(
            rf"{_UNRANKED}Not ranked (coverage below {least}\,\%, a view without prediction, or an overflow)."
        )
    if intervals:
        sentences.append(r"In brackets: 95\,\% intervals, block bootstrap over views.")
    paper_methods = [row for config in configs for row in published_rows(paper_scene(config) or "")]
    if published and any(row.median_anchored for row in paper_methods):
        sentences.append(rf"{_ANCHORED}Median-anchored to ground truth (no fiducial).")
    if published and paper_methods:
        paper = load_published()
        sentences.append(
            f"Published rows: ``{escaped(paper.title)}'', {paper.parts['synthetic'].place}, not ranked."
        )
    return " ".join(sentences)
