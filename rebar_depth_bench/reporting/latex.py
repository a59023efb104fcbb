r"""LaTeX table of results: rank error, and RMSE, AbsRel, AbsRel_s and s as in the paper's Table I, by config.

The output of the template ``table.tex.j2`` requires only ``\usepackage{booktabs}``. Non-Latin letters require
XeLaTeX or LuaLaTeX.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence

from jinja2 import PackageLoader, Template

from rebar_depth_bench.errors import InputError, printable
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.html.assets import environment
from rebar_depth_bench.reporting.published import PublishedRow, load_published, published_rows
from rebar_depth_bench.scoring.columns import DASH, PAPER_COLUMNS, RANK_ERROR, rounded, texts
from rebar_depth_bench.scoring.protocol import PROTOCOL
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.table import PublishedMatch, Table

CONFIGS_PER_BLOCK = 2
"""Number of configs side by side that fit into a page width of 17 cm; further configs follow in blocks below."""

_TABLE_COLUMNS = (RANK_ERROR, *PAPER_COLUMNS)
_COLUMNS = len(_TABLE_COLUMNS)
_MISSING = "--"
_UNRANKED_MARK = r"$^{\ddagger}$"
_OTHER_OPTICS_MARK = r"$^{\S}$"
_ANCHORED_MARK = r"$^{\dagger}$"
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


def latex_table(results: Sequence[Result], *, published: bool, intervals: bool = False) -> str:
    r"""Return ``results`` as a LaTeX ``table*`` with one row per result and four columns per config.

    RMSE (cm) and AbsRel are native, AbsRel_s is computed after the oracle scale, s is its median over views. The
    best number of a column is bold if the column has two or more ranked rows; a row that is not ranked is marked
    with a double dagger and is never bold. With ``published``, the paper's rows of the same scenes follow below a
    rule; they are marked and not compared with the results. With ``intervals``, the 95 % intervals are printed
    beside the numbers, and each block holds one config.

    Raises ``InputError`` if there are no results, or if they belong to different datasets.
    """
    digests = {result.dataset.digest for result in results}
    if len(digests) != 1:
        digest_list = ", ".join(sorted(map(formatting.short_digest, digests))) or "no result"
        raise InputError(f"LaTeX table: results of {len(digests)} datasets ({digest_list}), expected one dataset")
    tables = {config: table for result in results for config, table in result.tables.items()}
    configs = list(tables)
    configs_per_block = 1 if intervals else CONFIGS_PER_BLOCK
    blocks = [configs[start : start + configs_per_block] for start in range(0, len(configs), configs_per_block)]
    matches = {config: tables[config].published if published else None for config in configs}
    paper_rows = [row for match in matches.values() for row in _paper_rows(match)]
    return _template().render(
        protocol=PROTOCOL,
        columns=_COLUMNS,
        version=results[0].dataset.version,
        digest=formatting.short_digest(results[0].dataset.digest, 16),
        view_counts=[
            f"{_config_name(config, table)} {formatting.counted(table.views, 'view')}"
            for config, table in tables.items()
        ],
        unranked=any(not table.ranked for result in results for table in result.tables.values()),
        undeclared=any(result.declared.uses_ground_truth is None for result in results),
        unranked_mark=_UNRANKED_MARK,
        intervals=intervals,
        resampled=_resampled(tables.values()),
        anchored=any(row.median_anchored for row in paper_rows),
        anchored_mark=_ANCHORED_MARK,
        published=bool(paper_rows),
        other_optics=any(match is not None and not match.same_optics for match in matches.values()),
        other_optics_mark=_OTHER_OPTICS_MARK,
        paper=load_published(),
        blocks=[
            {
                "titles": [_config_title(config, tables[config]) for config in block],
                "rows": _result_rows(results, block, intervals),
                "reference_rows": _reference_rows(results, block),
                "published_rows": _published_rows({config: matches[config] for config in block}),
            }
            for block in blocks
        ],
    )


def escape_latex(text: str) -> str:
    """Return text from a submission escaped for LaTeX: a single line without commands or control characters."""
    return _LIGATURE.sub(r"\1{}", "".join(_LATEX_ESCAPES.get(char, char) for char in printable(text)))


def _template() -> Template:
    """Return the template; its delimiters do not occur in the table, and its filter ``tex`` escapes text."""
    loader = PackageLoader("rebar_depth_bench", "reporting")
    latex_environment = environment(loader).overlay("<%", "%>", "<<", ">>", "<#", "#>", autoescape=False)
    latex_environment.filters["tex"] = escape_latex
    return latex_environment.get_template("table.tex.j2")


def _resampled(tables: Iterable[Table]) -> str:
    """Return how intervals are determined."""
    by_scene = {table.split is not None for table in tables}
    if by_scene == {True}:
        return "bootstrap over scenes"
    return "block bootstrap over views" + (", with splits over scenes" if True in by_scene else "")


def _config_name(config: str, table: Table) -> str:
    return escape_latex(formatting.config_title(config, table.split))


def _config_title(config: str, table: Table) -> str:
    """Return a config's heading, with the working distance for a scene of the paper's Table I."""
    scene = load_published().scenes.get(table.published.scene) if table.published else None
    return _config_name(config, table) + (f" ({scene.distance.replace('–', '--')})" if scene else "")


def _result_rows(results: Sequence[Result], configs: Sequence[str], intervals: bool) -> list[list[str]]:
    """Return the rows of a block, each a name and four cells for each config."""
    best = {config: _best_texts([result.tables.get(config) for result in results]) for config in configs}
    shown = [result for result in results if any(name in result.tables for name in configs)]
    return [
        [
            escape_latex(result.method) + ("" if result.declared.uses_ground_truth is not None else "$^{?}$"),
            *(cell for name in configs for cell in _cells(result.tables.get(name), best[name], intervals)),
        ]
        for result in sorted(shown, key=lambda result: _sort_key(result.tables.get(configs[0])))
    ]


def _sort_key(table: Table | None) -> tuple[bool, bool, float]:
    """Return the sort key of a row by the block's first config: ranked rows by rank error, the others last."""
    if table is None:
        return True, True, 0.0
    return False, not table.ranked, rounded(table.rank_error) or 0.0


def _reference_rows(results: Sequence[Result], configs: Sequence[str]) -> list[list[str]]:
    """Return the rows of reference errors of a block, each a name and the cells of each config."""
    rows_by_config = {}
    for config in configs:
        shown = [(result.method, result.tables[config]) for result in results if config in result.tables]
        rows_by_config[config] = dict(formatting.paper_reference_rows(shown))
    names = dict.fromkeys(name for rows in rows_by_config.values() for name in rows)
    empty = [""] * (_COLUMNS - 1)
    return [
        [escape_latex(name), *(cell for rows in rows_by_config.values() for cell in ("", *rows.get(name, empty)))]
        for name in names
    ]


def _cells(table: Table | None, best: Sequence[str | None], intervals: bool) -> list[str]:
    """Return a config's cells; ``best`` holds the formatted best number of each column, or None."""
    if table is None:
        return [_MISSING] * _COLUMNS
    cells = []
    interval_texts = _interval_texts(table) if intervals else [""] * _COLUMNS
    for text, best_text, interval in zip(_number_texts(table), best, interval_texts, strict=True):
        number = rf"\textbf{{{text}}}" if table.ranked and text == best_text else text
        cells.append(number + (rf" {{\tiny[{interval}]}}" if interval else ""))
    return cells if table.ranked else [cells[0] + _UNRANKED_MARK, *cells[1:]]


def _number_texts(table: Table) -> list[str]:
    return [_MISSING if text == DASH else text for text in texts(_TABLE_COLUMNS, table)]


def _interval_texts(table: Table) -> list[str]:
    return [column.interval_text(table.intervals.get(column.path), ", ") for column in _TABLE_COLUMNS]


def _best_texts(tables: Iterable[Table | None]) -> list[str | None]:
    """Return the formatted lowest rank error, RMSE, AbsRel and AbsRel_s of the ranked tables, and None for s.

    All are None if fewer than two tables are ranked, and all but the first if not all of these are comparable.
    """
    ranked = [table for table in tables if table is not None and table.ranked]
    if len(ranked) < 2:
        return [None] * _COLUMNS
    columns = 4 if all(table.is_comparable for table in ranked) else 1
    best = [
        _number_texts(min(ranked, key=lambda table: _errors(table)[column]))[column] for column in range(columns)
    ]
    return [*best, *[None] * (_COLUMNS - columns)]


def _errors(table: Table) -> list[float]:
    """Return rank error, RMSE and AbsRel, native, and AbsRel after the oracle scale; infinity where undefined."""
    values = [column.value(table) for column in _TABLE_COLUMNS[:-1]]
    return [math.inf if value is None else value for value in values]


def _paper_rows(match: PublishedMatch | None) -> tuple[PublishedRow, ...]:
    return published_rows(match.scene) if match else ()


def _published_rows(matches: Mapping[str, PublishedMatch | None]) -> list[list[str]]:
    by_config = {
        config: {
            row.method: _published_cells(row, match is None or match.same_optics) for row in _paper_rows(match)
        }
        for config, match in matches.items()
    }
    methods = dict.fromkeys(method for rows in by_config.values() for method in rows)
    missing = [_MISSING] * _COLUMNS
    return [
        [escape_latex(method), *(cell for rows in by_config.values() for cell in rows.get(method, missing))]
        for method in methods
    ]


def _published_cells(row: PublishedRow, same_optics: bool) -> list[str]:
    rmse_cm, *others = row.cells
    marks = (_ANCHORED_MARK if row.median_anchored else "") + ("" if same_optics else _OTHER_OPTICS_MARK)
    return ["", rmse_cm + marks, *others]
