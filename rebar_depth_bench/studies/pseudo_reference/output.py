"""Page (also printed to the terminal) and CSV rows of the pseudo-reference study."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rebar_depth_bench.errors import printable
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.html.study_page import Columns, PageTable, StudyPage, page_table
from rebar_depth_bench.reporting.published import PublishedNumbers, load_published
from rebar_depth_bench.scoring.frames import make_frame
from rebar_depth_bench.scoring.metrics import METRIC_NAMES
from rebar_depth_bench.studies.pseudo_reference.result import (
    ALIGNMENTS,
    AgreementRow,
    Alignment,
    DepthReference,
    MethodRow,
    PseudoReferenceResult,
)

if TYPE_CHECKING:
    from pandas import DataFrame


def to_page(result: PseudoReferenceResult) -> StudyPage:
    """Return the page of the study."""
    camera = [] if result.camera is None else [("Camera", result.camera)]
    return StudyPage(
        study="pseudo-reference",
        title=(
            f"Full frame against {_describe_references(result)}, {printable(result.data)}: "
            "native (no alignment) and scaled (oracle median scale per view), "
            f"depths of {result.depth_range.describe()}"
        ),
        lead=_lead(result),
        stamps=[*result.provenance.lines(), ("Data", printable(result.data)), *camera],
        figures=(),
        tables=[
            *(_score_table(result, reference) for reference in result.references),
            _ranking_table(result),
            _reference_table(result),
            *([_agreement_table(result)] if result.agreements else []),
            *_published_tables(load_published()),
        ],
        notes=_notes(result),
    )


def to_pandas(result: PseudoReferenceResult) -> DataFrame:
    """Return the rows of the CSV as a frame: one per method and reference, with the provenance in columns."""
    return make_frame([_csv_row(result, row) for row in result.rows])


def _lead(result: PseudoReferenceResult) -> str:
    first = result.references[0].name
    compared = {row.reference for row in result.agreements} | {row.against for row in result.agreements}
    changes = [
        f"{reference.name}: AbsRel × {formatting.number(min(ratios), 2)} to {formatting.number(max(ratios), 2)}, "
        f"{reference.frame_share * 100:.1f} % of the frame, ranking {_ranking_change(result, reference.name)}"
        for reference in result.references[1:]
        if reference.name in compared
        and (
            ratios := [
                ratio for method in result.methods if (ratio := result.ratio(method, reference.name, "native"))
            ]
        )
    ]
    share = f"{result.references[0].frame_share * 100:.1f} % of the frame"
    return printable("; ".join([f"Relative to {first} ({share})", *changes]) + ".", limit=2000)


def _describe_references(result: PseudoReferenceResult) -> str:
    pseudo = sum(not reference.exact for reference in result.references)
    pseudo_text = formatting.counted(pseudo, "pseudo-reference")
    return f"{pseudo_text} and exact depth" if pseudo < len(result.references) else pseudo_text


def _ranking_change(result: PseudoReferenceResult, reference: str) -> str:
    tau = result.tau(reference, "native")
    ranked_sets = {frozenset(result.ranking(name, "native")) for name in (result.references[0].name, reference)}
    scope = "" if len(ranked_sets) == 1 else " among those ranked under both"
    return "undefined" if tau is None else f"unchanged{scope}" if tau == 1 else f"changed{scope} (tau {tau:.2f})"


def _score_table(result: PseudoReferenceResult, reference: DepthReference) -> PageTable:
    def ratio(row: MethodRow, alignment: Alignment) -> str:
        return formatting.number(result.ratio(row.method, row.reference, alignment), 2)

    kind = "exact depth" if reference.exact else "pseudo-reference"
    share = f"depth on {reference.frame_share * 100:.1f} % of the frame"
    columns: Columns[MethodRow] = (
        ("method", "", lambda row: printable(row.method)),
        ("covers", "% of its pixels", lambda row: formatting.coverage_percent(row.table.coverage)),
        ("scored", "% of frame", lambda row: formatting.percent(row.frame_share)),
        ("AbsRel ↓", "", lambda row: formatting.metric_cell(row.table.native, "abs_rel")),
        ("its interval", "95 %", lambda row: formatting.interval_text(row.table.intervals["native.abs_rel"], 4)),
        ("RMSE ↓", "cm", lambda row: formatting.metric_cell(row.table.native, "rmse_cm")),
        ("MAE ↓", "cm", lambda row: formatting.metric_cell(row.table.native, "mae_cm")),
        ("δ1 ↑", "", lambda row: formatting.metric_cell(row.table.native, "delta1")),
        ("AbsRel_s ↓", "scaled", lambda row: formatting.metric_cell(row.table.scaled, "abs_rel")),
        ("RMSE_s ↓", "cm, scaled", lambda row: formatting.metric_cell(row.table.scaled, "rmse_cm")),
        ("s", "", lambda row: formatting.scale_cell(row.table.scale_median)),
        ("ratio", "of AbsRel", lambda row: ratio(row, "native")),
        ("ratio_s", "of AbsRel_s", lambda row: ratio(row, "scaled")),
        ("ranked", "", lambda row: "yes" if row.table.is_comparable else "no"),
    )
    caption = f"Against {printable(reference.name)} ({kind}; {share})"
    return page_table(caption, columns, [row for row in result.rows if row.reference == reference.name])


def _ranking_table(result: PseudoReferenceResult) -> PageTable:
    def order(reference: str, alignment: Alignment) -> str:
        return printable(" < ".join(result.ranking(reference, alignment)), 500) or formatting.DASH

    def tau(reference: str, alignment: Alignment) -> str:
        return formatting.number(result.tau(reference, alignment), 2)

    columns: Columns[str] = (
        ("reference", "", printable),
        ("by AbsRel", "best first", lambda reference: order(reference, "native")),
        ("tau", "", lambda reference: tau(reference, "native")),
        ("by AbsRel_s", "best first", lambda reference: order(reference, "scaled")),
        ("tau", "", lambda reference: tau(reference, "scaled")),
    )
    caption = f"Ranking, with Kendall's tau relative to the ranking under {printable(result.references[0].name)}"
    return page_table(caption, columns, [reference.name for reference in result.references])


def _reference_table(result: PseudoReferenceResult) -> PageTable:
    columns: Columns[DepthReference] = (
        ("reference", "", lambda row: printable(row.name)),
        ("coverage", "% of frame", lambda row: formatting.percent(row.frame_share)),
        ("views", "with depth / all", lambda row: f"{row.views_with}/{row.views}"),
    )
    return page_table(
        "Coverage of the references: depth in range, mean over all views", columns, result.references
    )


def _agreement_table(result: PseudoReferenceResult) -> PageTable:
    columns: Columns[AgreementRow] = (
        ("a against b", "", lambda row: f"{printable(row.reference)} against {printable(row.against)}"),
        ("common", "% of frame", lambda row: formatting.percent(row.common_share)),
        ("AbsRel", "|a-b|/b", lambda row: formatting.number(row.abs_rel, 4)),
        ("ratio", "median a/b", lambda row: formatting.number(row.median_ratio, 4)),
        ("views", "", lambda row: str(row.views)),
    )
    return page_table("Differences between the references where both have depth", columns, result.agreements)


def _published_tables(published: PublishedNumbers) -> list[PageTable]:
    part = published.parts["physical"]
    heads = (("method", ""), ("RMSE ↓", "cm"), ("AbsRel ↓", ""), ("AbsRel_s ↓", "scaled"), ("s", ""))
    return [
        PageTable(
            f"Published, {part.place}, against {name} ({reference.coverage_percent} % of the frame): {part.mark}",
            heads,
            [[row.method, *row.cells] for row in reference.rows],
        )
        for name, reference in published.references.items()
    ]


def _notes(result: PseudoReferenceResult) -> list[str]:
    first = printable(result.references[0].name)
    notes = [
        "z: the reference, p: the prediction. Pixels of the whole frame are scored if both are finite, > 0 and "
        f"within {result.depth_range.describe()}. Means over views; s: median over views of median(z)/median(p).",
        f"Ratio: AbsRel here over AbsRel against {first}. Intervals: block bootstrap over views, over "
        "scenes in configs with splits.",
        "A prediction that is missing or out of range lowers the coverage but does not change the errors. A "
        "method that covers less than 95 % of a reference's pixels, or none in a view, is shown but not ranked.",
    ]
    if any(reference.exact for reference in result.references):
        notes.append(
            "Exact depth where a pseudo-reference has depth separates two effects: compared with the pseudo-"
            "reference, only the depth differs; compared with the exact depth, only the pixels differ."
        )
    else:
        notes.append("No exact depth is available: the references are estimates, and so is every number above.")
    for row in result.rows:
        reasons = formatting.incomparable_reasons(row.table)
        if reasons:
            names = f"{printable(row.method)} against {printable(row.reference)}"
            notes.append(f"{names}: not ranked: {'; '.join(reasons)}.")
    return notes


def _csv_row(result: PseudoReferenceResult, row: MethodRow) -> dict[str, Any]:
    table, provenance = row.table, result.provenance.to_dict()
    metrics = {
        f"{alignment}_{name}": value
        for alignment, table_metrics in (("native", table.native), ("scaled", table.scaled))
        for name, value in (vars(table_metrics) if table_metrics else dict.fromkeys(METRIC_NAMES)).items()
    }
    return {
        "protocol": provenance["protocol"],
        "data": result.data,
        "near_m": result.depth_range.near_m,
        "far_m": result.depth_range.far_m,
        "method": row.method,
        "reference": row.reference,
        "views": table.views,
        "views_scored": table.views_scored,
        "coverage": table.coverage,
        "frame_share": row.frame_share,
        "ranked": table.is_comparable,
        **metrics,
        "scale_median": table.scale_median,
        **{f"{alignment}_ratio": result.ratio(row.method, row.reference, alignment) for alignment in ALIGNMENTS},
        "dataset_digest": result.provenance.dataset_digest,
        "software_version": provenance["software"]["version"],
    }
