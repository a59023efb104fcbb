"""Scale of an archive from known depth: k known views (Figure 3 of the paper), a laser reading, a known spacing.

    python examples/paper/anchor.py colmap.zip --data ROOT --config lattice-zed --figure figure3.pdf

What is known is taken from the ground truth, exact unlike measurements on a site:

- views: a view with true depth z and prediction x has the ratio r = median(z / x) over its scored pixels; the
  scale of the archive is the median of r over k such views, drawn without replacement.
- reading: in each picture, a laser measures the range from the centre of the left camera to the surface at one
  drawn scored pixel. With the ray (u, v, 1) of the pixel, its planar depth z is the range / |(u, v, 1)|. The scale
  of the picture is z / x at the pixel.
- spacing: in each picture, the distance of two surface points is known, such as that of two bars: a drawn scored
  pixel, and the one whose distance from it is nearest to ``--spacing``. The scale of the picture is this distance
  divided by that of the two points in the prediction; a picture with one scored pixel keeps the given scale.
- reading+spacing: the mean of both scales.

Affine kinds have a scale a and a shift b: y = a x + b, with y = z (``affine-depth``) or 1 / z
(``affine-disparity``). Neither one reading nor one spacing determines both:

- views: least squares in each view (a = 0 and b = mean(y) if the slope is not positive); the median of a, and that
  of b, over k views.
- reading+spacing: the line through the reading that gives the two points their distance and positive depth; of
  several, the one of the smallest a > 0.
- two readings: the line through both. The second is at the first point of the spacing, which is at the 5th or the
  95th percentile of x, whichever is farther from the reading.

Without a solution a > 0, the y of the reading is taken everywhere. As in ``rebar-relative-1``, 1 / z is at least
that of the farthest scored pixel.

The errors are compared with given ones. Of metric depth, these are those of the archive times a given scale
(``--baseline-scale``, of markers or of a stereo baseline); of ``scale``, those times the median of r of all views;
of affine kinds, those of the fit of each view. They are means over views on the scored pixels that have a
prediction.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from jaxtyping import Float, Float64
from numpy import ndarray
from numpy.polynomial import Polynomial

from outputs import add_outputs, number, only_config, run_script, write_outputs
from rebar_depth_bench.base.errors import InputError, SubmissionError
from rebar_depth_bench.base.parallel import map_in_threads
from rebar_depth_bench.base.terminal import ProgressBars
from rebar_depth_bench.cli.console import add_archive, add_data
from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.data.rows import iterate_rows
from rebar_depth_bench.geometry.cameras import pixel_rays
from rebar_depth_bench.scoring.columns import coverage_percent
from rebar_depth_bench.scoring.evaluation import Evaluation, open_evaluation
from rebar_depth_bench.scoring.relative import has_value
from rebar_depth_bench.scoring.truth import config_truth
from rebar_depth_bench.scoring.view_numbers import ViewTruth
from rebar_depth_bench.submission import SubmissionReader
from rebar_depth_bench.submission.declaration import METRIC

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COUNTS = (1, 2, 3, 5, 10, 20, 30, 50, 100, 150, 200, 300)
PUBLISHED = (
    "Paper, Sec. III.C (COLMAP on the authors' 504 renders of the lattice): the mean scale from 1 view is within "
    "0.15 % of that of the markers; RMSE 1.60 cm with 6 markers, 1.69 cm with 12."
)
SCALE_ANCHORS = ("reading", "spacing", "reading+spacing")
AFFINE_ANCHORS = ("reading+spacing", "two readings")
AFFINE_NOTE = "One reading, or one spacing, does not determine both scale and shift: see the script's first lines."
Values = Float64[ndarray, " n"]
Fits = Float64[ndarray, "m 2"]


@dataclass(frozen=True, eq=False)
class Pixels:
    """Scored pixels of a view with a prediction ``x``: planar depth, and rays (u, v, 1) of the left camera."""

    x: Values
    z_m: Values
    rays: Float64[ndarray, "n 3"]


def argument_parser() -> argparse.ArgumentParser:
    """Return the parser of the script's arguments."""
    parser = argparse.ArgumentParser(description="scale an archive, metric or not, from known depth or lengths")
    add_archive(parser)
    add_data(parser)
    parser.add_argument("--config", metavar="NAME", help="config to evaluate (default: the archive's only one)")
    positive, count = number(float, sys.float_info.min), number(int, 1)
    scale = "baseline of all changes: the archive multiplied by S (default: 1, or what fits all views; not affine)"
    parser.add_argument("--baseline-scale", type=positive, metavar="S", help=scale)
    known = f"numbers of known-depth views (default: {' '.join(map(str, COUNTS))})"
    parser.add_argument("--num-anchor-views", type=count, nargs="+", default=COUNTS, metavar="K", help=known)
    spacing = "known distance of two points in each picture, metres (default: %(default)s)"
    parser.add_argument("--spacing", type=positive, default=0.1, metavar="METRES", help=spacing)
    parser.add_argument("--draws", type=number(int, 1, 1000), default=24, help="draws for each k (default: 24)")
    parser.add_argument("--seed", type=number(int, 0, 2**31 - 1), default=0, help="seed of the draws (default: 0)")
    add_outputs(parser)
    return parser


def read_rays(config: DatasetConfig) -> dict[str, Float[ndarray, "h*w 3"]]:
    """Return the rays (u, v, 1) of all pixels of the left camera by view id; equal cameras share an array."""
    rays_by_camera: dict[bytes, Float[ndarray, "h*w 3"]] = {}
    rays_by_view = {}
    height, width = config.grid
    for row in iterate_rows(config, ("view_id", "left_K", "left_distortion")):
        camera = row["left_K"].tobytes() + row["left_distortion"].tobytes()
        if camera not in rays_by_camera:
            rays = pixel_rays(row["left_K"], width, height, row["left_distortion"])
            rays_by_camera[camera] = rays.reshape(-1, 3)
        rays_by_view[row["view_id"]] = rays_by_camera[camera]
    return rays_by_view


def predicted_pixels(
    submission: SubmissionReader, truth: ViewTruth, kind: str, rays: Float[ndarray, "h*w 3"]
) -> Pixels:
    """Return the scored pixels of a view whose prediction has a value."""
    x = submission.read(truth.view_id).ravel()[truth.index]
    valid = has_value(x, kind)
    return Pixels(x[valid].astype(np.float64), truth.depth_m[valid].astype(np.float64), rays[truth.index[valid]])


def whole_view_fit(pixels: Pixels, kind: str) -> tuple[float, float]:
    """Return a and b of a view whose depth is known."""
    with np.errstate(over="ignore", under="ignore"):
        if not kind.startswith("affine"):
            return float(np.median(pixels.z_m / pixels.x)), 0.0
        y = 1.0 / pixels.z_m if kind == "affine-disparity" else pixels.z_m
        off = pixels.x - pixels.x.mean()
        slope = float(off @ (y - y.mean()) / (off @ off)) if np.ptp(pixels.x) > 0 else 0.0
        return (slope, float(y.mean() - slope * pixels.x.mean())) if slope > 0 else (0.0, float(y.mean()))


def picture_fits(
    pixels: Pixels, kind: str, spacing_m: float, given_scale: float, raw: Sequence[int]
) -> list[tuple[float, float]]:
    """Return a and b of one picture from each of ``SCALE_ANCHORS`` or ``AFFINE_ANCHORS``.

    ``raw`` are two random integers, which draw the reading and, unless the kind is affine, the spacing.
    """
    x, z_m, n = pixels.x, pixels.z_m, len(pixels.x)
    reading, first = (one % n for one in raw)
    if kind.startswith("affine"):
        ends = np.argsort(x, kind="stable")[[int(0.05 * (n - 1)), int(0.95 * (n - 1))]]
        first = int(ends[np.argmax(np.abs(x[ends] - x[reading]))])
    points_m = z_m[:, None] * pixels.rays
    lengths_m = np.linalg.norm(points_m - points_m[first], axis=1)
    pair = [first, int(np.argmin(np.where(lengths_m > 0, np.abs(lengths_m - spacing_m), np.inf)))]
    length_m = lengths_m[pair[1]]
    if kind.startswith("affine"):
        y = 1.0 / z_m if kind == "affine-disparity" else z_m
        slopes = [spacing_slope(x[pair] - x[reading], y[reading], pixels.rays[pair], length_m, kind)]
        slopes.append((y[first] - y[reading]) / (x[first] - x[reading]) if x[first] != x[reading] else 0.0)
        return [(slope, y[reading] - slope * x[reading]) if slope > 0 else (0.0, y[reading]) for slope in slopes]
    by_reading = z_m[reading] / x[reading]
    predicted = np.linalg.norm(np.subtract(*(x[pair][:, None] * pixels.rays[pair])))
    by_spacing = length_m / predicted if length_m > 0 else given_scale
    return [(scale, 0.0) for scale in (by_reading, by_spacing, (by_reading + by_spacing) / 2)]


def spacing_slope(x_off: Values, y: float, rays: Float64[ndarray, "2 3"], length_m: float, kind: str) -> float:
    """Return the slope of the line through (0, ``y``) that places two points at a distance, 0 if there is none.

    ``x_off`` are the predictions of the points relative to that of the reading, ``rays`` their rays. The squared
    distance is a polynomial in the slope: of degree 2, or 4 after multiplication with both disparities.
    """
    first, second = (Polynomial([y, off]) for off in x_off)
    if kind == "affine-depth":
        vector, right = [first * u - second * v for u, v in rays.T], Polynomial([length_m])
    else:
        vector, right = [second * u - first * v for u, v in rays.T], length_m * first * second
    roots = (sum((entry**2 for entry in vector), -(right**2))).roots()
    real = roots.real[(np.abs(roots.imag) <= 1e-6 * np.abs(roots)) & (roots.real > 0)]
    return float(min((slope for slope in real if min(first(slope), second(slope)) > 0), default=0.0))


def errors_of_fits(pixels: Pixels, fits: Fits, kind: str) -> Float64[ndarray, "2 m"]:
    """Return AbsRel and RMSE (centimetres) of a view at each of m pairs of a and b."""
    x, z_m = pixels.x, pixels.z_m
    if not kind.startswith("affine"):
        return errors_at_scales(x, z_m, fits[:, 0])
    errors = np.empty((2, len(fits)))
    with np.errstate(over="ignore", under="ignore"):
        for position, (a, b) in enumerate(fits):
            y = a * x + b
            off_m = (1.0 / np.maximum(y, 1.0 / z_m.max()) if kind == "affine-disparity" else y) - z_m
            errors[:, position] = np.mean(np.abs(off_m) / z_m), 100.0 * np.sqrt(np.mean(off_m**2))
    return errors


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


def draw_fits(fits: Float64[ndarray, "n ..."], k: int, draws: int, seed: int) -> Float64[ndarray, "draws ..."]:
    """Return for each draw the median fit of k views, which depends on seed, k and the draw's number only.

    Raw PCG64 output serves as sort keys because it does not change between NumPy versions.
    """
    keys = [np.random.PCG64([seed, k, draw]).random_raw(len(fits)) for draw in range(draws)]
    return np.array([np.median(fits[np.argsort(key, kind="stable")[:k]], axis=0) for key in keys])


def spread(values: Sequence[float]) -> dict[str, float | None]:
    """Return mean, sample standard deviation (None for one value), minimum and maximum; NaN if not all finite."""
    if not all(map(math.isfinite, values)):
        return dict.fromkeys(("mean", "sd", "low", "high"), math.nan)
    mean, n = math.fsum(values) / len(values), len(values)
    sd = math.sqrt(math.fsum((value - mean) ** 2 for value in values) / (n - 1)) if n > 1 else None
    return {"mean": mean, "sd": sd, "low": min(values), "high": max(values)}


def anchored_row(anchor: str, k: int, given: dict[str, float], draws: list[dict[str, float]]) -> dict[str, Any]:
    """Return the row of k anchored pictures: the spread of scale, deviation and changes of the errors."""
    changes = {key: [draw[key] - given[key] for draw in draws] for key in ("abs_rel", "rmse_cm")}
    given_scale = given["scale"] or math.nan  # Constant predictions of affine kinds have a = 0.
    return {
        "anchor": anchor,
        "k": k,
        "scale": spread([draw["scale"] for draw in draws]),
        "deviation_percent": spread([100.0 * (draw["scale"] / given_scale - 1.0) for draw in draws]),
        **{f"{key}_change": spread(values) for key, values in changes.items()},
        "draws": draws,
    }


def anchored(evaluation: Evaluation, options: argparse.Namespace, bars: ProgressBars) -> dict[str, Any]:
    """Return the JSON object: given errors, those at the fit of all views, and for each anchor with all draws.

    Views without prediction are neither drawn nor scored. A k above the number of the other views is left out.
    """
    kind, config = evaluation.meta.prediction, only_config(options.archive, evaluation.configs, options.config)
    is_affine = kind.startswith("affine")
    truths, rays = config_truth(evaluation.folder, config, bars.update), read_rays(config)

    def pixels_of(truth: ViewTruth) -> Pixels:
        return predicted_pixels(evaluation.submission, truth, kind, rays[truth.view_id])

    def fit_and_coverage(truth: ViewTruth) -> tuple[tuple[float, float] | None, float]:
        pixels = pixels_of(truth)
        return whole_view_fit(pixels, kind) if len(pixels.x) else None, len(pixels.x) / len(truth.index)

    count = len(truths.view_ids)
    found = list(map_in_threads(fit_and_coverage, truths.views, count, "scales", progress=bars.update))
    predicted = [position for position, (fit, _) in enumerate(found) if fit is not None]
    fits = np.array([fit for fit, _ in found if fit is not None]).reshape(-1, 2)
    wanted = sorted(set(options.num_anchor_views))
    counts = [k for k in wanted if k <= len(fits)]
    if not counts:
        have = f"{len(fits)} of {count} views of {config.name} have a prediction"
        raise InputError(f"{options.archive}: {have}, expected at least {wanted[0]}, the smallest k")
    all_views = np.median(fits, axis=0)
    given_scale = options.baseline_scale or (1.0 if kind == METRIC else float(all_views[0]))
    shared = np.concatenate([[all_views], *(draw_fits(fits, k, options.draws, options.seed) for k in counts)])
    anchors = AFFINE_ANCHORS if is_affine else SCALE_ANCHORS

    def errors_and_own_fits(place: int) -> tuple[Float64[ndarray, "2 n"], Fits]:
        """Return a view's errors at the given, shared and own fits, and its own fits by anchor and draw."""
        pixels, given = pixels_of(truths.views[predicted[place]]), fits[place] if is_affine else (given_scale, 0.0)
        raw = [
            np.random.PCG64([options.seed, 0, draw, predicted[place]]).random_raw(2).tolist()
            for draw in range(options.draws)
        ]
        drawn = [picture_fits(pixels, kind, options.spacing, given_scale, two) for two in raw]
        own = np.array(drawn).swapaxes(0, 1).reshape(-1, 2)
        return errors_of_fits(pixels, np.concatenate([[given], shared, own]), kind), own

    places = range(len(predicted))
    results = list(map_in_threads(errors_and_own_fits, places, len(places), "errors", progress=bars.update))
    own = np.median([fits for _, fits in results], axis=0)
    given = fits.T.tolist() if is_affine else [[given_scale], [0.0]]
    a_and_b = np.concatenate([[np.median(given, axis=1)], shared, own])
    names = ("scale", "shift", "abs_rel", "rmse_cm") if is_affine else ("scale", "abs_rel", "rmse_cm")
    columns = [*a_and_b.T[: 2 if is_affine else 1], *np.mean([errors for errors, _ in results], axis=0)]
    numbers = [dict(zip(names, one, strict=True)) for one in np.transpose(columns).tolist()]
    draws = [numbers[start : start + options.draws] for start in range(2, len(numbers), options.draws)]
    groups = [("views", k) for k in counts] + [(anchor, len(predicted)) for anchor in anchors]
    rows = [anchored_row(*group, numbers[0], some) for group, some in zip(groups, draws, strict=True)]
    markers = {scene.board.markers if scene.board else None for scene in config.scenes}
    return {
        "study": "anchor",
        **evaluation.provenance().to_dict(),
        "config": config.name,
        "kind": kind,
        "markers": markers.pop() if len(markers) == 1 else None,
        "seed": options.seed,
        "spacing_m": options.spacing,
        "views": count,
        "views_without_prediction": [truths.view_ids[n] for n, (fit, _) in enumerate(found) if fit is None],
        "coverage": math.fsum(coverage for _, coverage in found) / len(found),
        "given": numbers[0],
        "all_views": numbers[1],
        "left_out_k": [k for k in wanted if k > len(fits)],
        "rows": rows[: len(counts)],
        "per_picture": rows[len(counts) :],
    }


def draw_figure(figure: Figure, table: pd.DataFrame) -> None:
    """Draw mean and range over the draws of the change of AbsRel and of the scale, over the anchored pictures."""
    titles = {"abs_rel_change": "change of mean AbsRel", "deviation_percent": "scale against the given one, %"}
    for axes, (name, title) in zip(figure.subplots(1, len(titles)), titles.items(), strict=True):
        for anchor, rows in table.groupby("anchor", sort=False):
            mean = rows[f"{name}_mean"]
            axes.plot(rows["k"], mean, marker="o", label=anchor)
            axes.fill_between(rows["k"], rows[f"{name}_low"], rows[f"{name}_high"], alpha=0.2)
        axes.axhline(0.0, color="black", linestyle="--", linewidth=1)
        axes.set(xscale="log", xlabel="anchored pictures k", ylabel=title)
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter("")
    axes.legend()


def run(options: argparse.Namespace) -> None:
    """Compute the table, write the requested files and print it."""
    with ProgressBars() as bars, open_evaluation(options.archive, options.data) as evaluation:
        is_affine = evaluation.meta.prediction.startswith("affine")
        if is_affine and options.baseline_scale is not None:
            found = f"--baseline-scale is given, but the predictions are of the kind {evaluation.meta.prediction}"
            raise InputError(
                f"{options.archive}: {found}: expected none, they are compared with fits of each view"
            )
        if problems := list(evaluation.submission.problems(bars.update)):
            raise SubmissionError.from_problems(options.archive, problems)
        content = anchored(evaluation, options, bars)
    rows = [*content["rows"], *content["per_picture"]]
    table = pd.json_normalize([{**row, "draws": len(row["draws"])} for row in rows], sep="_")
    given = "fitted in each view" if is_affine else f"times {content['given']['scale']:g}"
    notes = [
        f"{content['config']} {given}: AbsRel {content['given']['abs_rel']:.4f}, RMSE "
        f"{content['given']['rmse_cm']:.2f} cm; coverage {coverage_percent(content['coverage'])} %; without "
        f"prediction: {len(content['views_without_prediction'])} of {content['views']} views",
        AFFINE_NOTE if is_affine else PUBLISHED,
    ]
    shown = [name for name in table if not name.endswith("_sd")]
    write_outputs(options, content, table, shown, notes, lambda figure: draw_figure(figure, table))


if __name__ == "__main__":
    sys.exit(run_script(argument_parser(), run))
