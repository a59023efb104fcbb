r"""LaTeX table of results: rank error, coverage, share within 5 mm, and the numbers of the paper's Table I.

The output of the template ``table.tex.j2`` requires only ``\usepackage{booktabs}``. Non-Latin letters require
XeLaTeX or LuaLaTeX.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence

from jinja2 import PackageLoader, Template

from rebar_depth_bench.base.errors import InputError, printable
from rebar_depth_bench.reporting.html.assets import environment
from rebar_depth_bench.reporting.published import load_published, published_rows
from rebar_depth_bench.scoring import formatting
from rebar_depth_bench.scoring.columns import (
    ALIGNED_CONSTANT,
    DASH,
    PAPER_COLUMNS,
    TABLE_COLUMNS,
    Better,
    Column,
    columns_at,
)
from rebar_depth_bench.scoring.comparison import config_differences
from rebar_depth_bench.scoring.relative import ALIGNMENT_BY_KIND
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.table import PublishedMatch, Table

_COLUMNS = (*TABLE_COLUMNS, *PAPER_COLUMNS)
_HEADS: Mapping[str, str] = {
    "rank_error": "$E$",
    "coverage": r"cov.\,\%",
    "within_mm.5": r"5\,mm\,\%",
    "native.rmse_cm": "RMSE",
    "native.abs_rel": "AbsRel",
    "scaled.abs_rel": "AbsRel$_s$",
    "scale_median": "$s$",
}
_ALIGNED_HEADS: Mapping[str, str] = {
    "aligned.error": "$E$",
    "constant.error": r"\shortstack[r]{const.\\$E$}",
    "aligned.abs_rel": "AbsRel",
    "aligned_robust.abs_rel": "robust",
    "constant.abs_rel": r"\shortstack[r]{const.\\AbsRel}",
}
"""Headings of the columns of predictions that are not metric."""
_ARROWS: Mapping[Better, str] = {"lower": r" $\downarrow$", "higher": r" $\uparrow$", "": ""}
_WITHOUT_INTERVAL = ("coverage", "within_mm.5")
"""Places of the columns whose intervals are left out for width."""
_MISSING = "--"
_NONE = [""] * len(TABLE_COLUMNS)
"""Cells of rows that have the numbers of the paper's table only."""
_MARKS: Mapping[str, str] = {"‡": r"$^{\ddagger}$", "?": "$^{?}$", "*": "$^{*}$", "": ""}
_INCOMPARABLE = "$^{*}$Not comparable with other rows: predictions are missing, or a number overflowed."
"""Note of the caption; the methods and reasons are in a comment."""
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
_FORMULA = re.compile(r"(?:1 / )?p = (?:a x \+ b|x median\(z\) / median\(x\))|(?:1 / )?\bz\b")
"""Formulas in ``ALIGNMENT_BY_KIND``."""


def latex_table(
    results: Sequence[Result], *, published: bool, intervals: bool = False, absent: Sequence[str] = ()
) -> str:
    r"""Return ``results`` as a LaTeX ``table*`` with one row per result and the same columns per config.

    RMSE (cm) and AbsRel are native, AbsRel_s is computed after the oracle scale, s is its median over views. A
    number of a ranked row is bold if ``compare`` finds it better than that of every other ranked row. A row that
    is not ranked is marked with a double dagger. Numbers of valid predictions have an asterisk in a row whose
    errors are not compared with those of others. With ``published``, the paper's rows of the same scenes follow
    below a rule; they are marked and not compared with the results. ``absent`` is as in ``print_paper_table``.
    With ``intervals``, the 95 % intervals are printed beside the numbers, except for coverage and the share within
    5 mm. Results that are not metric follow in a table for each kind, in the order of the aligned error, without
    bold numbers. The caption is for readers of a paper; digest, versions and the reasons why rows are not
    comparable are comments above the table.

    Raises ``InputError`` if there are no results, or if they belong to different datasets.
    """
    digests = {result.dataset.digest for result in results}
    if len(digests) != 1:
        digest_list = ", ".join(sorted(map(formatting.short_digest, digests))) or "no result"
        raise InputError(f"LaTeX table: results of {len(digests)} datasets ({digest_list}), expected one dataset")
    blocks = formatting.kind_blocks(results)
    return "\n\n".join(_table_of_kind(block, absent, published=published, intervals=intervals) for block in blocks)


def _table_of_kind(results: Sequence[Result], absent: Sequence[str], *, published: bool, intervals: bool) -> str:
    """Return the ``table*`` of results of one kind."""
    kind = results[0].prediction
    columns = _COLUMNS if kind is None else columns_at(*_ALIGNED_HEADS)
    tables = {config: table for result in results for config, table in result.tables.items()}
    published = published and kind is None
    matches = {config: table.published for config, table in tables.items() if published and table.published}
    paper_rows = [row for match in matches.values() for row in published_rows(match.scene)]
    rows = {config: _result_rows(results, config, columns, intervals) for config in tables}
    notes, captioned = (formatting.row_notes(results, one) for one in (absent if kind is None else (), ()))
    flat = [
        f"{result.method}, {formatting.config_title(config, table.split)} "
        f"({table['flat_views']:.0f} of {formatting.counted(table.views, 'view')})"
        for result in results
        for config, table in result.tables.items()
        if table["flat_views"] > 0
    ]
    if flat:
        captioned.append(("", "Fits without a positive slope, which are constants: ", flat))
    return _template().render(
        protocol=results[0].protocol,
        kind=kind,
        alignment=_FORMULA.sub(r"$\g<0>$", ALIGNMENT_BY_KIND.get(kind or "", "")).replace(
            "median", r"\mathrm{med}"
        ),
        heads=[_head(column) for column in columns],
        version=results[0].dataset.version,
        digest=results[0].dataset.digest,
        software=results[0].software.version,
        view_counts=[
            f"{_config_name(config, table)}, {formatting.counted(table.views, 'view')}"
            for config, table in tables.items()
        ],
        notes=[_INCOMPARABLE if note[0] == "*" else _note_text(*note) for note in captioned],
        comments=[_note_text(*note) for note in notes if note[0] == "*" or note not in captioned],
        bold=any(r"\textbf" in cell for of_config in rows.values() for row in of_config for cell in row[1:]),
        intervals=intervals,
        resampled=_resampled(tables.values()),
        anchored=any(row.median_anchored for row in paper_rows),
        anchored_mark=_ANCHORED_MARK,
        published=bool(paper_rows),
        other_optics=any(not match.same_optics for match in matches.values()),
        other_optics_mark=_OTHER_OPTICS_MARK,
        paper=load_published(),
        blocks=[  # Two side by side are wider than a page of 17 cm.
            {
                "title": _config_title(config, table),
                "rows": rows[config],
                "reference_rows": _reference_rows(results, config),
                "published_rows": _published_rows(matches.get(config)),
            }
            for config, table in tables.items()
        ],
    )


def escape_latex(text: str) -> str:
    """Return text from a submission escaped for LaTeX: a single line without commands or control characters."""
    return _LIGATURE.sub(r"\1{}", "".join(_LATEX_ESCAPES.get(char, char) for char in printable(text)))


def _note_text(mark: str, start: str, listed: Sequence[str]) -> str:
    """Return a note of ``formatting.row_notes`` as a sentence."""
    return _MARKS[mark] + start + "; ".join(map(escape_latex, listed)) + "."


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


def _result_rows(
    results: Sequence[Result], config: str, columns: Sequence[Column], intervals: bool
) -> list[list[str]]:
    """Return the rows of a config, each a name and its cells."""
    shown = [result for result in results if config in result.tables]
    return [
        [
            escape_latex(result.method) + _MARKS["?"] * (result.declared.uses_ground_truth is None),
            *_cells(result, results, config, columns, intervals),
        ]
        for result in sorted(shown, key=lambda result: _sort_key(result.tables[config]))
    ]


def _head(column: Column) -> str:
    """Return the heading of a column: the heading of the paper's table, if it has one."""
    unit = f", {column.unit}" if column.unit else ""
    heads = {**_HEADS, **_ALIGNED_HEADS}
    arrow = "" if column in ALIGNED_CONSTANT else _ARROWS[column.better]
    return heads.get(column.place, escape_latex(f"{column.title}{unit}")) + arrow


def _sort_key(table: Table) -> tuple[bool, float]:
    """Return the sort key of a row: ranked rows by rank error, the others last."""
    return not table.ranked, formatting.sort_error(table)


def _bold_places(result: Result, results: Sequence[Result], config: str) -> set[str]:
    """Return the places of the numbers of a config in which a result is decided to be better than all others.

    Only ranked rows are compared; without another one there are no such numbers.
    """
    others = [
        other
        for other in results
        if other is not result and config in other.tables and other.tables[config].ranked
    ]
    # The best first: most results are better than it in no number, and need no other comparison.
    others.sort(key=lambda other: _sort_key(other.tables[config]))
    better = {column.place for column in _COLUMNS} if others else set()
    for other in others:
        if better:
            rows = config_differences(other, result, config)
            better &= {row.column.place for row in rows if row.verdict == "better"}
    return better


def _cells(
    result: Result, results: Sequence[Result], config: str, columns: Sequence[Column], intervals: bool
) -> list[str]:
    """Return the cells of a result in a config, with their marks, bold among the ``results`` of the table."""
    table = result.tables[config]
    bold = _bold_places(result, results, config) if table.ranked else set()
    unranked = _MARKS["‡"] if formatting.rank_mark(result.declared) == "‡" else ""
    incomparable = _MARKS["*"] if formatting.incomparable_reasons(table) else ""
    cells = []
    for column in columns:
        number = column.text(table[column.place]).replace(DASH, _MISSING)
        shows_interval = intervals and column.place not in _WITHOUT_INTERVAL
        interval = column.interval_text(table.interval(column), ", ") if shows_interval else ""
        shown = rf"\textbf{{{number}}}" if column.place in bold else number
        mark = unranked if column is columns[0] else "" if column.of_all_views else incomparable
        cells.append(shown + mark + (rf" {{\tiny[{interval}]}}" if interval else ""))
    return cells


def _reference_rows(results: Sequence[Result], config: str) -> list[list[str]]:
    """Return the name and the cells of each reference of a config of metric results."""
    metric = [result for result in results if result.prediction is None]
    shown = [(result.method, result.tables[config]) for result in metric if config in result.tables]
    return [[escape_latex(name), *_NONE, *cells] for name, cells in formatting.paper_reference_rows(shown)]


def _published_rows(match: PublishedMatch | None) -> list[list[str]]:
    """Return the method and the cells of each published row of the scene that a config shows."""
    if match is None:
        return []
    optics = "" if match.same_optics else _OTHER_OPTICS_MARK
    return [
        [
            escape_latex(row.method),
            *_NONE,
            *(cell + (_ANCHORED_MARK if row.median_anchored else "") + optics for cell in row.cells),
        ]
        for row in published_rows(match.scene)
    ]
