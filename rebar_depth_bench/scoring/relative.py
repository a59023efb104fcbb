"""Errors of relative depth by protocol ``rebar-relative-1``: predictions are aligned with the truth of each view.

x is the prediction and z the true planar depth in metres, both float64, on V, the scored pixels of a view where x
has a value. Every pixel has the same weight and every view its own fit:

================  ==========================  ===============================================================
kind              V                           aligned depth p
================  ==========================  ===============================================================
scale             x is finite and above 0     x median(z) / median(x), the scaled numbers of ``rebar-2``
affine-depth      x is finite                 a x + b, which minimises the sum of (a x + b - z)^2
affine-disparity  x is finite                 1 / max(a x + b, 1 / max(z)); a and b minimise the sum of
                                              (a x + b - 1/z)^2
================  ==========================  ===============================================================

A fit with a slope a <= 0, of fewer than two pixels or of a constant x is replaced by a = 0 and b = mean of the
target. The robust variant of the affine kinds has a = mean|y - median(y)| / mean|x - median(x)| and
b = median(y) - a median(x) for the target y (MiDaS: Ranftl et al., TPAMI 2022, equation 5), and the same bound of
the disparity.

Every alignment uses the truth, so that none ranks. Beside each stands the constant of the same fit (a = 0):
median(z) for scale, else the mean of the target. The error counts 1 outside V and where p <= 0; the other metrics
take p as it is, over V, and a p <= 0 is not counted in delta1.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Float64, Integer
from numpy import ndarray

from rebar_depth_bench.scoring.columns import METRICS, SIGNIFICANT_DIGITS, value_at
from rebar_depth_bench.scoring.metrics import is_valid_prediction, mean, median, metrics_at_scales, rank_error
from rebar_depth_bench.scoring.protocol import MIN_COMPARABLE_COVERAGE, WITHIN_MM
from rebar_depth_bench.scoring.table import AlignedErrors, Table, ViewScore
from rebar_depth_bench.submission.declaration import METRIC

if TYPE_CHECKING:
    from rebar_depth_bench.scoring.result import Result

ALIGNMENT_BY_KIND: Mapping[str, str] = {
    "scale": "depth up to a scale, p = x median(z) / median(x) in each view",
    "affine-depth": "depth up to scale and shift, p = a x + b fitted to z in each view",
    "affine-disparity": "disparity up to scale and shift, 1 / p = a x + b fitted to 1 / z in each view",
}
"""Kinds of predictions that are not metric, and how they are aligned."""

LEAST_MARGIN = 0.05
"""Share by which an error must be below that of a constant; otherwise the predictions say little about depth."""


_NO_VALUES = AlignedErrors(1.0, None, None, None, None, dict.fromkeys(WITHIN_MM, 0.0))
"""Errors of a view in which no scored pixel has a value."""


def has_value(x: Float[ndarray, " n"], kind: str) -> Bool[ndarray, " n"]:
    """Return where a prediction of this kind has a value."""
    return np.isfinite(x) if kind.startswith("affine") else is_valid_prediction(x)


def align_view(view_id: str, x: Float[ndarray, " n"], z_m: Float[ndarray, " n"], kind: str) -> ViewScore:
    """Return the errors of a view's prediction ``x`` and true depth ``z_m``, metres, on all its scored pixels.

    Its ``coverage`` is the share of these in V; ``is_flat`` is whether the fit has no positive slope.
    """
    valid = has_value(x, kind)
    values, z = x[valid].astype(np.float64), z_m[valid].astype(np.float64)
    score = partial(ViewScore, view_id, len(z_m), len(values) / len(z_m))
    if not len(values):
        robust = None if kind == "scale" else _NO_VALUES
        return score(aligned=_NO_VALUES, aligned_robust=robust, constant=_NO_VALUES, is_flat=kind != "scale")

    def errors(p_m: Float64[ndarray, " v"]) -> AlignedErrors:
        everywhere = np.zeros(len(z_m))
        everywhere[valid] = p_m
        error = rank_error(everywhere, z_m, np.isfinite(everywhere) & (everywhere > 0))
        [metrics], within = metrics_at_scales(p_m, z, (1.0,), WITHIN_MM)
        shares = {tolerance_mm: count / len(z_m) for tolerance_mm, count in within.items()}
        return AlignedErrors(error=error, **vars(metrics), within_mm=shares)

    if kind == "scale":
        with np.errstate(over="ignore"):
            scaled = values * (median(z) / median(values))
        constant = errors(np.full(len(z), median(z)))
        return score(aligned=errors(scaled), constant=constant, is_flat=False)
    target = 1.0 / z if kind == "affine-disparity" else z
    values = _within_range(values, values)
    fits = (_least_squares(values, target), _robust_fit(values, target), (0.0, float(target.mean())))
    aligned, robust, constant = (errors(_fitted_depth(fit, values, z, kind)) for fit in fits)
    return score(aligned=aligned, aligned_robust=robust, constant=constant, is_flat=fits[0][0] == 0.0)


def metric_as(depth_m: Float[ndarray, "h w"], kind: str) -> Float64[ndarray, "h w"]:
    """Return metric predictions as those of another kind: disparity is 1 / depth; NaN where there are none."""
    values = np.where(is_valid_prediction(depth_m), depth_m, np.nan).astype(np.float64)
    with np.errstate(over="ignore"):
        return 1.0 / values if kind == "affine-disparity" else values


def aligned_depth(
    x: Float[ndarray, "h w"], truth_m: Float[ndarray, "h w"], scored: Integer[ndarray, " n"], kind: str
) -> Float64[ndarray, "h w"]:
    """Return the aligned depth of a whole view, metres: the fit of ``align_view`` on the flat indices ``scored``.

    It is NaN where the prediction ``x`` has no value, and everywhere if no scored pixel has one.
    """
    everywhere = np.where(has_value(x, kind), x, np.nan).astype(np.float64)
    at = scored[np.isfinite(everywhere.ravel()[scored])]
    if not len(at):
        return np.full(x.shape, np.nan)
    z = truth_m.ravel()[at].astype(np.float64)
    with np.errstate(over="ignore"):
        if kind == "scale":
            return everywhere * (median(z) / median(everywhere.ravel()[at]))
        everywhere = _within_range(everywhere, everywhere.ravel()[at])
        target = 1.0 / z if kind == "affine-disparity" else z
        return _fitted_depth(_least_squares(everywhere.ravel()[at], target), everywhere, z, kind)


def _within_range(x: Float64[ndarray, "*n"], fitted: Float64[ndarray, " v"]) -> Float64[ndarray, "*n"]:
    """Return x times the power of two that brings the values ``fitted`` to at most 1.

    It changes no digit of the fit; squares of values near the limits of float64 would overflow.
    """
    return np.ldexp(x, -int(np.frexp(np.abs(fitted).max())[1]))


def _fitted_depth(
    fit: tuple[float, float], x: Float64[ndarray, "*n"], z_m: Float64[ndarray, " v"], kind: str
) -> Float64[ndarray, "*n"]:
    """Return the depth of x, metres, by a fit (a, b) to the target of a kind on pixels of true depth ``z_m``."""
    line = fit[0] * x + fit[1]
    return 1.0 / np.maximum(line, 1.0 / z_m.max()) if kind == "affine-disparity" else line


def _least_squares(x: Float64[ndarray, " n"], y: Float64[ndarray, " n"]) -> tuple[float, float]:
    """Return (a, b) that minimise the sum of (a x + b - y)^2, or (0, mean(y)) as the module says."""
    x_mean, y_mean = float(x.mean()), float(y.mean())
    x_off = x - x_mean
    if _vary(x, y) and (a := float(x_off @ (y - y_mean)) / float(x_off @ x_off)) > 0:
        return a, y_mean - a * x_mean
    return 0.0, y_mean


def _robust_fit(x: Float64[ndarray, " n"], y: Float64[ndarray, " n"]) -> tuple[float, float]:
    """Return (a, b) of the robust variant, or (0, mean(y)) as the module says."""
    if not _vary(x, y):
        return 0.0, float(y.mean())
    x_median, y_median = median(x), median(y)
    a = float(np.abs(y - y_median).mean()) / float(np.abs(x - x_median).mean())
    return a, y_median - a * x_median


def _vary(x: Float64[ndarray, " n"], y: Float64[ndarray, " n"]) -> bool:
    """Return whether neither is constant; of a constant, rounding would leave a slope beside 0."""
    return bool(x.min() < x.max() and y.min() < y.max())


def mean_errors(errors: Iterable[AlignedErrors | None]) -> AlignedErrors | None:
    """Return the mean of each number over the views that have it; None if no view has any."""
    found = [one for one in errors if one is not None]

    def mean_at(path: str) -> Any:
        return mean([value for one in found if (value := value_at(one, path)) is not None])

    means = {name: mean_at(name) for name in ("error", *METRICS)}
    return AlignedErrors(**means, within_mm={t: mean_at(f"within_mm.{t}") for t in WITHIN_MM}) if found else None


def kind_blocks(results: Iterable[Result]) -> list[list[Result]]:
    """Return the results of each kind; others than metric ones by the aligned errors of their configs."""
    blocks: dict[str, list[Result]] = {kind: [] for kind in (METRIC, *ALIGNMENT_BY_KIND)}
    for result in results:
        blocks[result.kind].append(result)
    for kind in ALIGNMENT_BY_KIND:
        blocks[kind].sort(key=lambda result: [table.error or 0.0 for table in result.tables.values()])
    return [block for block in blocks.values() if block]


def kind_text(result: Result) -> str:
    """Return the kind of a result that is not metric and how it is aligned, and whether its archive is metric."""
    declared = f"{result.declared_prediction} predictions, scored as " if result.declared_prediction else ""
    return f"{declared}{result.kind}{' (--align)' if declared else ''}: {ALIGNMENT_BY_KIND[result.kind]}"


def error_and_constant(table: Table) -> tuple[float | None, float | None]:
    """Return the scaled AbsRel of a table, of a kind that is not metric the aligned error, and a constant's."""
    if table.aligned is not None and table.constant is not None:
        return table.aligned.error, table.constant.error
    return value_at(table, "scaled.abs_rel"), table.reference.scaled_constant.abs_rel


def constant_margin(table: Table) -> float | None:
    """Return the share by which the error is below that of a constant, negative if above; None if undefined."""
    error, constant = error_and_constant(table)
    if not table.views_scored or error is None or not constant:
        return None
    margin = round(1 - error / constant, SIGNIFICANT_DIGITS) + 0.0  # Neither rounding errors nor -0.0.
    return margin if math.isfinite(margin) else None


def is_like_constant(table: Table) -> bool:
    """Return whether the error of a table is not below that of a constant by ``LEAST_MARGIN``."""
    margin = constant_margin(table)
    return margin is not None and margin < LEAST_MARGIN


def constant_findings(table: Table) -> list[str]:
    """Return a sentence on each sign that the predictions of a table say little about depth."""
    findings = []
    if is_like_constant(table):
        error, constant = error_and_constant(table)
        compared = f"{error:.4f} is not below {100 * (1 - LEAST_MARGIN):.0f} % of a constant's ({constant:.4f})"
        is_low = (table.coverage or 0.0) < MIN_COMPARABLE_COVERAGE
        missing = ", or missing values are most of both errors" if is_low else ""
        findings.append(
            f"The scaled AbsRel {compared}: a plane at one depth is about as good, or better."
            if table.aligned is None
            else f"The aligned error {compared}: the fit hides that the predictions say little about "
            f"depth{missing}."
        )
    if table.views_scored and (table.flat_views or 0) > table.views / 2:
        findings.append(
            f"In {table.flat_views} of {table.views} views the fit has no positive slope and is a constant: it "
            "hides that the predictions say nothing about depth, or run the other way (depth declared as "
            "disparity, or disparity as depth)."
        )
    return findings
