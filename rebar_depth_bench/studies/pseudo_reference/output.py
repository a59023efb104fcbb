"""The study of pseudo-references in words and cells: its page, which the terminal prints too, and its CSV rows."""

from __future__ import annotations

from typing import Any

from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.html.study_page import PageTable, StudyPage
from rebar_depth_bench.reporting.published import Published, load_published
from rebar_depth_bench.studies.pseudo_reference.result import (
    ALIGNMENTS,
    AgreementRow,
    PseudoReferenceResult,
    Reference,
    Row,
)

_SCORE_HEADS = (
    ("method", ""),
    ("covers", "% of its pixels"),
    ("scored", "% of frame"),
    ("AbsRel ↓", ""),
    ("its interval", "95 %"),
    ("RMSE ↓", "cm"),
    ("MAE ↓", "cm"),
    ("δ1 ↑", ""),
    ("AbsRel_s ↓", "scaled"),
    ("RMSE_s ↓", "cm, scaled"),
    ("s", ""),
    ("ratio", "of AbsRel"),
    ("ratio_s", "of AbsRel_s"),
    ("ranked", ""),
)


def study_page(result: PseudoReferenceResult) -> StudyPage:
    """Return the study's page."""
    camera = [] if result.camera is None else [("Camera", result.camera)]
    return StudyPage(
        study="pseudo-reference",
        title=(
            f"Full frame against {_reference_words(result)}, {formatting.printable(result.data)}: "
            "native (no alignment) beside scaled (oracle median scale per view), "
            f"depths of {result.allowed.words()}"
        ),
        lead=_lead(result),
        stamps=[*result.stamp.lines(), ("Data", formatting.printable(result.data)), *camera],
        figures=(),
        tables=[
            *(_score_table(result, one) for one in result.references),
            _ranking_table(result),
            _reference_table(result),
            *([_agreement_table(result)] if result.agreements else []),
            *_published_tables(load_published()),
        ],
        notes=_notes(result),
    )


def csv_rows(result: PseudoReferenceResult) -> list[dict[str, Any]]:
    """Return a line per method and reference, with the study's stamps."""
    return [_csv_row(result, row) for row in result.rows]


def _lead(result: PseudoReferenceResult) -> str:
    first = result.references[0].name
    whole = {one.reference for one in result.agreements} | {one.against for one in result.agreements}
    changes = [
        f"{one.name}: AbsRel × {formatting.number(min(ratios), 2)} to {formatting.number(max(ratios), 2)}, "
        f"{one.frame_share * 100:.1f} % of the frame, ranking {_same(result, one.name)}"
        for one in result.references[1:]
        if one.name in whole
        and (ratios := [ratio for method in result.methods if (ratio := result.ratio(method, one.name, "native"))])
    ]
    share = f"{result.references[0].frame_share * 100:.1f} % of the frame"
    return formatting.printable("; ".join([f"Held against {first} ({share})", *changes]) + ".", limit=2000)


def _reference_words(result: PseudoReferenceResult) -> str:
    pseudo = sum(not one.exact for one in result.references)
    words = f"{pseudo} pseudo-reference{'' if pseudo == 1 else 's'}"
    return f"{words} and exact depth" if pseudo < len(result.references) else words


def _same(result: PseudoReferenceResult, reference: str) -> str:
    tau = result.tau(reference, "native")
    both = {frozenset(result.ranking(name, "native")) for name in (result.references[0].name, reference)}
    who = "" if len(both) == 1 else " among those ranked under both"
    return "undefined" if tau is None else f"unchanged{who}" if tau == 1 else f"changed{who} (tau {tau:.2f})"


def _score_table(result: PseudoReferenceResult, reference: Reference) -> PageTable:
    rows = [row for row in result.rows if row.reference == reference.name]
    kind = "exact depth" if reference.exact else "pseudo-reference"
    share = f"depth on {reference.frame_share * 100:.1f} % of the frame"
    caption = f"Against {formatting.printable(reference.name)} ({kind}; {share})"
    return PageTable(caption, _SCORE_HEADS, [_score_cells(result, row) for row in rows])


def _score_cells(result: PseudoReferenceResult, row: Row) -> list[str]:
    table = row.table
    native, scaled = formatting.metric_cells(table.native), formatting.metric_cells(table.scaled)
    ends = table.intervals.get("native.abs_rel")
    return [
        formatting.printable(row.method),
        formatting.coverage_percent(table.coverage),
        formatting.percent(row.frame_share),
        native[0],
        formatting.DASH if ends is None else " to ".join(formatting.number(end, 4) for end in ends),
        *native[1:],
        scaled[0],
        scaled[1],
        formatting.scale_cell(table.scale_median),
        *(formatting.number(result.ratio(row.method, row.reference, way), 2) for way in ALIGNMENTS),
        "yes" if table.ranked else "no",
    ]


def _ranking_table(result: PseudoReferenceResult) -> PageTable:
    def cells(reference: str) -> list[str]:
        orders = [
            formatting.printable(" < ".join(result.ranking(reference, way)), 500) or formatting.DASH
            for way in ALIGNMENTS
        ]
        taus = [formatting.number(result.tau(reference, way), 2) for way in ALIGNMENTS]
        return [formatting.printable(reference), orders[0], taus[0], orders[1], taus[1]]

    heads = (
        ("reference", ""),
        ("by AbsRel", "best first"),
        ("tau", ""),
        ("by AbsRel_s", "best first"),
        ("tau", ""),
    )
    caption = f"Ranking; Kendall's tau against that under {formatting.printable(result.references[0].name)}"
    return PageTable(caption, heads, [cells(one.name) for one in result.references])


def _reference_table(result: PseudoReferenceResult) -> PageTable:
    heads = (("reference", ""), ("coverage", "% of frame"), ("views", "with depth / all"))
    rows = [
        [formatting.printable(one.name), formatting.percent(one.frame_share), f"{one.views_with}/{one.views}"]
        for one in result.references
    ]
    return PageTable("The references: depth in range, mean over all views", heads, rows)


def _agreement_table(result: PseudoReferenceResult) -> PageTable:
    def cells(one: AgreementRow) -> list[str]:
        return [
            f"{formatting.printable(one.reference)} against {formatting.printable(one.against)}",
            formatting.percent(one.common_share),
            formatting.number(one.abs_rel, 4),
            formatting.number(one.median_ratio, 4),
            str(one.views),
        ]

    heads = (
        ("a against b", ""),
        ("common", "% of frame"),
        ("AbsRel", "|a-b|/b"),
        ("ratio", "median a/b"),
        ("views", ""),
    )
    return PageTable(
        "How the references differ where both have depth", heads, [cells(one) for one in result.agreements]
    )


def _published_tables(published: Published) -> list[PageTable]:
    part = published.parts["physical"]
    heads = (("method", ""), ("RMSE ↓", "cm"), ("AbsRel ↓", ""), ("AbsRel_s ↓", "scaled"), ("s", ""))
    return [
        PageTable(
            f"Published, {part.place}, against {name} ({one.coverage_percent} % of the frame): {part.mark}",
            heads,
            [[row.method, row.rmse_cm, row.abs_rel, row.abs_rel_scaled, row.scale] for row in one.rows],
        )
        for name, one in published.references.items()
    ]


def _notes(result: PseudoReferenceResult) -> list[str]:
    first = formatting.printable(result.references[0].name)
    notes = [
        "z: the reference, p: the prediction. Scored are pixels of the whole frame where both are finite, > 0 and "
        f"within {result.allowed.words()}. Means over views; s: median over views of median(z)/median(p).",
        f"Ratio: AbsRel here over AbsRel against {first}. Intervals: block bootstrap over views.",
        "A prediction that is missing or out of range lowers the coverage and no error: a method that "
        "covers less than 95 % of a reference's pixels, or nothing in a view, is shown and not ranked.",
    ]
    if any(one.exact for one in result.references):
        notes.append(
            "Exact depth where a pseudo-reference has depth tells two effects apart: from there to the pseudo-"
            "reference only the depth changes, from there to the exact depth only the pixels."
        )
    else:
        notes.append("No exact depth is known here: the references are estimates, and so is every number above.")
    for row in result.rows:
        reasons = formatting.unranked_reasons(row.table)
        if reasons:
            names = f"{formatting.printable(row.method)} against {formatting.printable(row.reference)}"
            notes.append(f"{names}: not ranked: {'; '.join(reasons)}.")
    return notes


def _csv_row(result: PseudoReferenceResult, row: Row) -> dict[str, Any]:
    table, stamp = row.table, result.stamp.to_dict()
    metrics = {
        f"{way}_{name}": value
        for way, content in (("native", table.native), ("scaled", table.scaled))
        for name, value in (
            vars(content) if content else dict.fromkeys(("abs_rel", "rmse_cm", "mae_cm", "delta1"))
        ).items()
    }
    return {
        "protocol": stamp["protocol"],
        "data": result.data,
        "near_m": result.allowed.near_m,
        "far_m": result.allowed.far_m,
        "method": row.method,
        "reference": row.reference,
        "views": table.views,
        "views_scored": table.views_scored,
        "coverage": table.coverage,
        "frame_share": row.frame_share,
        "ranked": table.ranked,
        **metrics,
        "scale_median": table.scale_median,
        **{f"{way}_ratio": result.ratio(row.method, row.reference, way) for way in ALIGNMENTS},
        "dataset_digest": result.stamp.dataset_digest,
        "software_version": stamp["software"]["version"],
    }
