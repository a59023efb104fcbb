"""Result of the pseudo-reference study: scores per reference, ratios, rankings and agreement of the references."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import combinations
from typing import Any, Literal

from rebar_depth_bench.scoring.bootstrap import INTERVALS
from rebar_depth_bench.scoring.metrics import DepthMetrics
from rebar_depth_bench.scoring.provenance import Provenance
from rebar_depth_bench.scoring.result import Table
from rebar_depth_bench.studies.pseudo_reference.study import DepthRange

Alignment = Literal["native", "scaled"]
ALIGNMENTS: tuple[Alignment, ...] = ("native", "scaled")


@dataclass(frozen=True)
class DepthReference:
    """Reference depth: a pseudo-reference, or exact depth (possibly restricted to a pseudo-reference's pixels).

    ``frame_share`` is the fraction of the frame with depth, mean over all ``views``; ``views_with`` counts the
    views with any depth.
    """

    name: str
    exact: bool
    views: int
    views_with: int
    frame_share: float


@dataclass(frozen=True)
class MethodRow:
    """Scores of a method against a reference.

    ``table.coverage`` is the fraction of the reference's pixels with a prediction; ``frame_share`` is the fraction
    of the frame that is scored, mean over all views.
    """

    method: str
    reference: str
    table: Table
    frame_share: float


@dataclass(frozen=True)
class AgreementRow:
    """Agreement of a reference with another one on the pixels where both have depth.

    ``views`` counts the views with common pixels. ``common_share`` (fraction of the frame with depth in both) and
    ``abs_rel`` are means over views; ``median_ratio`` is the median over views of their median ratios.
    """

    reference: str
    against: str
    views: int
    common_share: float
    abs_rel: float | None
    median_ratio: float | None


@dataclass(frozen=True)
class PseudoReferenceResult:
    """Result of the pseudo-reference study.

    Ratios and rankings under the other references are relative to ``references[0]``. ``depth_range`` is the
    evaluation range; ``camera`` describes the camera of a capture and is None for a dataset folder.
    """

    provenance: Provenance
    data: str
    camera: str | None
    depth_range: DepthRange
    references: Sequence[DepthReference]
    rows: Sequence[MethodRow]
    agreements: Sequence[AgreementRow]

    def row(self, method: str, reference: str) -> MethodRow:
        """Return the row of a method against a reference."""
        return next(row for row in self.rows if (row.method, row.reference) == (method, reference))

    @property
    def methods(self) -> tuple[str, ...]:
        """Return the methods in the order in which they were given."""
        return tuple(dict.fromkeys(row.method for row in self.rows))

    def ratio(self, method: str, reference: str, alignment: Alignment) -> float | None:
        """Return AbsRel against ``reference`` divided by AbsRel against the first reference, None if undefined."""
        values = [
            table_abs_rel(self.row(method, name).table, alignment) for name in (self.references[0].name, reference)
        ]
        return values[1] / values[0] if values[0] and values[1] is not None else None

    def ranking(self, reference: str, alignment: Alignment) -> tuple[str, ...]:
        """Return the ranked methods by ascending AbsRel; methods that may not be ranked are left out."""
        ranked = [row for row in self.rows if row.reference == reference and row.table.is_comparable]
        return tuple(
            row.method for row in sorted(ranked, key=lambda row: table_abs_rel(row.table, alignment) or 0.0)
        )

    def tau(self, reference: str, alignment: Alignment) -> float | None:
        """Return Kendall's tau between the rankings under the first reference and under ``reference``."""
        return kendall_tau(self.ranking(self.references[0].name, alignment), self.ranking(reference, alignment))

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object of the study; its numbers are not yet rounded."""
        return {
            **self.provenance.to_dict(),
            "intervals": dict(INTERVALS),
            "data": self.data,
            "camera": self.camera,
            "range_m": [self.depth_range.near_m, self.depth_range.far_m],
            "references": [dict(vars(reference)) for reference in self.references],
            "rows": [self._row_dict(row) for row in self.rows],
            "rankings": {reference.name: self._ranking_dict(reference.name) for reference in self.references},
            "agreement": [dict(vars(row)) for row in self.agreements],
        }

    def _row_dict(self, row: MethodRow) -> dict[str, Any]:
        ratios = {alignment: self.ratio(row.method, row.reference, alignment) for alignment in ALIGNMENTS}
        names = {"method": row.method, "reference": row.reference}
        return {**names, "frame_share": row.frame_share, "ratio": ratios, **_table_dict(row.table)}

    def _ranking_dict(self, reference: str) -> dict[str, Any]:
        return {
            alignment: {
                "order": list(self.ranking(reference, alignment)),
                "tau": self.tau(reference, alignment),
            }
            for alignment in ALIGNMENTS
        }


def table_abs_rel(table: Table, alignment: Alignment) -> float | None:
    """Return the native or scaled AbsRel of a table, None if undefined."""
    metrics: DepthMetrics | None = table.native if alignment == "native" else table.scaled
    return None if metrics is None else metrics.abs_rel


def kendall_tau(first: Sequence[str], other: Sequence[str]) -> float | None:
    """Return Kendall's tau of two rankings on their common names, from -1 to 1.

    Tau is (concordant - discordant pairs) / pairs; it is None with fewer than two common names. Kendall, "A new
    measure of rank correlation", Biometrika 1938.
    """
    common = [name for name in first if name in other]
    rank = {name: other.index(name) for name in common}
    signs = [1 if rank[a] < rank[b] else -1 for a, b in combinations(common, 2)]
    return sum(signs) / len(signs) if signs else None


def _table_dict(table: Table) -> dict[str, Any]:
    """Return the numbers of a table under the same names as in the result JSON of ``score``.

    ``ci95`` maps names such as ``native.abs_rel`` to [low, high].
    """
    return {
        "views": table.views,
        "views_scored": table.views_scored,
        "coverage": table.coverage,
        "ranked": table.is_comparable,
        "native": _metrics_dict(table.native),
        "scaled": _metrics_dict(table.scaled),
        "scale_median": table.scale_median,
        "ci95": {name: interval for name, interval in table.intervals.items() if not name.startswith("within_mm")},
    }


def _metrics_dict(metrics: DepthMetrics | None) -> dict[str, float | None]:
    return {field.name: getattr(metrics, field.name, None) for field in fields(DepthMetrics)}
