"""Scale of an archive from k views of known depth: Figure 3 of the paper.

    python examples/paper/anchor.py colmap.zip --data ROOT --config lattice-zed --figure figure3.pdf

A view with true depth z and prediction p has the ratio r = median(z / p) over its scored pixels; the scale of the
archive is the median of r over k such views, drawn without replacement. Its errors times this scale are compared
with those times a given one (``--baseline-scale``, of markers or of a stereo baseline): means over views on the
scored pixels that have a prediction. The known depth is exact, unlike measurements on a site.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from jaxtyping import Float64
from numpy import ndarray

from outputs import add_outputs, number, only_config, run_script, write_outputs
from rebar_depth_bench.base.errors import InputError, SubmissionError
from rebar_depth_bench.base.parallel import map_in_threads
from rebar_depth_bench.base.terminal import ProgressBars
from rebar_depth_bench.cli.console import add_archive, add_data
from rebar_depth_bench.scoring.columns import coverage_percent
from rebar_depth_bench.scoring.evaluation import Evaluation, open_evaluation
from rebar_depth_bench.scoring.metrics import is_valid_prediction
from rebar_depth_bench.scoring.truth import config_truth
from rebar_depth_bench.scoring.view_numbers import ViewTruth
from rebar_depth_bench.submission import SubmissionReader

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COUNTS = (1, 2, 3, 5, 10, 20, 30, 50, 100, 150, 200, 300)
PUBLISHED = (
    "Paper, Sec. III.C (COLMAP on the authors' 504 renders of the lattice): the mean scale from 1 view is within "
    "0.15 % of that of the markers; RMSE 1.60 cm with 6 markers, 1.69 cm with 12."
)
Values = Float64[ndarray, " n"]


def argument_parser() -> argparse.ArgumentParser:
    """Return the parser of the script's arguments."""
    parser = argparse.ArgumentParser(description="scale an archive, metric or not, from k views of known depth")
    add_archive(parser)
    add_data(parser)
    parser.add_argument("--config", metavar="NAME", help="config to evaluate (default: the archive's only one)")
    positive, count = number(float, sys.float_info.min), number(int, 1)
    scale = "baseline of all changes: the archive multiplied by S (default: %(default)s)"
    parser.add_argument("--baseline-scale", type=positive, default=1.0, metavar="S", help=scale)
    known = f"numbers of known-depth views (default: {' '.join(map(str, COUNTS))})"
    parser.add_argument("--num-anchor-views", type=count, nargs="+", default=COUNTS, metavar="K", help=known)
    parser.add_argument("--draws", type=number(int, 1, 1000), default=24, help="draws for each k (default: 24)")
    parser.add_argument("--seed", type=number(int, 0, 2**31 - 1), default=0, help="seed of the draws (default: 0)")
    add_outputs(parser)
    return parser


def scored_pairs(submission: SubmissionReader, truth: ViewTruth) -> tuple[Values, Values]:
    """Return predicted and true depth in metres of the scored pixels with a valid prediction, in pixel order."""
    predicted_m = submission.read(truth.view_id).ravel()[truth.index]
    valid = is_valid_prediction(predicted_m)
    return predicted_m[valid].astype(np.float64), truth.depth_m[valid].astype(np.float64)


def errors_at_scales(p_m: Values, z_m: Values, scales: Float64[ndarray, " m"]) -> Float64[ndarray, "2 m"]:
    """Return AbsRel and RMSE (centimetres) of scale * p at each of m scales, for one or more pixels.

    With d = (p - z) / z in ascending order, s d + (s - 1), whose absolute value is |s p - z| / z, changes its sign
    at most once, so that two prefix sums give the mean at any s. The sum of squares is a parabola in s, evaluated
    relative to its minimum to keep small errors accurate. Values that overflow give ``inf``.
    """
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        relative = np.sort((p_m - z_m) / z_m)
        prefix_sums = np.concatenate([[0.0], np.cumsum(relative)])
        offset = scales - 1.0
        split = np.searchsorted(relative, -offset / scales)
        too_near_sum = -(scales * prefix_sums[split] + offset * split)
        too_far_sum = scales * (prefix_sums[-1] - prefix_sums[split]) + offset * (len(relative) - split)
        power = np.dot(p_m, p_m)
        best_scale = np.dot(p_m, z_m) / power
        residual_m = best_scale * p_m - z_m
        square_sum = power * (scales - best_scale) ** 2 + np.dot(residual_m, residual_m)
        abs_rel = np.maximum(too_near_sum + too_far_sum, 0.0) / len(relative)
        errors = np.stack([abs_rel, 100.0 * np.sqrt(square_sum / len(relative))])
    return np.where(np.isnan(errors), np.inf, errors)


def draw_scales(ratios: Values, k: int, draws: int, seed: int) -> Float64[ndarray, " draws"]:
    """Return for each draw the median ratio of k views, which depends on seed, k and the draw's number only.

    Raw PCG64 output serves as sort keys because it does not change between NumPy versions.
    """
    keys = [np.random.PCG64([seed, k, draw]).random_raw(len(ratios)) for draw in range(draws)]
    return np.array([np.median(ratios[np.argsort(key, kind="stable")[:k]]) for key in keys])


def spread(values: Sequence[float]) -> dict[str, float | None]:
    """Return mean, sample standard deviation (None for one value), minimum and maximum; NaN if not all finite."""
    if not all(map(math.isfinite, values)):
        return dict.fromkeys(("mean", "sd", "low", "high"), math.nan)
    mean, n = math.fsum(values) / len(values), len(values)
    sd = math.sqrt(math.fsum((value - mean) ** 2 for value in values) / (n - 1)) if n > 1 else None
    return {"mean": mean, "sd": sd, "low": min(values), "high": max(values)}


def anchored_row(k: int, given: dict[str, float], draws: list[dict[str, float]]) -> dict[str, Any]:
    """Return the row of k: the spread of scale, deviation and changes of the errors over the draws."""
    changes = {key: [draw[key] - given[key] for draw in draws] for key in ("abs_rel", "rmse_cm")}
    return {
        "k": k,
        "scale": spread([draw["scale"] for draw in draws]),
        "deviation_percent": spread([100.0 * (draw["scale"] / given["scale"] - 1.0) for draw in draws]),
        **{f"{key}_change": spread(values) for key, values in changes.items()},
        "draws": draws,
    }


def anchored(evaluation: Evaluation, options: argparse.Namespace, bars: ProgressBars) -> dict[str, Any]:
    """Return the JSON object: errors at the given scale, at that of all views, and for each k with all draws.

    Views without prediction are neither drawn nor scored. A k above the number of the other views is left out.
    """
    config = only_config(options.archive, evaluation.configs, options.config)
    truths = config_truth(evaluation.folder, config, bars.update)

    def ratio_and_coverage(truth: ViewTruth) -> tuple[float | None, float]:
        p_m, z_m = scored_pairs(evaluation.submission, truth)
        with np.errstate(over="ignore", under="ignore"):
            return float(np.median(z_m / p_m)) if len(p_m) else None, len(p_m) / len(truth.index)

    count = len(truths.view_ids)
    found = list(map_in_threads(ratio_and_coverage, truths.views, count, "ratios", progress=bars.update))
    predicted = [position for position, (ratio, _) in enumerate(found) if ratio is not None]
    ratios = np.array([ratio for ratio, _ in found if ratio is not None])
    wanted = sorted(set(options.num_anchor_views))
    counts = [k for k in wanted if k <= len(ratios)]
    if not counts:
        have = f"{len(ratios)} of {count} views of {config.name} have a prediction"
        raise InputError(f"{options.archive}: {have}, expected at least {wanted[0]}, the smallest k")
    drawn = [draw_scales(ratios, k, options.draws, options.seed) for k in counts]
    scales = np.concatenate([[options.baseline_scale, np.median(ratios)], *drawn])

    def errors_of_view(position: int) -> Float64[ndarray, "2 m"]:
        return errors_at_scales(*scored_pairs(evaluation.submission, truths.views[position]), scales)

    errors = list(map_in_threads(errors_of_view, predicted, len(predicted), "errors", progress=bars.update))
    numbers = zip(scales.tolist(), *np.mean(errors, axis=0).tolist(), strict=True)
    given, all_views, *draws = [dict(zip(("scale", "abs_rel", "rmse_cm"), one, strict=True)) for one in numbers]
    markers = {scene.board.markers if scene.board else None for scene in config.scenes}
    return {
        "study": "anchor",
        **evaluation.provenance().to_dict(),
        "config": config.name,
        "markers": markers.pop() if len(markers) == 1 else None,
        "seed": options.seed,
        "views": count,
        "views_without_prediction": [truths.view_ids[n] for n, (ratio, _) in enumerate(found) if ratio is None],
        "coverage": math.fsum(coverage for _, coverage in found) / len(found),
        "given": given,
        "all_views": all_views,
        "left_out_k": [k for k in wanted if k > len(ratios)],
        "rows": [anchored_row(k, given, [draws.pop(0) for _ in range(options.draws)]) for k in counts],
    }


def draw_figure(figure: Figure, table: pd.DataFrame) -> None:
    """Draw mean and range over the draws of the change of AbsRel and of the scale, over k."""
    titles = {"abs_rel_change": "change of mean AbsRel", "deviation_percent": "scale against the given one, %"}
    for axes, (name, title) in zip(figure.subplots(1, len(titles)), titles.items(), strict=True):
        axes.plot(table["k"], table[f"{name}_mean"], marker="o")
        axes.fill_between(table["k"], table[f"{name}_low"], table[f"{name}_high"], alpha=0.2)
        axes.axhline(0.0, color="black", linestyle="--", linewidth=1)
        axes.set(xscale="log", xlabel="known-depth views k", ylabel=title)


def run(options: argparse.Namespace) -> None:
    """Compute the table, write the requested files and print it."""
    with ProgressBars() as bars, open_evaluation(options.archive, options.data) as evaluation:
        evaluation.require_metric("the scale is that of depth in metres")
        if problems := list(evaluation.submission.problems(bars.update)):
            raise SubmissionError.from_problems(options.archive, problems)
        content = anchored(evaluation, options, bars)
    table = pd.json_normalize([{**row, "draws": len(row["draws"])} for row in content["rows"]], sep="_")
    notes = [
        f"{content['config']} times {content['given']['scale']:g}: AbsRel {content['given']['abs_rel']:.4f}, RMSE "
        f"{content['given']['rmse_cm']:.2f} cm; coverage {coverage_percent(content['coverage'])} %; without "
        f"prediction: {len(content['views_without_prediction'])} of {content['views']} views",
        PUBLISHED,
    ]
    shown = [name for name in table if not name.endswith("_sd")]
    write_outputs(options, content, table, shown, notes, lambda figure: draw_figure(figure, table))


if __name__ == "__main__":
    sys.exit(run_script(argument_parser(), run))
