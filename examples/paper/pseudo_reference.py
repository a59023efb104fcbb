"""Scores of methods on the full frame against pseudo-references: Table II of the paper.

    python examples/paper/pseudo_reference.py depth-pro.zip --reference stereo.zip mvs.zip --data CAPTURE

Pixels are scored where the reference and the prediction are finite, > 0 and within ``--near`` and ``--far``. For a
dataset folder, methods are also scored against the exact depth: on its own pixels, and on those of each reference,
which separates what changes: the pixels or the depth. Ratios and rankings are relative to the first reference.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from numpy import ndarray
from scipy.stats import kendalltau

from depth_maps import DepthMaps, labelled, masked, open_data
from outputs import add_outputs, flat_table, number, plain_name, run_script, write_outputs
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.base.parallel import map_in_threads
from rebar_depth_bench.base.terminal import ProgressBars
from rebar_depth_bench.cli.console import InputFolder, add_data, add_workers
from rebar_depth_bench.scoring.bootstrap import INTERVALS
from rebar_depth_bench.scoring.columns import METRICS, rounded
from rebar_depth_bench.scoring.evaluation import Provenance
from rebar_depth_bench.scoring.metrics import mean
from rebar_depth_bench.scoring.result import SubmissionIdentity
from rebar_depth_bench.scoring.table import Frame, Truth, tabulate
from rebar_depth_bench.scoring.view_numbers import ViewTruth, view_numbers

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PROTOCOL = "rebar-pseudo-reference-1"
EXACT = "exact"
PUBLISHED = """\
Paper, Table II: RMSE (cm), AbsRel, AbsRel_s, s against FoundationStereo (80.3 % of the frame) and COLMAP (44.4 %)
Depth Anything 3 Metric  31.6  0.62  0.201  0.64    57.2  0.95  0.265  0.54
Depth Pro                42.8  0.90  0.185  0.61    59.7  0.98  0.231  0.60
UniDepth v2              45.8  0.98  0.152  0.56    63.4  1.07  0.186  0.56
Metric3D v2              58.7  1.40  0.253  0.49    72.0  1.54  0.328  0.49"""
OVER_VIEWS = {"views": "sum", "common_share": "mean", "abs_rel": "mean", "median_ratio": "median"}
DepthMap = Float[ndarray, "h w"]
Numbers = Mapping[str, float]
"""Numbers of a view by place."""
Pair = tuple[str, str]
PAIR = ["reference", "against"]


def argument_parser() -> argparse.ArgumentParser:
    """Return the parser of the script's arguments."""
    parser = argparse.ArgumentParser(description="score methods on the full frame against pseudo-references")
    maps = "archives, or folders of <view_id>.npy|npz|exr|png"
    parser.add_argument("methods", type=InputFolder, nargs="+", metavar="METHOD", help=maps)
    parser.add_argument("--reference", type=InputFolder, nargs="+", required=True, metavar="DEPTH", help=maps)
    add_data(parser, "dataset folder, Hub repository or capture")
    parser.add_argument("--config", metavar="NAME", help="config of a dataset folder (default: its only one)")
    for option, default in (("--near", 0.1), ("--far", 20.0)):
        limit = f"{option[2:]}est depth scored, m (default: {default:g})"
        parser.add_argument(option, type=number(float, 0), default=default, metavar="M", help=limit)
    parser.add_argument("--no-exact", action="store_true", help="do not compare with the exact depth of a dataset")
    add_workers(parser)
    add_outputs(parser)
    return parser


def agreement(pair: Pair, first_m: DepthMap, other_m: DepthMap) -> dict[str, Any]:
    """Return how much of the frame has depth in both references, and there mean |a - b| / b and median a / b."""
    common = ~np.isnan(first_m) & ~np.isnan(other_m)
    with np.errstate(over="ignore", under="ignore"):
        ratio = first_m[common].astype(np.float64) / other_m[common].astype(np.float64)
    errors = (np.mean(np.abs(ratio - 1)), np.median(ratio)) if len(ratio) else (math.nan, math.nan)
    return dict(zip((*PAIR, *OVER_VIEWS), (*pair, len(ratio) > 0, len(ratio) / common.size, *errors), strict=True))


def score_frame(
    frame: tuple[str, DepthMap | None],
    methods: Mapping[str, DepthMaps],
    references: Mapping[str, DepthMaps],
    clip: Callable[[DepthMap], DepthMap],
    shape: tuple[int, int],
) -> tuple[dict[str, float], dict[Pair, Numbers | None], list[dict[str, Any]]]:
    """Return shares of the frame with depth, scores by (method, reference), and agreements of two references.

    ``frame`` is a view id with its exact depth, if that is compared; ``clip`` sets invalid depth to NaN.
    """
    view_id, exact_m = frame

    def read(source: DepthMaps) -> DepthMap:
        return clip(source.read(view_id) if view_id in source.view_ids else np.zeros(shape, np.float32))

    predictions, pseudo = ({name: read(one) for name, one in maps.items()} for maps in (methods, references))
    exact = {} if exact_m is None else {EXACT: clip(exact_m)}
    maps = pseudo | exact
    agreements = [agreement((a, b), maps[a], maps[b]) for a in maps for b in maps if a not in (b, EXACT)]
    for label, pseudo_m in pseudo.items() if exact else ():
        maps[f"{EXACT} where {label} has depth"] = np.where(np.isnan(pseudo_m), np.nan, exact[EXACT])
    scores: dict[Pair, Numbers | None] = {}
    for name, reference_m in maps.items():
        index = np.flatnonzero(~np.isnan(reference_m)).astype(np.uint32)
        z_m = reference_m.ravel()[index].astype(np.float64)
        truth = ViewTruth(view_id, index, z_m, float(np.median(z_m))) if len(index) else None
        scores |= {(method, name): view_numbers(p, truth) if truth else None for method, p in predictions.items()}
    return {name: float((~np.isnan(one)).mean()) for name, one in maps.items()}, scores, agreements


def row_json(pair: Pair, views: Mapping[str, Numbers | None], frame_px: int, split: str | None) -> dict[str, Any]:
    """Return the row of a method against a reference, with the numbers of a table in the JSON of ``score``."""
    scored = {view_id: numbers for view_id, numbers in views.items() if numbers is not None}
    frame = Frame.of_rows(scored)
    table = tabulate(frame, Truth(tuple(scored), (), (), split=split))
    return {
        "method": pair[0],
        "reference": pair[1],
        "frame_share": mean(
            [one["coverage"] * one["scored_px"] / frame_px if one else 0.0 for one in views.values()]
        ),
        "ratio": {},
        "views": table.views,
        "views_scored": table.views_scored,
        "coverage": table["coverage"],
        "ranked": table.is_comparable,
        **{key: {name: rounded(table[f"{key}.{name}"]) for name in METRICS} for key in ("native", "scaled")},
        "scale_median": rounded(table["scale_median"]),
        "ci95": {name: ends for name, ends in table.intervals.items() if not name.startswith("within_mm")},
    }


def rankings(rows: list[dict[str, Any]], names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Set the ratios of the rows to the first reference; return ranking and Kendall's tau to its by reference."""
    found: dict[str, dict[str, Any]] = {name: {} for name in names}
    for alignment in ("native", "scaled"):
        error = {(row["method"], row["reference"]): row[alignment]["abs_rel"] for row in rows}
        for row in rows:
            this, base = error[row["method"], row["reference"]], error[row["method"], names[0]]
            row["ratio"][alignment] = this / base if base and this is not None else None
        for name in names:
            ranked = [row["method"] for row in rows if row["reference"] == name and row["ranked"]]
            order = sorted(ranked, key=lambda method: error[method, name])
            first = found[names[0]].get(alignment, {"order": order})["order"]
            places = [order.index(method) for method in first if method in order]
            tau = kendalltau(range(len(places)), places).statistic if len(places) > 1 else None
            found[name][alignment] = {"order": order, "tau": tau}
    return found


def draw_figure(figure: Figure, rows: pd.DataFrame) -> None:
    """Draw native and scaled AbsRel of each method, in one colour for each reference."""
    for axes, name in zip(figure.subplots(1, 2), ("native", "scaled"), strict=True):
        table = rows.map(plain_name).pivot(index="method", columns="reference", values=f"{name}_abs_rel")
        table.plot.bar(ax=axes, ylabel=f"AbsRel, {name}", xlabel="", rot=20, legend=name == "native")


def run(options: argparse.Namespace) -> None:
    """Score all views, write the requested files and print the rows."""
    data = open_data(options.data, options.config)
    clip = partial(masked, near_m=options.near, far_m=options.far)
    with ExitStack() as stack, ProgressBars() as bars:
        opened = [stack.enter_context(data.open_maps(path)) for path in options.methods + options.reference]
        data = data.of_split(opened)
        sources, count = labelled(opened, EXACT), len(options.methods)
        methods, references = dict([*sources.items()][:count]), dict([*sources.items()][count:])
        work = partial(score_frame, methods=methods, references=references, clip=clip, shape=data.shape)
        frames = data.frames(exact=not options.no_exact)
        outcomes = list(
            map_in_threads(work, frames, len(data.views), "scoring", workers=options.workers, progress=bars.update)
        )
    shares = {name: [share[name] for share, *_ in outcomes] for name in outcomes[0][0]}
    if empty := [name for name, values in shares.items() if not any(values)]:
        raise InputError(f"{', '.join(empty)}: no depth from {options.near:g} to {options.far:g} m, expected some")
    split = data.config.scenes[0].split if data.config and data.config.has_splits else None
    by_pair = {
        pair: {view_id: scores[pair] for view_id, (_, scores, _) in zip(data.views, outcomes, strict=True)}
        for pair in outcomes[0][1]
    }
    rows = [row_json(pair, views, math.prod(data.shape), split) for pair, views in by_pair.items()]
    agreed = pd.DataFrame([row for *_, rows in outcomes for row in rows], columns=[*PAIR, *OVER_VIEWS])
    archives = [SubmissionIdentity(name, source.sha256) for name, source in sources.items()]
    content = {
        **Provenance(PROTOCOL, data.dataset, archives).to_dict(),
        "intervals": INTERVALS,
        "data": data.name,
        "camera": data.camera,
        "range_m": [options.near, options.far],
        "references": [
            {"name": name, "exact": name not in references, "views": len(values)}
            | {"views_with": np.count_nonzero(values), "frame_share": mean(values)}
            for name, values in shares.items()
        ],
        "rows": rows,
        "rankings": rankings(rows, list(shares)),
        "agreement": agreed.groupby(PAIR, sort=False, as_index=False).agg(OVER_VIEWS).to_dict("records"),
    }
    table = flat_table([{key: value for key, value in row.items() if key != "ci95"} for row in rows])
    ranked = [(name, key, one) for name, of_one in content["rankings"].items() for key, one in of_one.items()]
    notes = [f"{name}, {key}: {' < '.join(one['order'])}, tau {one['tau']}" for name, key, one in ranked]
    write_outputs(options, content, table, list(table), [*notes, PUBLISHED], partial(draw_figure, rows=table))


if __name__ == "__main__":
    sys.exit(run_script(argument_parser(), run))
