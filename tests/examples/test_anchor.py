"""Figure 3 on the tiny rendered dataset: known scales, consistency with the scorer, draws, bad input."""

from __future__ import annotations

import itertools
import json
import math
import statistics
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import anchor
from anchor import Pixels, draw_fits, errors_at_scales, picture_fits, spacing_slope, spread
from rebar_depth_bench import SubmissionWriter, score
from rebar_depth_bench.base.errors import SubmissionError
from tests.examples.scripts import refusal, repeated_files, result_of, run

Depths = dict[str, np.ndarray]
Archive = Callable[..., Path]
TRUE_SCALE = 1.7


@pytest.fixture
def noisy(tiny_truth: Depths) -> Depths:
    """Return predictions that need ``TRUE_SCALE``, with 1 % noise per view, 3 % per pixel and a tenth missing."""
    rng = np.random.default_rng(7)
    predictions = {}
    for view, depth_m in tiny_truth.items():
        p_m = depth_m / TRUE_SCALE * np.exp(rng.normal(0, 0.01)) * (1 + rng.normal(0, 0.03, depth_m.shape))
        p_m[rng.random(depth_m.shape) < 0.1] = np.nan
        predictions[view] = p_m.astype(np.float32)
    return predictions


def test_known_scale_is_recovered(noisy: Depths, tiny_root: Path, archive_of: Archive, tmp_path: Path) -> None:
    counts = ("--num-anchor-views", "1", "2", "3", "5", "9")
    options = (archive_of(noisy), "--data", tiny_root, "--baseline-scale", str(TRUE_SCALE), *counts)
    study = result_of(anchor, tmp_path, *options)
    for row in study["rows"][:4]:
        assert row["scale"]["low"] <= TRUE_SCALE <= row["scale"]["high"]
        assert row["deviation_percent"]["low"] <= 0 <= row["deviation_percent"]["high"]
    deviations = [row["scale"]["sd"] for row in study["rows"]]
    assert deviations[0] > 2 * deviations[3], "more views, less spread"
    all_views = study["rows"][-1]["scale"]
    assert all_views["low"] == all_views["high"] == study["all_views"]["scale"]
    assert all_views["mean"] == pytest.approx(TRUE_SCALE, rel=0.01)
    assert study["coverage"] == pytest.approx(0.9, abs=0.02)
    assert study["markers"] == 6


def test_errors_match_score_of_scaled_archive(
    noisy: Depths, tiny_root: Path, archive_of: Archive, tmp_path: Path
) -> None:
    """Write the archive again in float32, multiplied by a drawn scale, and score it with the protocol's scorer."""
    options = ("--data", tiny_root, "--num-anchor-views", "1", "3", "--draws", "2")
    study = result_of(anchor, tmp_path, archive_of(noisy), *options)
    for row in study["rows"]:
        scales = [draw["scale"] for draw in row["draws"]]
        found = [row["scale"][name] for name in ("mean", "sd", "low", "high")]
        expected = [statistics.fmean(scales), statistics.stdev(scales), min(scales), max(scales)]
        assert found == pytest.approx(expected, rel=1e-7)
    for scaled in (study["given"], study["all_views"], *study["rows"][0]["draws"], study["rows"][1]["draws"][0]):
        depths_m = {view: scaled["scale"] * depth_m.astype(np.float64) for view, depth_m in noisy.items()}
        table = score(archive_of(depths_m, "scaled.zip"), tiny_root).tables["lattice"]
        errors = table["native.abs_rel"], table["native.rmse_cm"]
        assert (scaled["abs_rel"], scaled["rmse_cm"]) == pytest.approx(errors, rel=1e-7)


def test_views_without_prediction_are_excluded(
    noisy: Depths, tiny_root: Path, archive_of: Archive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    blank = sorted(noisy)[2]
    archive = archive_of({**noisy, blank: np.zeros_like(noisy[blank])})
    study = result_of(anchor, tmp_path, archive, "--data", tiny_root, "--num-anchor-views", "1", "8", "9", "50")
    assert study["views_without_prediction"] == [blank]
    assert [row["k"] for row in study["rows"]] == [1, 8]
    assert study["left_out_k"] == [9, 50]
    table = score(archive, tiny_root).tables["lattice"]
    assert study["given"]["abs_rel"] == pytest.approx(table["native.abs_rel"], rel=1e-9)
    assert "without prediction: 1 of 9 views" in capsys.readouterr().out
    nothing = archive_of({view: -depth_m for view, depth_m in noisy.items()}, "nothing.zip")
    message = refusal(anchor, capsys, nothing, "--data", tiny_root, "--num-anchor-views", "2", "3")
    assert "0 of 9 views of lattice have a prediction, expected at least 2" in message


def test_bad_archive_is_refused_as_by_score(
    noisy: Depths, tiny_root: Path, archive_of: Archive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = tmp_path / "bad.zip"
    with zipfile.ZipFile(archive_of(noisy)) as source, zipfile.ZipFile(bad, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            target.writestr(name, content[:-7] if name.endswith(("0.npy", "5.npy")) else content)
    for archive in (bad, tmp_path / "none.zip"):
        with pytest.raises(SubmissionError) as by_score:
            score(archive, tiny_root)
        assert refusal(anchor, capsys, archive, "--data", tiny_root).endswith(f"error: {by_score.value}\n")


def write_lines(truth: Depths, kind: str, path: Path) -> Path:
    """Write predictions that are exact up to a scale, and for affine kinds a shift, of each view."""
    rng = np.random.default_rng(11)
    with SubmissionWriter(path, method="test", prediction=kind) as writer:
        for view_id, depth_m in truth.items():
            scale, shift = rng.uniform(0.5, 2.0), rng.uniform(-0.2, 0.2)
            surface = np.where(depth_m > 0, depth_m, np.nan).astype(np.float64)
            y = 1 / surface if kind == "affine-disparity" else surface
            writer.add(view_id, (y - shift * kind.startswith("affine")) / scale)
    return path


@pytest.mark.parametrize("kind", ["metric", "scale", "affine-depth", "affine-disparity"])
def test_reading_and_spacing_in_each_picture_recover_its_scale_and_shift(
    kind: str, tiny_truth: Depths, tiny_root: Path, tmp_path: Path
) -> None:
    archive = write_lines(tiny_truth, kind, tmp_path / "a.zip")
    study = result_of(anchor, tmp_path, archive, "--data", tiny_root, "--num-anchor-views", "1", "9")
    rows = {row["anchor"]: row for row in study["per_picture"]}
    assert {row["k"] for row in rows.values()} == {9}
    found = {name: [draw["abs_rel"] for draw in row["draws"]] for name, row in rows.items()}
    assert study["rows"][0]["draws"][0]["abs_rel"] > 0.1, "one view does not know the scale of another"
    if kind.startswith("affine"):
        assert list(rows) == ["reading+spacing", "two readings"]
        aligned = score(archive, tiny_root).tables["lattice"]
        given = study["given"]["abs_rel"], study["given"]["rmse_cm"]
        assert given == pytest.approx((aligned["aligned.abs_rel"], aligned["aligned.rmse_cm"]), rel=1e-3)
        assert max(found["two readings"]) < 1e-6
        # Two slopes can give a spacing its length.
        assert np.median(found["reading+spacing"]) < 1e-6
    else:
        assert list(rows) == ["reading", "spacing", "reading+spacing"]
        assert max(map(max, found.values())) < 1e-6
        given_scale = study["all_views"]["scale"] if kind == "scale" else 1.0
        assert study["given"]["scale"] == given_scale


@pytest.mark.parametrize("kind", ["affine-depth", "affine-disparity"])
def test_line_through_reading_gives_the_spacing_its_length(kind: str) -> None:
    rng = np.random.default_rng(4)
    solved = 0
    for _ in range(100):
        x, y, length_m = rng.uniform(-0.2, 0.2, 2), rng.uniform(0.8, 1.2), rng.uniform(0.05, 0.5)
        rays = np.column_stack([rng.uniform(-0.5, 0.5, (2, 2)), np.ones(2)])
        slope = spacing_slope(x, y, rays, length_m, kind)
        if slope > 0:
            values = y + slope * x
            first, second = (1 / values if kind == "affine-disparity" else values)[:, None] * rays
            assert math.dist(first, second) == pytest.approx(length_m, rel=1e-9)
            solved += 1
    assert solved > 15


def test_scale_of_a_picture_is_that_of_its_reading_and_spacing() -> None:
    x, z_m = np.array([0.5, 0.8, 1.1, 2.0]), np.array([1.0, 1.7, 2.0, 4.1])
    rays = np.array([[0.0, 0.0, 1.0], [0.3, 0.0, 1.0], [0.0, 0.4, 1.0], [0.1, 0.1, 1.0]])
    by_reading, by_spacing, both = picture_fits(Pixels(x, z_m, rays), "metric", 1.2, 1.0, [2, 4])
    # Reading at pixel 2; the point whose distance to that of pixel 0 is nearest to 1.2 m is that of pixel 2.
    true_m, predicted = math.hypot(0.8, 1.0), math.hypot(0.44, 0.6)
    assert by_reading == (2.0 / 1.1, 0.0)
    assert by_spacing == pytest.approx((true_m / predicted, 0.0))
    assert both == pytest.approx(((2.0 / 1.1 + true_m / predicted) / 2, 0.0))
    one = Pixels(x[:1], z_m[:1], rays[:1])
    assert picture_fits(one, "metric", 1.2, 7.0, [5, 6])[1] == (7.0, 0.0)
    assert picture_fits(one, "affine-disparity", 1.2, 7.0, [5, 6]) == [(0.0, 1.0)] * 2


def test_given_scale_of_affine_predictions_is_refused(
    tiny_truth: Depths, tiny_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    archive = write_lines(tiny_truth, "affine-depth", tmp_path / "a.zip")
    message = refusal(anchor, capsys, archive, "--data", tiny_root, "--baseline-scale", "2")
    assert "--baseline-scale is given, but the predictions are of the kind affine-depth" in message


def test_constant_predictions_of_affine_kinds_have_no_scale(
    tiny_truth: Depths, tiny_root: Path, tmp_path: Path
) -> None:
    with SubmissionWriter(tmp_path / "a.zip", method="test", prediction="affine-depth") as writer:
        for view_id, depth_m in tiny_truth.items():
            writer.add(view_id, np.full_like(depth_m, -3.0))
    study = result_of(anchor, tmp_path, tmp_path / "a.zip", "--data", tiny_root, "--num-anchor-views", "1")
    assert study["given"]["scale"] == study["per_picture"][0]["scale"]["mean"] == 0
    assert study["per_picture"][0]["deviation_percent"]["mean"] is None
    assert 0 < study["given"]["abs_rel"] < study["per_picture"][0]["draws"][0]["abs_rel"]


def test_archive_of_several_configs_needs_config_option(
    tiny_truth: Depths, tiny_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    archive = tmp_path / "both.zip"
    shape = next(iter(tiny_truth.values())).shape
    manifest = json.loads((tiny_root / "manifest.json").read_text())
    with SubmissionWriter(archive, method="test") as writer:
        for config in manifest["configs"].values():
            for view in config["views"]:
                writer.add(view["view_id"], np.ones(shape, np.float32))
    for wanted in ((), ("--config", "pier")):
        message = refusal(anchor, capsys, archive, "--data", tiny_root, *wanted)
        assert "holds lattice, lattice-orbit, expected --config with one of them" in message
    options = ("--config", "lattice-orbit", "--num-anchor-views", "1")
    assert result_of(anchor, tmp_path, archive, "--data", tiny_root, *options)["views"] == 2


@pytest.mark.parametrize(
    "option",
    [
        ("--baseline-scale", "0"),
        ("--num-anchor-views", "0"),
        ("--draws", "0"),
        ("--seed", "-1"),
        ("--spacing", "0"),
    ],
)
def test_numbers_out_of_range_are_refused(
    option: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        run(anchor, tmp_path / "a.zip", "--data", tmp_path, *option)
    assert caught.value.code == 2
    assert f"argument {option[0]}: {option[1]} is not a number from" in capsys.readouterr().err


@pytest.mark.slow
def test_outputs_are_deterministic_and_inputs_are_kept(
    noisy: Depths, tiny_root: Path, archive_of: Archive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    archive = archive_of(noisy)
    arguments = (archive, "--data", tiny_root, "--num-anchor-views", "1", "5")
    files = repeated_files(anchor, tmp_path, *arguments)
    assert files["png"].startswith(b"\x89PNG")
    content = json.loads(files["json"])
    assert [len(row["draws"]) for row in content["rows"]] == [24, 24]
    manifest = json.loads((tiny_root / "manifest.json").read_text())
    assert content["dataset"]["digest"] == manifest["ground_truth"]["digest"]
    header, first, *others = files["csv"].decode().splitlines()
    assert len(others) == 1 + 3
    row = dict(zip(header.split(","), first.split(","), strict=True))
    assert float(row["scale_mean"]) == content["rows"][0]["scale"]["mean"]
    assert "Paper, Sec. III.C" in capsys.readouterr().out
    for name in ("figure.svg", "figure.pdf"):
        contents = []
        for _ in range(2):
            assert run(anchor, *arguments, "--figure", tmp_path / name) == 0
            contents.append((tmp_path / name).read_bytes())
        assert contents[0] == contents[1]
    before = archive.read_bytes()
    for option, target in (("--json", archive), ("--figure", tmp_path / "a.gif")):
        assert run(anchor, *arguments, option, target) == 2
    assert archive.read_bytes() == before


def test_overflowing_errors_are_infinite_without_warning() -> None:
    errors = errors_at_scales(np.array([1e200, 1.0]), np.array([1.0, 1.0]), np.array([1.0, 2.0]))
    assert np.isinf(errors[1]).all()
    assert math.isnan(spread([1.0, math.inf])["mean"] or 0.0)


def test_views_are_drawn_without_replacement_by_seed_and_k() -> None:
    ratios = 2.0 ** np.arange(5)
    possible = {float(np.median(three)) for three in itertools.combinations(ratios, 3)}
    assert set(draw_fits(ratios, 3, 300, 0).tolist()) == possible == {2.0, 4.0, 8.0}
    assert set(draw_fits(ratios, 5, 50, 0).tolist()) == {4.0}
    first = draw_fits(ratios, 3, 24, 0).tolist()
    assert draw_fits(ratios, 3, 12, 0).tolist() == first[:12]
    assert draw_fits(ratios, 3, 24, 1).tolist() != first


def test_views_are_drawn_uniformly() -> None:
    draws = 6000
    values, counts = np.unique(draw_fits(np.arange(1.0, 7.0), 1, draws, 3), return_counts=True)
    assert values.tolist() == [1, 2, 3, 4, 5, 6]
    expected = draws / 6
    assert np.sum((counts - expected) ** 2 / expected) < 20.5  # Chi-square, 5 degrees of freedom: p = 0.001.
