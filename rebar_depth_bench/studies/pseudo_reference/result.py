"""What the study of two pseudo-references says, as numbers: rows, ratios, rankings, the references themselves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import combinations
from typing import Any, Literal

from rebar_depth_bench.scoring.metrics import DepthMetrics
from rebar_depth_bench.scoring.provenance import Stamp
from rebar_depth_bench.scoring.result import Table
from rebar_depth_bench.studies.pseudo_reference.study import DepthRange

Alignment = Literal["native", "scaled"]
ALIGNMENTS: tuple[Alignment, ...] = ("native", "scaled")


@dataclass(frozen=True)
class Reference:
    """What predictions were scored against: a pseudo-reference, or exact depth (on one's pixels).

    ``frame_share`` is the share of the frame where it has depth, mean over all ``views``; ``views_with`` are the
    views where it has any.
    """

    name: str
    exact: bool
    views: int
    views_with: int
    frame_share: float


@dataclass(frozen=True)
class Row:
    """A method against a reference. ``table.coverage`` is the share of the reference's pixels with a prediction.

    ``frame_share`` is the share of the frame that is scored, mean over all views.
    """

    method: str
    reference: str
    table: Table
    frame_share: float


@dataclass(frozen=True)
class AgreementRow:
    """A reference against another where both have depth: means over views, the median of the views' ratios."""

    reference: str
    against: str
    views: int
    common_share: float
    abs_rel: float | None
    median_ratio: float | None


@dataclass(frozen=True)
class PseudoReferenceResult:
    """The study's numbers. ``references[0]`` is what the others' ratios and rankings are held against."""

    stamp: Stamp
    data: str
    camera: str | None
    allowed: DepthRange
    references: Sequence[Reference]
    rows: Sequence[Row]
    agreements: Sequence[AgreementRow]

    def row(self, method: str, reference: str) -> Row:
        """Return a method's row against a reference."""
        return next(row for row in self.rows if (row.method, row.reference) == (method, reference))

    @property
    def methods(self) -> tuple[str, ...]:
        """The methods in the order they were named."""
        return tuple(dict.fromkeys(row.method for row in self.rows))

    def ratio(self, method: str, reference: str, alignment: Alignment) -> float | None:
        """Return AbsRel against ``reference`` over AbsRel against the first reference, None where undefined."""
        values = [
            abs_rel(self.row(method, name).table, alignment) for name in (self.references[0].name, reference)
        ]
        return values[1] / values[0] if values[0] and values[1] is not None else None

    def ranking(self, reference: str, alignment: Alignment) -> tuple[str, ...]:
        """Return the ranked methods, smallest AbsRel first; who may not be ranked is not in it."""
        ranked = [row for row in self.rows if row.reference == reference and row.table.ranked]
        return tuple(row.method for row in sorted(ranked, key=lambda row: abs_rel(row.table, alignment) or 0.0))

    def tau(self, reference: str, alignment: Alignment) -> float | None:
        """Return Kendall's tau between the ranking under a reference and that under the first one."""
        return kendall_tau(self.ranking(self.references[0].name, alignment), self.ranking(reference, alignment))

    def to_dict(self) -> dict[str, Any]:
        """Return the study's JSON object; who writes it rounds its numbers."""
        return {
            **self.stamp.to_dict(),
            "data": self.data,
            "camera": self.camera,
            "range_m": [self.allowed.near_m, self.allowed.far_m],
            "references": [dict(vars(one)) for one in self.references],
            "rows": [self._row_dict(row) for row in self.rows],
            "rankings": {one.name: self._ranking_dict(one.name) for one in self.references},
            "agreement": [dict(vars(one)) for one in self.agreements],
        }

    def _row_dict(self, row: Row) -> dict[str, Any]:
        ratios = {way: self.ratio(row.method, row.reference, way) for way in ALIGNMENTS}
        names = {"method": row.method, "reference": row.reference}
        return {**names, "frame_share": row.frame_share, "ratio": ratios, **_table_dict(row.table)}

    def _ranking_dict(self, reference: str) -> dict[str, Any]:
        return {
            way: {"order": list(self.ranking(reference, way)), "tau": self.tau(reference, way)}
            for way in ALIGNMENTS
        }


def abs_rel(table: Table, alignment: Alignment) -> float | None:
    """Return a table's native or scaled AbsRel."""
    metrics: DepthMetrics | None = table.native if alignment == "native" else table.scaled
    return None if metrics is None else metrics.abs_rel


def kendall_tau(first: Sequence[str], other: Sequence[str]) -> float | None:
    """Return Kendall's tau of two rankings on the names that both hold: (agreeing - other pairs) / pairs, -1 to 1.

    None with fewer than two common names. Kendall, "A new measure of rank correlation", Biometrika 1938.
    """
    common = [name for name in first if name in other]
    place = {name: other.index(name) for name in common}
    signs = [1 if place[a] < place[b] else -1 for a, b in combinations(common, 2)]
    return sum(signs) / len(signs) if signs else None


def _table_dict(table: Table) -> dict[str, Any]:
    """Return a table's numbers under the contract's names; ``ci95`` as ``native.abs_rel``: [a, b]."""
    return {
        "views": table.views,
        "views_scored": table.views_scored,
        "coverage": table.coverage,
        "ranked": table.ranked,
        "native": _metrics_dict(table.native),
        "scaled": _metrics_dict(table.scaled),
        "scale_median": table.scale_median,
        "ci95": {name: ends for name, ends in table.intervals.items() if not name.startswith("within_mm")},
    }


def _metrics_dict(metrics: DepthMetrics | None) -> dict[str, float | None]:
    return {field.name: getattr(metrics, field.name, None) for field in fields(DepthMetrics)}
