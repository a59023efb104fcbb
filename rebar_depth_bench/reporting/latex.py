r"""LaTeX table of results in the layout of the paper's Table I: RMSE, AbsRel, AbsRel_s and s of each config.

The output requires only ``\usepackage{booktabs}``. Non-Latin letters require XeLaTeX or LuaLaTeX.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from rebar_depth_bench.errors import InputError, printable
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.published import PublishedRow, load_published, paper_scene, published_rows
from rebar_depth_bench.scoring.protocol import MIN_RANKED_COVERAGE, PROTOCOL
from rebar_depth_bench.scoring.result import Result, Table

CONFIGS_PER_BLOCK = 3
"""Number of configs side by side, as in the paper; further configs follow in blocks below."""

_COLUMNS = 4
_MISSING = "--"
_UNRANKED_MARK = r"$^{\ddagger}$"
_ANCHORED_MARK = r"$^{\dagger}$"
_HEADS = (r"RMSE $\downarrow$", r"AbsRel $\downarrow$", r"AbsRel$_s$ $\downarrow$", "$s$")
_LATEX_ESCAPES = {
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
    # Without braces, "[" or "*" at the start of a row is parsed as an argument of the preceding \\.
    **{char: f"{{{char}}}" for char in "[]*"},
}
_LIGATURE = re.compile(r"([-',])(?=\1)")


@dataclass(frozen=True)
class _TableLine:
    """One row of a table block: its escaped name and its cells, ``_COLUMNS`` for each config."""

    name: str
    cells: list[str]


def latex_table(results: Sequence[Result], *, published: bool, intervals: bool = False) -> str:
    r"""Return ``results`` as a LaTeX ``table*`` with one row per result and four columns per config.

    RMSE (cm) and AbsRel are native, AbsRel_s is computed after the oracle scale, s is its median over views. The
    best number of a column is bold if the column has two or more ranked rows; a row that is not ranked is marked
    with a double dagger and is never bold. With ``published``, the paper's rows of the same scenes follow below a
    rule; they are marked and not compared with the results. With ``intervals``, the 95 % intervals are printed
    beside the numbers, and each block holds one config.

    Raises ``InputError`` if there are no results, or if they belong to different datasets.
    """
    digests = {result.dataset_digest for result in results}
    if len(digests) != 1:
        digest_list = ", ".join(sorted(map(formatting.short_digest, digests))) or "no result"
        raise InputError(f"LaTeX table: results of {len(digests)} datasets ({digest_list}), expected one dataset")
    configs = list(dict.fromkeys(config for result in results for config in result.tables))
    configs_per_block = 1 if intervals else CONFIGS_PER_BLOCK
    blocks = [configs[start : start + configs_per_block] for start in range(0, len(configs), configs_per_block)]
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


def escape_latex(text: str) -> str:
    """Return text from a submission escaped for LaTeX: a single line without commands or control characters."""
    return _LIGATURE.sub(r"\1{}", "".join(_LATEX_ESCAPES.get(char, char) for char in printable(text)))


def _block(results: Sequence[Result], configs: Sequence[str], published: bool, intervals: bool) -> str:
    groups = [rf"\multicolumn{{{_COLUMNS}}}{{c}}{{{_config_title(config)}}}" for config in configs]
    rules = [
        rf"\cmidrule(lr){{{first}-{first + _COLUMNS - 1}}}"
        for first in range(2, 2 + _COLUMNS * len(configs), _COLUMNS)
    ]
    result_lines = _result_lines(results, configs, intervals)
    published_lines = _published_lines(configs) if published else []
    mark = escape_latex(load_published().parts["synthetic"].mark)
    width = 1 + _COLUMNS * len(configs)
    return "\n".join(
        [
            rf"\begin{{tabular}}{{l{'r' * _COLUMNS * len(configs)}}}",
            r"\toprule",
            rf" & {' & '.join(groups)} \\",
            " ".join(rules),
            rf"Method & {' & '.join(_HEADS * len(configs))} \\",
            r"\midrule",
            *(_format_line(line) for line in result_lines),
            *(
                [r"\midrule", rf"\multicolumn{{{width}}}{{l}}{{\emph{{Published, {mark}}}}} \\"]
                if published_lines
                else []
            ),
            *(_format_line(line) for line in published_lines),
            r"\bottomrule",
            r"\end{tabular}",
        ]
    )


def _format_line(line: _TableLine) -> str:
    return rf"{line.name} & {' & '.join(line.cells)} \\"


def _config_title(config: str) -> str:
    """Return a config's heading, with the working distance for a scene of the paper's Table I."""
    scenes = load_published().scenes
    if config not in scenes:
        return escape_latex(config)
    return f"{escape_latex(config)} ({scenes[config].distance.replace('–', '--')})"


def _result_lines(results: Sequence[Result], configs: Sequence[str], intervals: bool) -> list[_TableLine]:
    best = {config: _best_texts([result.tables.get(config) for result in results]) for config in configs}
    lines = []
    for result in results:
        tables = {config: result.tables.get(config) for config in configs}
        if any(tables.values()):
            cells = [cell for config in configs for cell in _cells(tables[config], best[config], intervals)]
            lines.append(_TableLine(escape_latex(result.method), cells))
    return lines


def _cells(table: Table | None, best: Sequence[str | None], intervals: bool) -> list[str]:
    """Return a config's four cells; ``best`` holds the formatted best number of each column, or None."""
    if table is None:
        return [_MISSING] * _COLUMNS
    cells = []
    interval_texts = _interval_texts(table) if intervals else [""] * _COLUMNS
    for text, best_text, interval in zip(_number_texts(table), best, interval_texts, strict=True):
        number = rf"\textbf{{{text}}}" if table.ranked and text == best_text else text
        cells.append(number + (rf" {{\tiny[{interval}]}}" if interval else ""))
    return cells if table.ranked else [cells[0] + _UNRANKED_MARK, *cells[1:]]


def _number_texts(table: Table) -> list[str]:
    return [_MISSING if text == formatting.DASH else text for text in formatting.paper_cells(table)]


def _interval_texts(table: Table) -> list[str]:
    native, scaled = (formatting.metric_interval_cells(table.intervals, kind) for kind in ("native", "scaled"))
    scale = formatting.interval_cell(table.intervals.get("scale_median"), 3)
    return [text.replace(" – ", ", ") for text in (native[1], native[0], scaled[0], scale)]


def _best_texts(tables: Iterable[Table | None]) -> list[str | None]:
    """Return the formatted lowest RMSE, AbsRel and AbsRel_s of the ranked tables, and None for s.

    All are None if fewer than two tables are ranked.
    """
    ranked = [table for table in tables if table is not None and table.ranked]
    if len(ranked) < 2:
        return [None] * _COLUMNS
    lowest = (min(ranked, key=key) for key in (_rmse_cm, _abs_rel, _abs_rel_scaled))
    return [*(_number_texts(table)[column] for column, table in enumerate(lowest)), None]


def _rmse_cm(table: Table) -> float:
    return table.native.rmse_cm if table.native else float("inf")


def _abs_rel(table: Table) -> float:
    return table.native.abs_rel if table.native else float("inf")


def _abs_rel_scaled(table: Table) -> float:
    return table.scaled.abs_rel if table.scaled else float("inf")


def _published_lines(configs: Sequence[str]) -> list[_TableLine]:
    by_config = {config: _published_by_method(config) for config in configs}
    methods = dict.fromkeys(method for rows in by_config.values() for method in rows)
    return [
        _TableLine(
            escape_latex(method),
            [cell for config in configs for cell in _published_cells(by_config[config].get(method))],
        )
        for method in methods
    ]


def _published_by_method(config: str) -> Mapping[str, PublishedRow]:
    return {row.method: row for row in published_rows(paper_scene(config) or "")}


def _published_cells(row: PublishedRow | None) -> list[str]:
    if row is None:
        return [_MISSING] * _COLUMNS
    rmse_cm, *others = row.cells
    return [rmse_cm + (_ANCHORED_MARK if row.median_anchored else ""), *others]


def _caption(results: Sequence[Result], configs: Sequence[str], *, published: bool, intervals: bool) -> str:
    """Return the caption: protocol, dataset, views, alignment, and the meaning of each mark in the table."""
    tables = [(config, result.tables[config]) for result in results for config in result.tables]
    views = dict(tables)
    counts = ", ".join(
        f"{escape_latex(config)} {formatting.counted(views[config].views, 'view')}" for config in configs
    )
    digest = escape_latex(formatting.short_digest(results[0].dataset_digest, 16))
    version = escape_latex(results[0].dataset_version)
    sentences = [
        f"Depth on steel, protocol {escape_latex(PROTOCOL)}, dataset {version} ({digest}): {counts}.",
        "RMSE in cm and AbsRel are native, without any alignment; AbsRel$_s$ is after the oracle scale"
        r" $s = \mathrm{med}(\mathrm{GT})/\mathrm{med}(\mathrm{pred})$ of each view; means over views,"
        " $s$: median over views.",
    ]
    if any(not table.ranked for _, table in tables):
        coverage_percent = f"{MIN_RANKED_COVERAGE * 100:.0f}"
        sentences.append(
            rf"{_UNRANKED_MARK}Not ranked (coverage below {coverage_percent}\,\%, a view without prediction, "
            "or an overflow)."
        )
    if intervals:
        sentences.append(r"In brackets: 95\,\% intervals, block bootstrap over views.")
    paper_methods = [row for config in configs for row in published_rows(paper_scene(config) or "")]
    if published and any(row.median_anchored for row in paper_methods):
        sentences.append(rf"{_ANCHORED_MARK}Median-anchored to ground truth (no fiducial).")
    if published and paper_methods:
        paper = load_published()
        sentences.append(
            f"Published rows: ``{escape_latex(paper.title)}'', {paper.parts['synthetic'].place}, not ranked."
        )
    return " ".join(sentences)
