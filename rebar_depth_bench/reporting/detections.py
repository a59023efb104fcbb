"""Page and terminal tables of a detector of crossings: numbers with intervals, and precision over recall.

The page is self-contained HTML, without scripts or requests, and the same bytes for the same input. All text
passes through Jinja's escaping, and names of a submission or a dataset through ``errors.printable`` before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup
from rich.console import Console

from rebar_depth_bench import software_version
from rebar_depth_bench.base.errors import printable
from rebar_depth_bench.detections.matching import CHANCE_DRAWS, DETECTIONS_PROTOCOL, HEADLINE_MM, LIMITS_MM, NEAR_M
from rebar_depth_bench.detections.tables import DetectionResult, DetectionTable
from rebar_depth_bench.reporting.charts import precision_chart
from rebar_depth_bench.reporting.html.assets import environment
from rebar_depth_bench.reporting.tables import make_grid, plain_text, print_line, print_unwrapped
from rebar_depth_bench.scoring import formatting
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
    Column(f"average_precision_{limit}mm", f"AP at {limit} mm", "%", "higher", 1, 100.0) for limit in LIMITS_MM
)
_BIAS = (
    Column("right_bias_mm", "Bias, right", "mm", "", 2),
    Column("down_bias_mm", "Bias, down", "mm", "", 2),
    Column("along_bias_mm", "Bias, along", "mm", "", 2),
    Column("spread_mm", "Spread", "mm", "lower", 2),
)
_ERRORS = (
    Column("position_mm", "Position", "mm, median", "lower", 2),
    Column("position_p95_mm", "Position", "mm, p95", "lower", 2),
    Column("normal_deg", "Normal", "degrees, median", "lower", 2),
    Column("normal_p95_deg", "Normal", "degrees, p95", "lower", 2),
)


_COUNTS = (
    ("Crossings", "judged"),
    ("Nodes", "judged"),
    ("Detections", ""),
    ("Matched", ""),
    ("False", ""),
    ("Ignored", ""),
    ("Near", "for bias"),
)
"""Headings of the numbers of crossings and detections, whose keys are the names in lower case."""


@dataclass(frozen=True)
class PageTable:
    """Table of the page: headings (name, unit), and rows with as many cells, the first of which is its name."""

    caption: str
    heads: Sequence[tuple[str, str]]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class DetectionPage:
    """Contents of the page; ``stamps`` are (name, value), ``figures`` are (SVG, title, caption)."""

    title: str
    lead: str
    stamps: Sequence[tuple[str, str]]
    figures: Sequence[tuple[Markup, str, str]]
    tables: Sequence[PageTable]
    notes: Sequence[str]


def render_page(page: DetectionPage) -> str:
    """Return the page as HTML; it follows the reader's light or dark mode and needs no network."""
    return environment().get_template("detections.html.j2").render(page=page)


def print_page(page: DetectionPage, console: Console) -> None:
    """Print title, stamps, tables and notes.

    Numbers are never truncated: on a narrow console, lines become longer than the console.
    """
    print_line(console, page.title, style="bold")
    print_line(console, "; ".join(f"{label}: {value}" for label, value in page.stamps), style="dim")
    for table in page.tables:
        console.print()
        print_line(console, table.caption, style="italic")
        first, *others = (plain_text(f"{name}\n{unit}") for name, unit in table.heads)
        grid = make_grid(first, others)
        for row in table.rows:
            grid.add_row(*map(plain_text, row))
        print_unwrapped(console, grid)
    console.print()
    for note in page.notes:
        print_line(console, note)


def detection_page(result: DetectionResult) -> DetectionPage:
    """Return the page of a result, with the tables of the terminal."""
    rows: list[Row] = list(result.tables.items())
    if len(rows) > 1:
        rows.append(("all", result.pooled))
    threshold = result.least_confidence
    matched = "all detections" if threshold is None else f"detections with a confidence of {threshold:g} or more"
    method = printable(result.meta.method)
    return DetectionPage(
        title=f"{method}: detected crossings of bars",
        lead="Crossings that the left image shows well enough are to be found. "
        f"Correct within {HEADLINE_MM} mm of the tie point: {matched}. Chance: as many random points on steel.",
        stamps=_stamps(result),
        figures=[_curve_figure(name, table) for name, table in rows if table.counts["crossings"]],
        tables=(
            _number_table("Precision and recall, pooled over views.", _SHARES, rows),
            _number_table("Average precision over all confidences.", _AVERAGES, rows),
            _number_table(
                "Errors of correct detections: tie point, and normal where one is given.", _ERRORS, rows
            ),
            _number_table(
                f"Bias (mean) along the camera's axes and spread about it (root mean square) of detections within "
                f"{1000 * NEAR_M:g} mm, or half the distance to the next crossing, of a judged crossing.",
                _BIAS,
                rows,
            ),
            _count_table(rows),
        ),
        notes=_notes(result),
    )


def _stamps(result: DetectionResult) -> list[tuple[str, str]]:
    declared = result.meta.declaration
    return [
        ("Protocol", DETECTIONS_PROTOCOL),
        ("Inputs", formatting.inputs_text(declared)),
        ("Ground truth", formatting.ground_truth_text(declared)),
        ("Dataset", f"{printable(result.dataset_version)} ({printable(result.dataset_digest)})"),
        ("Crossings", f"{printable(result.source.file)} {printable(result.source.sha256)}"),
        ("File", printable(result.sha256)),
        ("Software", f"rebar-depth-bench {printable(software_version())}"),
    ]


def _number_table(caption: str, columns: Sequence[Column], rows: list[Row]) -> PageTable:
    """Return the table of some numbers, each beside its interval and the number of random points."""
    heads = [("Config", "")]
    for column in columns:
        title = f"{column.title} {ARROWS[column.better]}"
        heads += [(title, column.unit), ("95 % interval", ""), ("chance", "")]
    cells = [
        [printable(name), *(text for column in columns for text in _texts(column, table))] for name, table in rows
    ]
    return PageTable(caption, heads, cells)


def _texts(column: Column, table: DetectionTable) -> tuple[str, str, str]:
    """Return the number of a table, its interval and the number of random points as text."""
    ends = column.interval_text(table.intervals[column.place], " to ")
    return column.text(table.numbers[column.place]), ends or DASH, column.text(table.chance[column.place])


def _count_table(rows: list[Row]) -> PageTable:
    cells = [
        [printable(name), str(table.views), *(str(table.counts[count.lower()]) for count, _ in _COUNTS)]
        for name, table in rows
    ]
    return PageTable("Numbers over all views.", [("Config", ""), ("Views", ""), *_COUNTS], cells)


def _curve_figure(name: str, table: DetectionTable) -> tuple[Markup, str, str]:
    curves = {
        f"{limit} mm": [(0.0, curve[0][1]), *curve] if curve else [] for limit, curve in table.curves.items()
    }
    average = "; ".join(
        f"average precision at {limit} mm: {_texts(column, table)[0]} %"
        for limit, column in zip(LIMITS_MM, _AVERAGES, strict=True)
    )
    svg = precision_chart(f"Precision over recall, {name}", average, curves)
    caption = f"By the distance within which a detection is correct; {average}."
    return svg, f"{printable(name)}: precision over recall.", caption


def _notes(result: DetectionResult) -> list[str]:
    notes = [
        "A crossing is judged by the ground truth of the left eye alone: its tie point's pixel shows one of the "
        "bars, near the tie point, and each bar has 30 single-bar interior pixels or more within 6 diameters, on "
        "both sides.",
        "A detection belongs to the nearest crossing within the limit. Of the detections of a crossing, the most "
        "confident one is correct, or ignored if the crossing is not judged. A detection that projects onto a bar "
        "whose axis is not known is ignored, too. All others are false.",
        f"Chance: mean over {CHANCE_DRAWS} draws of as many random scored pixels of each view as detections that "
        "count, on the true surface.",
        f"Intervals: bootstrap over blocks of neighbouring views, or over scenes. {DASH}: undefined or unknown.",
    ]
    counts = result.pooled.counts
    if not counts["crossings"]:
        notes.append("No crossing is judged: bars that are thin in the image have less than 30 pixels each.")
    elif counts["detections"] and not counts["near"]:
        notes.append(
            f"No detection is within {1000 * NEAR_M:g} mm of a judged crossing: points are in metres, x to the "
            "right, y down, z forward of the left camera."
        )
    if not result.has_confidence:
        notes.append("The file has no confidences, so that average precision has one point of the curve only.")
    return notes
