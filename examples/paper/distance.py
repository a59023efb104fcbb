"""Scale and error of predictions over the distance of the steel (paper, Sec. III.B).

    python examples/paper/distance.py a.zip --data ROOT --figure distance.pdf

The scale s = median(z) / median(p) "reverses with distance": below 1 on the lattice, above 1 on the pier. The
least-squares slope of log s over log distance is 0 if one scale fits all distances, and 1 if the prediction is the
same at every distance. The distance of a view is the median true depth of its scored pixels.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from jaxtyping import Float64
from numpy import ndarray

from outputs import add_outputs, flat_table, number, run_script, single_bar_means, write_outputs
from rebar_depth_bench import score
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.base.terminal import ProgressBars
from rebar_depth_bench.cli.console import add_archive, add_data
from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.scoring import bootstrap
from rebar_depth_bench.scoring.evaluation import Evaluation, open_evaluation
from rebar_depth_bench.scoring.metrics import mean
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.truth import config_truth

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MIN_DISTANCE_RATIO = 1.05  # Of the farthest to the nearest view, for a slope.
ERRORS = ["native_abs_rel", "scaled_abs_rel"]
VIEW_COLUMNS = ["view_id", "distance_m", "scale", *ERRORS]


def argument_parser() -> argparse.ArgumentParser:
    """Return the parser of the script's arguments."""
    parser = argparse.ArgumentParser(description="scale and error of predictions by distance")
    add_archive(parser)
    add_data(parser)
    parser.add_argument("--config", nargs="+", metavar="NAME", help="configs (default: all in the archive)")
    bins = "distance bins from 1 m to 10 m, equal in log distance (default: 10)"
    parser.add_argument("--bins-per-decade", type=number(int, 1, 100), default=10, metavar="N", help=bins)
    add_outputs(parser)
    return parser


def estimate(value: float | None, draws: Float64[ndarray, " draws"], blocks: bootstrap.Blocks) -> dict[str, Any]:
    """Return a value with its 95 % interval over resamples of blocks; the interval is None for few blocks."""
    return {"value": value, "interval": bootstrap.interval(draws, blocks)}


def resampling_of(views: pd.DataFrame) -> bootstrap.Resampling:
    """Return the resamples of views of one config: of whole scenes if it has several."""
    how = views[["by_scene", "views_per_distance"]].iloc[0].to_dict()
    return bootstrap.resample_views(views["view_id"].tolist(), **how)


def view_table(evaluation: Evaluation, config: DatasetConfig, result: Result) -> pd.DataFrame:
    """Return one row per scored view of a config; s and errors of views without prediction are NaN."""
    assert result.extended is not None
    truths = config_truth(evaluation.folder, config)
    frame = result.frames[config.name]
    columns = {
        "config": config.name,
        "by_scene": config.has_splits,
        "views_per_distance": config.views_per_distance,
        "view_id": truths.view_ids,
        "distance_m": [view.distance_m for view in truths.traits],
        "scale": frame["scale"],
        "native_abs_rel": frame["native.abs_rel"],
        "scaled_abs_rel": frame["scaled.abs_rel"],
        "single_bar": [result.extended.views.get(view_id, {}) for view_id in truths.view_ids],
    }
    return pd.DataFrame(columns)


def distance_bins(views: pd.DataFrame, per_decade: int) -> list[dict[str, Any]]:
    """Return the bins of the views of one config, nearest first; edges are 10^(i / per_decade) metres."""
    groups = views.groupby(np.floor(np.log10(views["distance_m"]) * per_decade + 1e-9))
    return [one_bin(of_bin, 10.0 ** (i / per_decade), 10.0 ** ((i + 1) / per_decade)) for i, of_bin in groups]


def one_bin(views: pd.DataFrame, low_m: float, high_m: float) -> dict[str, Any]:
    """Return median and range of s, and mean errors, of the views with a prediction in [low_m, high_m)."""
    resampling, scales, errors = resampling_of(views), views["scale"].dropna(), views[ERRORS].to_numpy()
    medians = resampling.percentile(scales.to_numpy(), scored := np.flatnonzero(views["scale"].notna()), 50)
    blocks, draws = resampling.blocks(scored), resampling.means(errors).T
    return {
        "config": views["config"].iloc[0],
        "low_m": low_m,
        "high_m": high_m,
        "distance_m": views["distance_m"].median(),
        "views": len(views),
        "views_scored": len(scales),
        "scale": estimate(scales.median(), medians, blocks),
        "scale_range": (scales.min(), scales.max()) if len(scales) else None,
        **{name: estimate(mean(errors[scored, k].tolist()), draws[k], blocks) for k, name in enumerate(ERRORS)},
        "single_bar": single_bar_means(views["single_bar"].tolist()),
    }


def scale_slope(name: str, configs: Mapping[str, pd.DataFrame]) -> dict[str, Any]:
    """Return the slope of log s over log distance; the views of each config are resampled separately.

    The value is None with fewer than two views of finite s > 0, or if their distances are similar; the interval
    also if a config has too few blocks of such views, or scenes of them if it has several.
    """
    finite = [views[views["scale"].between(0, math.inf, inclusive="neither")] for views in configs.values()]
    usable = [views for views in finite if len(views)]
    distances_m = np.concatenate([[], *(views["distance_m"] for views in usable)])
    nearest_m, farthest_m = (distances_m.min(), distances_m.max()) if usable else (math.nan, math.nan)
    value, slope_interval = None, None
    if len(distances_m) >= 2 and farthest_m >= MIN_DISTANCE_RATIO * nearest_m:
        moments = [regression_moments(views, math.log(nearest_m * farthest_m) / 2) for views in usable]
        resamplings = [resampling_of(views) for views in usable]
        sums = [one.counts @ one.sums(of_views) for one, of_views in zip(resamplings, moments, strict=True)]
        fewest = min((one.blocks() for one in resamplings), key=lambda one: one.degrees_of_freedom)
        slope_interval = bootstrap.interval(least_squares_slopes(np.sum(sums, axis=0)), fewest)
        value = least_squares_slopes(np.sum([one.sum(axis=0) for one in moments], axis=0)[None]).item()
    row = {"config": name, "views": len(distances_m), "nearest_m": nearest_m, "farthest_m": farthest_m}
    return row | {"slope": {"value": value, "interval": slope_interval}}


def regression_moments(views: pd.DataFrame, center: float) -> Float64[ndarray, "n 5"]:
    """Return the columns 1, x, y, x^2, x y of the views: x = log(distance) - ``center``, y = log(s)."""
    x, y = np.log(views["distance_m"].to_numpy()) - center, np.log(views["scale"].to_numpy())
    return np.stack([np.ones_like(x), x, y, x * x, x * y], axis=1)


def least_squares_slopes(sums: Float64[ndarray, "draws 5"]) -> Float64[ndarray, " draws"]:
    """Return the least-squares slopes from sums of moments, NaN if all views have the same distance."""
    n, x, y, xx, xy = sums.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(n * xx - x * x > 1e-9 * n * n, (n * xy - x * y) / (n * xx - x * x), np.nan)


def draw_figure(figure: Figure, views: pd.DataFrame, bins: pd.DataFrame) -> None:
    """Draw s of views and bins, and native (solid) and scaled (dashed) errors of bins, over distance."""
    scale_axes, error_axes = figure.subplots(1, 2)
    for colour, (config, of_config) in enumerate(bins.groupby("config", sort=False)):
        of_views, x_m = views[views["config"] == config], of_config["distance_m"]
        scale_axes.scatter(of_views["distance_m"], of_views["scale"], 8, f"C{colour}", alpha=0.4)
        scale_axes.plot(x_m, of_config["scale"], f"C{colour}o-", label=config)
        error_axes.plot(x_m, of_config[ERRORS[0]], f"C{colour}o-", x_m, of_config[ERRORS[1]], f"C{colour}o--")
    scale_axes.axhline(1.0, color="black", linestyle="--", linewidth=1)
    scale_axes.legend()
    error_scale = "log" if (bins[ERRORS] > 0).any(axis=None) else "linear"
    scale_axes.set(xscale="log", yscale="log", xlabel="distance, m", ylabel="s = median(z) / median(p)")
    error_axes.set(xscale="log", yscale=error_scale, xlabel="distance, m", ylabel="AbsRel")


def run(options: argparse.Namespace) -> None:
    """Compute slopes and bins, write the requested files and print them."""
    with ProgressBars() as bars, open_evaluation(options.archive, options.data) as evaluation:
        result = score(options.archive, evaluation.folder, extended=True, progress=bars.update)
        present = {config.name: config for config in evaluation.configs}
        names = dict.fromkeys(options.config or present)
        if names.keys() - present.keys():
            raise InputError(f"{options.archive}: holds {', '.join(present)}, expected --config with some of them")
        by_config = {name: view_table(evaluation, present[name], result) for name in names}
        provenance = evaluation.provenance().to_dict() | {"intervals": bootstrap.INTERVALS}
    slopes = [scale_slope(name, {name: of_config}) for name, of_config in by_config.items()]
    slopes += [scale_slope("all", by_config)] if len(by_config) > 1 else []
    bin_rows = [row for one in by_config.values() for row in distance_bins(one, options.bins_per_decade)]
    views, table = pd.concat(by_config.values()), flat_table(bin_rows)
    single_bars = [single_bar_means([one]) for one in views["single_bar"]]
    content = {
        "study": "distance",
        **provenance,
        "bins_per_decade": options.bins_per_decade,
        "slopes": slopes,
        "bins": bin_rows,
        "views": views[VIEW_COLUMNS].assign(single_bar=single_bars).to_dict("records"),
    }
    notes = ["Slope of log s over log distance:", flat_table(slopes).to_string(index=False, na_rep="-")]
    shown = [name for name in table if not name.startswith("single_bar")]
    write_outputs(options, content, table, shown, notes, lambda figure: draw_figure(figure, views, table))


if __name__ == "__main__":
    sys.exit(run_script(argument_parser(), run))
