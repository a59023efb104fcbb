"""Results of scoring: tables by config, and the JSON of a result."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from statistics import median
from typing import TYPE_CHECKING, Any, Literal

from rebar_depth_bench.errors import printable
from rebar_depth_bench.scoring.bootstrap import INTERVALS, Interval
from rebar_depth_bench.scoring.frames import groups_frame, tables_frame, views_frame
from rebar_depth_bench.scoring.metrics import METRIC_NAMES, DepthMetrics, mean, mean_metrics
from rebar_depth_bench.scoring.protocol import MIN_COMPARABLE_COVERAGE, PROTOCOL, WITHIN_MM
from rebar_depth_bench.scoring.published_match import PublishedMatch
from rebar_depth_bench.scoring.reference import NO_REFERENCE, Reference
from rebar_depth_bench.scoring.rounding import rounded, rounded_interval
from rebar_depth_bench.scoring.view_score import VIEW_METRICS, ViewScore, view_intervals
from rebar_depth_bench.submission.declaration import NOT_DECLARED, Declaration

if TYPE_CHECKING:
    from pandas import DataFrame

    from rebar_depth_bench.extended.result import ExtendedResult

_MAX_CONFIGS_SHOWN = 10
_NOTEBOOK_COLUMNS = (
    *("config", "views", "views_scored", "coverage", "ranked", "rank_error"),
    *("native_abs_rel", "native_rmse_cm", "scaled_abs_rel", "scaled_rmse_cm", "scale_median"),
)


@dataclass(frozen=True)
class Table:
    """Metrics of one config: means over its views, and the median of their scale factors.

    ``rank_error`` is None without views; ``reference`` are the config's reference errors,
    and ``published`` is the scene of the paper's Table I that it shows, if any. ``scaled_constant`` has AbsRel and
    RMSE (cm) of a constant after scaling on the predicted pixels, to compare with ``scaled``. ``split`` is None
    for a config of one scene. ``truth_sigma_m`` is the standard deviation of the ground truth's depth, None where
    it is exact. ``intervals`` has the 95 % bootstrap interval of each of ``VIEW_METRICS``, None where undefined.
    ``groups`` has the tables of groups of views by grouping (see ``groups.GROUPINGS``) and group, of a config with
    splits; they have no groups.
    """

    views: int
    views_scored: int
    coverage: float | None
    ranked: bool
    rank_error: float | None
    native: DepthMetrics | None
    scaled: DepthMetrics | None
    scale_median: float | None
    within_mm: Mapping[int, float | None]
    reference: Reference = NO_REFERENCE
    scaled_constant: tuple[float | None, float | None] = (None, None)
    published: PublishedMatch | None = None
    split: str | None = None
    truth_sigma_m: float | None = None
    intervals: Mapping[str, Interval | None] = field(default_factory=dict)
    groups: Mapping[str, Mapping[str, Table]] = field(default_factory=dict)

    @property
    def is_comparable(self) -> bool:
        """Whether the errors of valid predictions can be compared with those of other submissions.

        Every view needs a prediction, the coverage must be at least ``MIN_COMPARABLE_COVERAGE``, and no metric may
        be infinite. Otherwise, missing or enormous predictions could improve the comparison.
        """
        is_complete = 0 < self.views == self.views_scored
        is_finite = all(metrics is not None and metrics.is_finite for metrics in (self.native, self.scaled))
        return is_complete and is_finite and (self.coverage or 0.0) >= MIN_COMPARABLE_COVERAGE


@dataclass(frozen=True, repr=False)
class Result:
    """Result of scoring one submission, with the digests and versions of its inputs.

    ``intervals`` states how the intervals were computed; None in a file of an earlier version, which does not.
    """

    method: str
    submission_sha256: str
    dataset_digest: str
    dataset_version: str
    software_version: str
    tables: Mapping[str, Table]
    views: Sequence[ViewScore]
    extended: ExtendedResult | None = None
    declared: Declaration = NOT_DECLARED
    protocol: str = PROTOCOL
    intervals: Mapping[str, Any] | None = field(default_factory=lambda: dict(INTERVALS))

    def to_dict(self) -> dict[str, Any]:
        """Return the result as a JSON-compatible object; extended measures, if computed, are its last entry."""
        extended = {} if self.extended is None else {"extended": self.extended.to_dict()}
        return {
            "protocol": self.protocol,
            "dataset": {"digest": self.dataset_digest, "version": self.dataset_version},
            "submission": {
                "method": self.method,
                "sha256": self.submission_sha256,
                **self.declared.to_dict(),
            },
            "software": {"version": self.software_version},
            **({} if self.intervals is None else {"intervals": dict(self.intervals)}),
            "tables": {name: _table_dict(table) for name, table in self.tables.items()},
            "views": [_view_dict(view) for view in self.views],
            **extended,
        }

    def to_pandas(self, rows: Literal["tables", "groups", "views", "extended"] = "tables") -> DataFrame:
        """Return the numbers of the JSON as a frame.

        ``"tables"`` has one row per config, with the 95 % interval of each metric in the columns
        ``<metric>_low`` and ``<metric>_high``; ``"groups"`` has one row per group of views of each config with
        splits, with the same columns; ``"views"`` has one row per view; ``"extended"`` has one row per config,
        alignment and extended measure. Raises ``ValueError`` for other rows, and for ``"extended"`` if the result
        has no extended measures.
        """
        if rows == "tables":
            return tables_frame([self.to_dict()])
        if rows == "groups":
            return groups_frame([self.to_dict()])
        if rows == "views":
            return views_frame(self.to_dict())
        if rows == "extended" and self.extended is not None:
            return self.extended.to_pandas()
        expected = "'tables', 'groups', 'views', or 'extended' for a result that has them"
        raise ValueError(f"rows is {rows!r}, expected {expected}")

    def __repr__(self) -> str:
        """Return the method, the numbers of the first ten configs, and the number of views."""
        shown = [f"  {printable(name)}: {_describe_table(table)}" for name, table in self.tables.items()]
        omitted = [f"  ... and {len(shown) - _MAX_CONFIGS_SHOWN} more"] if len(shown) > _MAX_CONFIGS_SHOWN else []
        head = f"<Result of {printable(self.method)}: {len(shown)} configs, {len(self.views)} views"
        return "\n".join([head, *shown[:_MAX_CONFIGS_SHOWN], *omitted]) + ">"

    def _repr_html_(self) -> str:
        """Return the method, its provenance and the tables for notebooks."""
        frame = self.to_pandas()[[*_NOTEBOOK_COLUMNS]]
        frame["config"] = frame["config"].map(printable)
        provenance = f"protocol {self.protocol}, dataset {self.dataset_version} ({self.dataset_digest[:19]})"
        head = f"<p><b>{escape(printable(self.method))}</b>, {escape(printable(provenance))}</p>"
        return head + str(frame.to_html(index=False, na_rep="–", float_format="{:.4g}".format, border=0))

    def to_json(self) -> bytes:
        """Return the result as UTF-8 JSON; the same archive and dataset give the same bytes on every machine."""
        return (json.dumps(self.to_dict(), indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()


def tabulate(
    views: Sequence[ViewScore],
    declared: Declaration = NOT_DECLARED,
    reference: Reference = NO_REFERENCE,
    published: PublishedMatch | None = None,
    split: str | None = None,
    truth_sigma_m: float | None = None,
) -> Table:
    """Return the table of a config, or of a group of its views, from the scores of its scored views.

    The intervals of a config with splits are those of resampled scenes, of others those of consecutive views.
    A config without views is not ranked, and neither is a submission that declares the use of ground truth. An
    infinite metric (of a prediction so large that its square overflows) is written as null; the rank error is
    always finite.
    """
    predicted = [view for view in views if view.native is not None]
    native = mean_metrics([view.native for view in predicted if view.native])
    scaled = mean_metrics([view.scaled for view in predicted if view.scaled])
    constants = [view.scaled_constant for view in predicted if view.scaled_constant is not None]
    return Table(
        views=len(views),
        views_scored=len(predicted),
        coverage=mean([view.coverage for view in views]),
        ranked=bool(views) and not declared.uses_ground_truth,
        rank_error=mean([view.rank_error for view in views]),
        native=native,
        scaled=scaled,
        scale_median=median([view.scale for view in predicted if view.scale is not None]) if predicted else None,
        within_mm={t: mean([view.within_mm[t] for view in views]) for t in WITHIN_MM},
        reference=reference,
        scaled_constant=(mean([abs_rel for abs_rel, _ in constants]), mean([rmse_cm for _, rmse_cm in constants])),
        published=published,
        split=split,
        truth_sigma_m=truth_sigma_m,
        intervals=view_intervals(views, by_scene=split is not None) if views else dict.fromkeys(VIEW_METRICS),
    )


def _describe_table(table: Table) -> str:
    if table.native is None or table.scaled is None:
        return "no predictions"
    note = "" if table.ranked else ", not ranked"
    error = "" if table.rank_error is None else f"rank error {table.rank_error:.4g}, "
    return f"{error}AbsRel {table.native.abs_rel:.4g} native, {table.scaled.abs_rel:.4g} scaled{note}"


def _metrics_dict(metrics: DepthMetrics | None) -> dict[str, float | None]:
    return {name: rounded(getattr(metrics, name, None)) for name in METRIC_NAMES}


def _within_dict(within_mm: Mapping[int, float | None] | Mapping[int, float]) -> dict[str, float | None]:
    return {str(tolerance): rounded(share) for tolerance, share in within_mm.items()}


def _table_dict(table: Table) -> dict[str, Any]:
    abs_rel, rmse_cm = map(rounded, table.scaled_constant)
    return {
        **({} if table.split is None else {"split": table.split}),
        **({} if table.truth_sigma_m is None else {"truth_sigma_m": table.truth_sigma_m}),
        "views": table.views,
        "views_scored": table.views_scored,
        "coverage": rounded(table.coverage),
        "ranked": table.ranked,
        "rank_error": rounded(table.rank_error),
        "native": _metrics_dict(table.native),
        "scaled": _metrics_dict(table.scaled),
        "scale_median": rounded(table.scale_median),
        "within_mm": _within_dict(table.within_mm),
        "reference": {**table.reference.to_dict(), "scaled_constant": {"abs_rel": abs_rel, "rmse_cm": rmse_cm}},
        "published": None if table.published is None else table.published.to_dict(),
        "ci95": _intervals_dict(table.intervals),
        **({"groups": _groups_dict(table.groups)} if table.groups else {}),
    }


def _groups_dict(groups: Mapping[str, Mapping[str, Table]]) -> dict[str, dict[str, Any]]:
    return {
        grouping: {group: _table_dict(table) for group, table in tables.items()}
        for grouping, tables in groups.items()
    }


def _intervals_dict(intervals: Mapping[str, Interval | None]) -> dict[str, Any]:
    """Return the intervals nested like the metrics of the table."""
    nested: dict[str, Any] = {}
    for name, bounds in intervals.items():
        group, _, key = name.rpartition(".")
        target = nested.setdefault(group, {}) if group else nested
        target[key] = rounded_interval(bounds)
    return nested


def _view_dict(view: ViewScore) -> dict[str, Any]:
    return {
        "view_id": view.view_id,
        "scored_px": view.scored_px,
        "coverage": rounded(view.coverage),
        "rank_error": rounded(view.rank_error),
        "scale": rounded(view.scale),
        "native": _metrics_dict(view.native),
        "scaled": _metrics_dict(view.scaled),
        "within_mm": _within_dict(view.within_mm),
    }
