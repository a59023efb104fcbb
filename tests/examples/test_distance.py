"""``study distance`` on the tiny rendered dataset: known slopes, consistency with the scorer, bad input."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rebar_depth_bench.studies.distance.command import run_distance_study
from rebar_depth_bench.studies.distance.output import to_page

from rebar_depth_bench.errors import InputError
from rebar_depth_bench.methods import METHODS
from rebar_depth_bench.methods.runner import predict
from rebar_depth_bench.scoring.score import score
from tests.bench.studies.commands import run_study_command

Depths = dict[str, np.ndarray]
Archive = Callable[..., Path]


def test_known_power_law_is_recovered(tiny_truth: Depths, tiny_root: Path, archive_of: Archive) -> None:
    """Depths compressed to z^0.4, with noise and missing parts, need a scale s that grows as z^0.6.

    The coverage of the intervals is measured over many simulated submissions in ``test_distances``.
    """
    rng = np.random.default_rng(3)
    predictions = {}
    for view, z_m in tiny_truth.items():
        p_m = 0.9 * z_m**0.4 * np.exp(rng.normal(0, 0.01)) * (1 + rng.normal(0, 0.05, z_m.shape))
        p_m[rng.random(z_m.shape) < 0.2] = 0
        predictions[view] = p_m.astype(np.float32)
    study = run_distance_study(archive_of(predictions), tiny_root)
    [slope] = study.slopes
    assert slope.slope.value == pytest.approx(0.6, abs=0.06)
    assert slope.slope.value is not None
    assert slope.slope.interval is not None
    assert 0.5 < slope.slope.interval[0] < slope.slope.value < slope.slope.interval[1] < 0.7
    assert "doubling the distance" in to_page(study).lead


def test_constant_scale_has_zero_slope(tiny_truth: Depths, tiny_root: Path, archive_of: Archive) -> None:
    rng = np.random.default_rng(4)
    predictions = {view: z_m / 1.7 * np.exp(rng.normal(0, 0.02)) for view, z_m in tiny_truth.items()}
    study = run_distance_study(archive_of(predictions), tiny_root)
    [slope] = study.slopes
    assert slope.slope.interval is not None
    assert slope.slope.interval[0] < 0 < slope.slope.interval[1]
    assert "consistent with one scale for all distances" in to_page(study).lead


def test_points_have_scores_and_true_distances_of_views(
    tiny_truth: Depths, tiny_masks: Depths, tiny_root: Path, archive_of: Archive
) -> None:
    archive = archive_of({view: 1.3 * z_m + 0.01 for view, z_m in tiny_truth.items()})
    study = run_distance_study(archive, tiny_root, bins_per_decade=1)
    result = score(archive, tiny_root)
    assert [point.score for point in study.points] == list(result.views)
    for point in study.points:
        view = point.score.view_id
        steel_m = tiny_truth[view][tiny_masks[view]]
        assert steel_m.min() < point.distance_m < steel_m.max()
        assert point.index == int(view[-4:])
    assert sum(distance_bin.views for distance_bin in study.bins) == result.tables["lattice"].views
    native = result.tables["lattice"].native
    assert native is not None
    assert len(study.bins) == 1
    assert study.bins[0].native_abs_rel.value == pytest.approx(native.abs_rel, rel=1e-12)
    assert study.bins[0].scale.value == result.tables["lattice"].scale_median


def test_configs_keep_the_order_of_the_user(tiny_root: Path, tmp_path: Path) -> None:
    wanted = ["lattice-orbit", "lattice"]
    predict(METHODS["truth"], tiny_root, tmp_path / "truth.zip")
    study = run_distance_study(tmp_path / "truth.zip", tiny_root, configs=wanted)
    assert list(dict.fromkeys(point.config for point in study.points)) == wanted


def test_unknown_config_or_bin_count_raises(tiny_truth: Depths, tiny_root: Path, archive_of: Archive) -> None:
    archive = archive_of(tiny_truth)
    with pytest.raises(InputError, match="has no config 'pier', expected some of lattice"):
        run_distance_study(archive, tiny_root, configs=["lattice", "pier"])
    with pytest.raises(InputError, match="--bins-per-decade is 0, expected 1 to 100"):
        run_distance_study(archive, tiny_root, bins_per_decade=0)


def test_command_output_is_deterministic(
    tiny_truth: Depths, tiny_root: Path, archive_of: Archive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    blank = sorted(tiny_truth)[0]
    archive = archive_of({**tiny_truth, blank: np.zeros_like(tiny_truth[blank])})
    for folder in ("one", "two"):
        files = [f"--{kind}={tmp_path / folder / f'study.{kind}'}" for kind in ("json", "csv", "html")]
        assert run_study_command("distance", archive, "--data", tiny_root, "--config", "lattice", *files) == 0
    for name in ("study.json", "study.csv", "study.html"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()
    content = json.loads((tmp_path / "one/study.json").read_text())
    assert len(content["views"]) == 9
    assert [view["view_id"] for view in content["views"] if view["scale"] is None] == [blank]
    assert content["slopes"][0]["slope"]["value"] == 0.0
    printed = capsys.readouterr()
    assert "1 of 9 views have no prediction" in printed.out
    assert run_study_command("distance", tmp_path / "none.zip", "--data", tiny_root) == 2
