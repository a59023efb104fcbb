"""Scale over distance on the tiny rendered dataset and for views of known scale: slopes, bins, bad input."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

import distance
from distance import distance_bins, scale_slope
from rebar_depth_bench import score
from rebar_depth_bench.methods import METHODS
from rebar_depth_bench.methods.run import predict
from rebar_depth_bench.scoring.bootstrap import Blocks, half_width
from tests.examples.scripts import refusal, repeated_files, result_of
from tests.synthetic_dataset import write_split_dataset

Depths = dict[str, np.ndarray]
Archive = Callable[..., Path]
SWEEP_M = [0.22 * 7.0 ** (step / 11) for step in range(12) for _ in range(8)]


def table(distances_m: Sequence[float], scales: Sequence[float], step: int = 1) -> pd.DataFrame:
    """Return views of a config at distances in metres, ``step`` views of its protocol apart.

    NaN is the scale of a view without prediction. Views 12 apart are blocks of their own.
    """
    scale = np.array(scales, float)
    return pd.DataFrame(
        {
            "config": "lattice-distance",
            "by_scene": False,
            "views_per_distance": None,
            "view_id": [f"lattice-distance/{step * index:04d}" for index in range(len(scale))],
            "distance_m": np.array(distances_m, float),
            "scale": scale,
            "native_abs_rel": np.abs(1 / scale - 1),
            "scaled_abs_rel": np.abs(1 / scale - 1),
            "single_bar": [{}] * len(scale),
        }
    )


def power_law(slope: float, noise: float, seed: int) -> pd.DataFrame:
    rng = np.random.default_rng(seed)
    return table(SWEEP_M, [0.5 * metres**slope * math.exp(rng.normal(0, noise)) for metres in SWEEP_M])


@pytest.mark.slow
def test_slope_interval_has_nominal_coverage() -> None:
    covered, widths = 0, []
    for seed in range(60):
        low, high = scale_slope("c", {"c": power_law(0.6, 0.2, seed)})["slope"]["interval"]
        covered += low <= 0.6 <= high
        widths.append(high - low)
    assert 53 <= covered <= 60, "95 % of 60 are 57"
    standard_error = 0.2 / (np.std(np.log(SWEEP_M)) * math.sqrt(len(SWEEP_M)))
    assert np.mean(widths) == pytest.approx(2 * half_width(Blocks(8)) * standard_error, rel=0.15)


@given(st.lists(st.tuples(st.floats(0.1, 20.0), st.floats(0.05, 20.0)), min_size=3, max_size=40))
def test_slope_matches_polyfit(pairs: list[tuple[float, float]]) -> None:
    distances_m, scales = np.array(pairs).T
    slope = scale_slope("c", {"c": table(distances_m.tolist(), scales.tolist())})["slope"]["value"]
    x, y = np.log(distances_m), np.log(scales)
    if np.exp(np.ptp(x)) < 1.05 * (1 - 1e-12):
        assert slope is None
    elif np.exp(np.ptp(x)) > 1.06:
        assert slope == pytest.approx(np.polyfit(x, y, 1)[0], rel=1e-6, abs=1e-6)


def test_slope_of_all_configs_uses_all_usable_views() -> None:
    near = table(np.linspace(0.2, 0.4, 12).tolist(), [0.5] * 10 + [math.nan, math.inf], step=12)
    far = table(np.linspace(8.0, 16.0, 10).tolist(), [5.0] * 10, step=12)
    fit = scale_slope("all", {"a": near, "b": far, "c": near[:0]})
    x = np.log([*near["distance_m"][:10], *far["distance_m"]])
    assert (fit["views"], fit["nearest_m"], fit["farthest_m"]) == (20, 0.2, 16.0)
    assert fit["slope"]["value"] == pytest.approx(np.polyfit(x, np.log([0.5] * 10 + [5.0] * 10), 1)[0])
    low, high = fit["slope"]["interval"]
    assert 0 < low <= fit["slope"]["value"] <= high
    assert scale_slope("a", {"a": near[:8]})["slope"]["interval"] == pytest.approx((0, 0), abs=1e-9)
    few = scale_slope("a", {"a": near[:7]})
    assert few["slope"]["value"] == pytest.approx(0, abs=1e-9)
    assert few["slope"]["interval"] is None
    assert scale_slope("c", {"c": near[:0]})["slope"] == {"value": None, "interval": None}


def test_bins_have_fixed_edges_and_the_numbers_of_their_views() -> None:
    scales = [0.5, 0.8, 1.0, 1.25, 2.0, 4.0, 1.0, 1.25, math.nan]
    near, far = distance_bins(table([1.0] * 9 + [10.0], [*scales, 3.0], step=12), 10)
    assert (near["low_m"], near["high_m"]) == (1.0, pytest.approx(10**0.1))
    assert (near["views"], near["views_scored"], near["scale"]["value"]) == (9, 8, 1.125)
    assert near["scale_range"] == (0.5, 4.0)
    errors = [1.0, 0.25, 0.0, 0.2, 0.5, 0.75, 0.0, 0.2]
    assert near["native_abs_rel"]["value"] == pytest.approx(np.mean(errors))
    for name, values in (("scale", [0.5, 4.0]), ("native_abs_rel", errors)):
        low, high = near[name]["interval"]
        assert min(values) <= low < near[name]["value"] < high <= max(values)
    assert (far["low_m"], far["scale"]["interval"]) == (10.0, None)
    [blank] = distance_bins(table([1.0] * 8, [math.nan] * 8), 10)
    assert (blank["views_scored"], blank["scale_range"]) == (0, None)
    assert math.isnan(blank["native_abs_rel"]["value"])


@pytest.mark.parametrize(("power", "slope"), [(0.4, 0.6), (1.0, 0.0)])
def test_known_power_law_of_an_archive_is_recovered(
    power: float, slope: float, tiny_truth: Depths, tiny_root: Path, archive_of: Archive, tmp_path: Path
) -> None:
    """Depths compressed to z^power, with noise and missing parts, need a scale s that grows as z^(1 - power)."""
    rng = np.random.default_rng(3)
    predictions = {}
    for view, z_m in tiny_truth.items():
        p_m = 0.9 * z_m**power * np.exp(rng.normal(0, 0.01)) * (1 + rng.normal(0, 0.05, z_m.shape))
        p_m[rng.random(z_m.shape) < 0.2] = 0
        predictions[view] = p_m.astype(np.float32)
    [fit] = result_of(distance, tmp_path, archive_of(predictions), "--data", tiny_root)["slopes"]
    assert fit["slope"]["value"] == pytest.approx(slope, abs=0.06)
    low, high = fit["slope"]["interval"]
    assert slope - 0.1 < low < fit["slope"]["value"] < high < slope + 0.1


def test_views_have_scores_and_true_distances(
    tiny_truth: Depths, tiny_masks: Depths, tiny_root: Path, archive_of: Archive, tmp_path: Path
) -> None:
    archive = archive_of({view: 1.3 * z_m + 0.01 for view, z_m in tiny_truth.items()})
    study = result_of(distance, tmp_path, archive, "--data", tiny_root, "--bins-per-decade", "1")
    result = json.loads(score(archive, tiny_root).to_json())
    for view, scored in zip(study["views"], result["views"], strict=True):
        assert (view["view_id"], view["scale"]) == (scored["view_id"], scored["scale"])
        assert view["native_abs_rel"] == scored["native"]["abs_rel"]
        steel_m = tiny_truth[view["view_id"]][tiny_masks[view["view_id"]]]
        assert steel_m.min() < view["distance_m"] < steel_m.max()
    [one_bin] = study["bins"]
    whole = result["tables"]["lattice"]
    assert one_bin["views"] == whole["views"]
    assert one_bin["native_abs_rel"]["value"] == pytest.approx(whole["native"]["abs_rel"], rel=1e-12)
    assert one_bin["scale"]["value"] == whole["scale_median"]


@pytest.mark.slow
def test_whole_scenes_are_resampled(tmp_path: Path) -> None:
    """The six views of a split are enough for an interval, its two scenes are not."""
    root = tmp_path / "dataset"
    write_split_dataset(root, {"a": "train", "b": "train", "c": "test"}, 3)
    predict(METHODS["truth"], root, tmp_path / "a.zip", split="train")
    study = result_of(distance, tmp_path, tmp_path / "a.zip", "--data", root, "--bins-per-decade", "1")
    [fit], [one_bin] = study["slopes"], study["bins"]
    assert (fit["views"], one_bin["views_scored"]) == (6, 6)
    assert fit["slope"]["interval"] is one_bin["scale"]["interval"] is None


@pytest.mark.slow
def test_outputs_are_deterministic_and_configs_keep_their_order(
    tiny_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    predict(METHODS["truth"], tiny_root, tmp_path / "truth.zip")
    arguments = (tmp_path / "truth.zip", "--data", tiny_root, "--config", "lattice-orbit", "lattice")
    files = repeated_files(distance, tmp_path, *arguments)
    slopes = json.loads(files["json"])["slopes"]
    assert [slope["config"] for slope in slopes] == ["lattice-orbit", "lattice", "all"]
    assert files["csv"].startswith(b"config,low_m,high_m,distance_m,views,views_scored,scale_range_low")
    message = refusal(distance, capsys, *arguments, "pier")
    assert "holds lattice, lattice-orbit, expected --config with some of them" in message
