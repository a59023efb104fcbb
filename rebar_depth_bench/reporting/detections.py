"""Page and terminal tables of a detector of crossings: numbers with intervals, and precision over recall."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from rebar_depth_bench import software_version
from rebar_depth_bench.bar_crossings.definition import CROSSINGS_PROTOCOL
from rebar_depth_bench.detections.result import AVERAGE_PRECISION_MM, DetectionResult, DetectionTable
from rebar_depth_bench.detections.score import MATCH_M
from rebar_depth_bench.errors import printable
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.charts.lines import HEIGHT, LEFT, RIGHT, TOP, ChartText, LinearAxis, Series, chart
from rebar_depth_bench.reporting.table_page import Columns, PageFigure, PageTable, TablePage, page_table
from rebar_depth_bench.scoring.columns import ARROWS, DASH, Column

Row = tuple[str, DetectionTable]
"""Name and table of a config, or of all together."""

_SHARES = (
    Column("precision", "Precision", "%", "higher", 1, 100.0),
    Column("recall", "Recall", "%", "higher", 1, 100.0),
    Column("f1", "F1", "%", "higher", 1, 100.0),
    Column("node_recall", "Recall of nodes", "%", "higher", 1, 100.0),
)
_AVERAGES = tuple(
    Column(f"average_precision_{limit}mm", f"AP at {limit} mm", "%", "higher", 1, 100.0)
    for limit in AVERAGE_PRECISION_MM
)
_ERRORS = (
    Column("position_mm", "Position", "mm, median", "lower", 2),
    Column("position_p95_mm", "Position", "mm, p95", "lower", 2),
    Column("normal_deg", "Normal", "degrees, median", "lower", 2),
    Column("normal_p95_deg", "Normal", "degrees, p95", "lower", 2),
)


def detection_page(result: DetectionResult) -> TablePage:
    """Return the page of a result; its tables are also those of the terminal."""
    rows: list[Row] = list(result.tables.items())
    if len(rows) > 1:
        rows.append(("all", result.pooled))
    threshold = result.least_confidence
    matched = "all detections" if threshold is None else f"detections with a confidence of {threshold:g} or more"
    method = printable(result.meta.method)
    return TablePage(
        subject="crossings",
        title=f"{method}: detected crossings of bars",
        lead=f"Crossings that the left image shows well enough are to be found. Matched within "
        f"{1000 * MATCH_M:g} mm: {matched}.",
        stamps=_stamps(result),
        figures=[_curve_figure(name, table) for name, table in rows if table.counts["crossings"]],
        tables=(
            _number_table("Precision and recall, pooled over views.", _SHARES, rows),
            _number_table(
                "Average precision over all confidences: greedy matching, the most confident first.",
                _AVERAGES,
                rows,
            ),
            _number_table(
                "Errors of matched detections: tie point, and normal where one is given.", _ERRORS, rows
            ),
            _count_table(rows),
        ),
        notes=_notes(result),
    )


def _stamps(result: DetectionResult) -> list[tuple[str, str]]:
    declared = result.meta.declaration
    return [
        ("Protocol", CROSSINGS_PROTOCOL),
        ("Inputs", formatting.inputs_text(declared)),
        ("Ground truth", formatting.ground_truth_text(declared)),
        ("Dataset", f"{printable(result.dataset_version)} ({printable(result.dataset_digest)})"),
        ("Crossings", f"{printable(result.source.file)} {printable(result.source.sha256)}"),
        ("File", printable(result.sha256)),
        ("Software", f"rebar-depth-bench {printable(software_version())}"),
    ]


def _number_table(caption: str, numbers: Sequence[Column], rows: list[Row]) -> PageTable:
    """Return the table of some numbers, each beside its interval."""
    columns: list[tuple[str, str, Callable[[Row], str]]] = [("Config", "", lambda row: printable(row[0]))]
    for column in numbers:
        title = f"{column.title} {ARROWS[column.better]}"
        columns += [
            (title, column.unit, partial(_value, column)),
            (title, "95 % interval", partial(_ends, column)),
        ]
    return page_table(caption, columns, rows)


def _value(column: Column, row: Row) -> str:
    return column.text(row[1].numbers[column.path])


def _ends(column: Column, row: Row) -> str:
    return column.interval_text(row[1].intervals[column.path], " to ") or DASH


def _count(name: str) -> Callable[[Row], str]:
    return lambda row: str(row[1].counts[name])


def _count_table(rows: list[Row]) -> PageTable:
    columns: Columns[Row] = (
        ("Config", "", lambda row: printable(row[0])),
        ("Views", "", lambda row: str(row[1].views)),
        ("Crossings", "judged", _count("crossings")),
        ("Nodes", "judged", _count("nodes")),
        ("Detections", "", _count("detections")),
        ("Matched", "", _count("matched")),
        ("False", "", _count("false")),
        ("Ignored", "", _count("ignored")),
    )
    return page_table("Numbers over all views.", columns, rows)


def _curve_figure(name: str, table: DetectionTable) -> PageFigure:
    series = [
        Series(f"{limit} mm", colour, line=[(0.0, curve[0][1]), *curve] if curve else [])
        for colour, (limit, curve) in enumerate(table.curves.items())
    ]
    average = "; ".join(
        f"average precision at {limit} mm: {_value(column, (name, table))} %"
        for limit, column in zip(AVERAGE_PRECISION_MM, _AVERAGES, strict=True)
    )
    labels = ChartText(f"Precision over recall, {name}", average, "recall", "precision")
    svg = chart(series, LinearAxis(0, 1, LEFT, RIGHT), LinearAxis(0, 1, HEIGHT, TOP), labels)
    caption = f"By the distance within which a detection is correct; {average}."
    return PageFigure(svg, f"{printable(name)}: precision over recall.", caption)


def _notes(result: DetectionResult) -> list[str]:
    notes = [
        "A crossing is judged by the ground truth of the left eye alone: its tie point's pixel shows one of the "
        "bars, and each bar has 30 single-bar interior pixels or more within 6 diameters, on both sides.",
        f"Ignored: detections whose nearest crossing is not judged and within {1000 * MATCH_M:g} mm, one for each "
        "such crossing, and those that project onto a bar whose axis is not known.",
        f"Intervals: bootstrap over blocks of neighbouring views, or over scenes. {DASH}: undefined or unknown.",
    ]
    if not result.has_confidence:
        notes.append("The file has no confidences, so that average precision has one point of the curve only.")
    return notes
