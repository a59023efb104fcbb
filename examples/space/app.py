"""Gradio app in one file: shows a ranking, and scores an uploaded archive. README.md lists its variables."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

os.environ["GRADIO_ANALYTICS_ENABLED"] = "False"  # Read when gradio is imported.

import gradio as gr
import httpx
from huggingface_hub import snapshot_download

import rebar_depth_bench as rdb
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.errors import MAX_PROBLEMS_SHOWN, printable
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.scoring.disclosure import DisclosedTable
from rebar_depth_bench.scoring.protocol import WITHIN_MM
from rebar_depth_bench.scoring.result import Table
from rebar_depth_bench.scoring.result_io import read_result, read_table

LEADERBOARD, RESULTS, DATASET = (
    os.environ.get(f"REBAR_{name}", "") for name in ("LEADERBOARD", "RESULTS", "DATASET")
)
CONFIGS = os.environ.get("REBAR_CONFIGS", "").split()
MAX_UPLOAD = os.environ.get("REBAR_MAX_UPLOAD", "2gb")
REQUEST_TIMEOUT_S = 20.0
CACHE_S = 3600
"""Age at which uploads are deleted, and the time between two deletions, seconds."""

CSS = """
.rdb .wide { overflow-x: auto; }
.rdb h3 { font-size: 1.15rem; font-weight: 600; margin: 1.25rem 0 .25rem; overflow-wrap: anywhere; }
.rdb p, .rdb li { margin: .4rem 0; overflow-wrap: anywhere; }
.rdb ul { list-style: disc; padding-left: 1.25rem; }
.rdb table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
.rdb th, .rdb td { padding: .4rem .5rem; text-align: right; white-space: nowrap; }
.rdb thead th { vertical-align: bottom; font-weight: 600; border-bottom: 2px solid var(--border-color-primary); }
.rdb tbody tr { border-bottom: 1px solid var(--border-color-primary); }
.rdb .text { text-align: left; }
.rdb tbody .text { font-weight: 400; }
.rdb tbody th.text { white-space: normal; overflow-wrap: anywhere; }
.rdb .name { min-width: 9rem; width: 30%; }
.rdb .reference { font-style: italic; }
.rdb .refused { border-left: 4px solid #b3261e; padding-left: 1rem; }
"""
METRIC_HEADS = [f"{name} {better}<br>{unit}" for name, unit, better in formatting.METRIC_HEADS]
NATIVE_HEADS = [
    *("coverage<br>% ↑", "rank<br>error ↓", *METRIC_HEADS),
    *(f"≤ {tolerance_mm} mm<br>% ↑" for tolerance_mm in WITHIN_MM),
]
SCALED_HEADS = [*METRIC_HEADS, "scale<br>"]
NOTES = (
    f"{formatting.RANK_ERROR_NOTE} A submission that uses ground truth is not ranked. Native: no alignment. "
    "≤ t mm: share of all scored pixels with an error of at most t. Scaled numbers need the ground truth and never"
    " rank. References follow from the ground truth: exact depth shifted by one pixel for native numbers, a "
    "constant on the predicted pixels for scaled ones."
)


@dataclass(frozen=True)
class Row:
    """Row of the ranking: rank (None: not ranked), method, declared input class, and the table of the config."""

    rank: int | None
    method: str
    inputs: str | None
    table: Table


class SourceError(Exception):
    """Ranking that cannot be read; the message is shown."""


def configs() -> list[str]:
    """Return the names of the configs to choose from. Raises ``SourceError``."""
    if CONFIGS:
        return CONFIGS
    if RESULTS and not LEADERBOARD:
        return sorted({name for result in read_results() for name in result.tables})
    if not DATASET:
        raise SourceError("Neither REBAR_CONFIGS nor REBAR_DATASET is set: it is unknown which configs there are.")
    try:
        return list(open_folder(DATASET).configs)
    except rdb.InputError as error:
        raise SourceError(f"The dataset cannot be read: {error}") from error


def ranking(config: str) -> list[Row]:
    """Return the rows of a config from the leaderboard or the results. Raises ``SourceError``."""
    if LEADERBOARD:
        return leaderboard_rows(config)
    if RESULTS:
        return ranked_rows(read_results(), config)
    raise SourceError("Neither REBAR_LEADERBOARD nor REBAR_RESULTS is set: there is no ranking to show.")


def leaderboard_rows(config: str) -> list[Row]:
    """Return the rows of ``GET /api/v1/leaderboard``. Raises ``SourceError`` without a valid answer."""
    address = f"{LEADERBOARD.rstrip('/')}/api/v1/leaderboard"
    try:
        answer = httpx.get(address, params={"config": config}, timeout=REQUEST_TIMEOUT_S).raise_for_status().json()
        return [
            Row(row["rank"], str(row["method"]), row["inputs"], disclosed_table(row["table"]))
            for row in answer["rows"]
        ]
    except (httpx.HTTPError, ValueError, KeyError, TypeError, rdb.InputError) as error:
        raise SourceError(f"{LEADERBOARD} gave no ranking of {config}: {error}") from error


def disclosed_table(table: Mapping[str, object]) -> Table:
    """Return the table of a leaderboard's row; one with hidden ground truth tells coverage and rank error only.

    Raises ``InputError`` or ``ValueError`` for an invalid table.
    """
    if "native" in table:
        return read_table(table)
    known = DisclosedTable.model_validate(table)
    unknown = dict.fromkeys(WITHIN_MM)
    return Table(0, 0, known.coverage, known.ranked, known.rank_error, None, None, None, unknown)


def read_results() -> list[rdb.Result]:
    """Return the results of the folder or Hub dataset. Raises ``SourceError`` for an invalid one."""
    try:
        is_local = Path(RESULTS).is_dir()
        repository, _, revision = RESULTS.partition("@")
        folder = Path(
            RESULTS
            if is_local
            else snapshot_download(
                repository, repo_type="dataset", revision=revision or None, allow_patterns="*.json"
            )
        )
        return [
            read_result(file.read_bytes(), str(file.relative_to(folder)))
            for file in sorted(folder.rglob("*.json"))
        ]
    except Exception as error:  # The errors of the Hub's HTTP client have no common base class.
        raise SourceError(f"The results in {RESULTS} cannot be read: {error}") from error


def ranked_rows(results: Sequence[rdb.Result], config: str) -> list[Row]:
    """Return the rows of results that have a config: ranked ones first, equal rank errors share a rank."""
    with_config = [result for result in results if config in result.tables]
    values = [ranking_value(result.tables[config]) for result in with_config]
    ordered = sorted(value for value in values if value is not None)
    rows = [
        Row(
            None if value is None else 1 + ordered.index(value),
            result.method,
            result.declared.inputs,
            result.tables[config],
        )
        for result, value in zip(with_config, values, strict=True)
    ]
    return sorted(rows, key=lambda row: (row.rank is None, row.rank or 0, row.method))


def ranking_value(table: Table) -> float | None:
    """Return the rank error that ranks, to 12 significant digits; None for a table that is not ranked."""
    return float(f"{table.rank_error:.12g}") if table.ranked and table.rank_error is not None else None


def show_ranking(config: str | None) -> str:
    """Return the HTML of a config's ranking, or of the reason why there is none."""
    try:
        rows = ranking(config) if config else []
    except SourceError as error:
        return refusal("No ranking", [str(error)])
    if not rows:
        return '<div class="rdb"><p>There are no results yet.</p></div>'
    texts = [
        (row.method, formatting.DASH if row.rank is None else str(row.rank), row.inputs or "not declared")
        for row in rows
    ]
    tables = [row.table for row in rows]
    return show_tables(
        ("method", "rank", "inputs"), texts, tables, {"": [(row.method, row.table) for row in rows]}
    )


def show_tables(
    heads: Sequence[str],
    texts: Sequence[Sequence[str]],
    tables: Sequence[Table],
    results: Mapping[str, Sequence[tuple[str, Table]]],
) -> str:
    """Return the HTML of a native and a scaled table; ``texts`` are the first cells of each row.

    The reference errors of ``results``, methods and tables of a config, follow, by what their names begin with.
    """
    native = [table_row(text, native_cells(table)) for text, table in zip(texts, tables, strict=True)]
    scaled = [table_row(text, scaled_cells(table)) for text, table in zip(texts, tables, strict=True)]
    empty = [""] * (len(heads) - 1)
    for name, of_config in results.items():
        for title, native_errors, scaled_errors in formatting.reference_rows(of_config):
            texts = [f"{name}reference, {title}", *empty]
            if any(native_errors):
                native.append(table_row(texts, ["", "", *native_errors, *[""] * 4], "reference"))
            if any(scaled_errors):
                scaled.append(table_row(texts, [*scaled_errors, ""], "reference"))
    return (
        f'<div class="rdb"><h3>Native</h3>{html_table(heads, NATIVE_HEADS, native)}'
        f"<h3>Scaled by the true median of each view</h3>{html_table(heads, SCALED_HEADS, scaled)}"
        f"<p>{NOTES}</p></div>"
    )


def native_cells(table: Table) -> list[str]:
    """Return the cells of ``NATIVE_HEADS``."""
    return [
        formatting.coverage_percent(table.coverage),
        formatting.rank_error_cell(table.rank_error),
        *formatting.metric_cells(table.native),
        *formatting.within_cells(table.within_mm),
    ]


def scaled_cells(table: Table) -> list[str]:
    """Return the cells of ``SCALED_HEADS``."""
    return [*formatting.metric_cells(table.scaled), formatting.scale_cell(table.scale_median)]


def html_table(heads: Sequence[str], number_heads: Sequence[str], rows: Sequence[str]) -> str:
    """Return an HTML table with a column of names, further texts, and numbers."""
    kinds = ["text name", *["text"] * (len(heads) - 1), *["number"] * len(number_heads)]
    cells = "".join(
        f'<th scope="col" class="{kind}">{head}</th>'
        for kind, head in zip(kinds, [*heads, *number_heads], strict=True)
    )
    return f'<div class="wide"><table><thead><tr>{cells}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'


def table_row(texts: Sequence[str], cells: Sequence[str], kind: str = "") -> str:
    """Return an HTML row; ``texts`` may come from anyone, the first one is its name."""
    name, *others = [escape(printable(text)) for text in texts]
    shown = "".join(f'<td class="text">{text}</td>' for text in others) + "".join(
        f"<td>{cell}</td>" for cell in cells
    )
    return f'<tr class="{kind}"><th class="text" scope="row">{name}</th>{shown}</tr>'


def refusal(title: str, lines: Sequence[str]) -> str:
    """Return the HTML of a message with one line per problem."""
    shown = "".join(f"<li>{escape(printable(line, 500))}</li>" for line in lines[:MAX_PROBLEMS_SHOWN])
    omitted = len(lines) - MAX_PROBLEMS_SHOWN
    more = f"<li>and {omitted} more</li>" if omitted > 0 else ""
    message = f"<h3>{escape(title)}</h3><ul>{shown}{more}</ul>"
    return f'<div class="rdb"><div class="refused" role="alert">{message}</div></div>'


def score_upload(archive: str | None) -> tuple[str, str | None]:
    """Return the HTML of an archive's tables, or of its problems, and the path of its result as JSON or None."""
    if not DATASET:
        return refusal(
            "Nothing to score against", ["REBAR_DATASET is not set: this app scores no archives."]
        ), None
    if archive is None:
        return refusal("No archive", ["Choose a zip file first."]), None
    try:
        result = rdb.score(archive, DATASET)
    except rdb.SubmissionError as error:
        count = len(error.problems)
        title = f"{Path(archive).name} was refused: {count} problem{'' if count == 1 else 's'}"
        return refusal(title, [str(problem) for problem in error.problems]), None
    except rdb.DatasetError as error:
        print(error, flush=True)
        return refusal("Not scored", ["The dataset of this app cannot be read; its log has the reason."]), None
    file = Path(archive).with_suffix(".result.json")
    file.write_bytes(result.to_json())
    head = (
        f"<h3>{escape(printable(result.method))}</h3><p>{escape(formatting.declaration_text(result.declared))}</p>"
    )
    texts = [(name, str(table.views)) for name, table in result.tables.items()]
    results = {f"{name}: ": [(result.method, table)] for name, table in result.tables.items()}
    tables = show_tables(("config", "views"), texts, [*result.tables.values()], results)
    return f'<div class="rdb">{head}</div>{tables}', str(file)


def choices() -> tuple[list[str], str]:
    """Return the configs, and the HTML of the first one's ranking or of the reason why there is none."""
    try:
        names = configs()
    except SourceError as error:
        return [], refusal("No ranking", [str(error)])
    return names, show_ranking(names[0] if names else None)


def load_page() -> tuple[dict[str, object], str]:
    """Return the state of the list of configs and the first ranking, when a page is opened."""
    names, html = choices()
    return gr.update(choices=names, value=names[0] if names else None), html


def build() -> gr.Blocks:
    """Return the app."""
    with gr.Blocks(title="Rebar Depth Bench", analytics_enabled=False, delete_cache=(CACHE_S, CACHE_S)) as app:
        gr.Markdown("# Rebar Depth Bench\nMetric depth on steel reinforcement, against exact ground truth.")
        with gr.Tab("Leaderboard"):
            config = gr.Dropdown([], label="Config")
            board = gr.HTML(apply_default_css=False)
            refresh = gr.Button("Refresh", size="sm")
        with gr.Tab("Score an archive"):
            archive = gr.File(label="Archive (zip)", file_types=[".zip"], height=140)
            button = gr.Button("Score", variant="primary")
            outcome = gr.HTML(apply_default_css=False)
            result = gr.File(label="Result as JSON", visible=False)
        app.load(load_page, None, [config, board], api_visibility="private")
        gr.on([config.input, refresh.click], show_ranking, config, board, api_visibility="private")

        def score(upload: str | None) -> tuple[str, dict[str, object]]:
            html, file = score_upload(upload)
            return html, gr.update(value=file, visible=file is not None)

        # One at a time: each uses all cores.
        button.click(score, archive, [outcome, result], concurrency_limit=1, api_visibility="private")
    return app


def main() -> None:
    """Serve the app until it is stopped."""
    theme = gr.themes.Base(font=["system-ui", "sans-serif"], font_mono=["monospace"])
    build().queue(max_size=20).launch(
        theme=theme, css=CSS, max_file_size=MAX_UPLOAD, ssr_mode=False, footer_links=["gradio", "settings"]
    )


if __name__ == "__main__":
    main()
