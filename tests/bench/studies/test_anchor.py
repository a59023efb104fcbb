"""``study anchor`` on the tiny rendered dataset: known scales, consistency with the scorer, bad input."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rebar_depth_bench.studies.registry import STUDIES
from rebar_depth_bench.studies.scale_anchor.command import run_anchor_study
from rebar_depth_bench.studies.scale_anchor.output import to_page

from rebar_depth_bench.errors import InputError, SubmissionError
from rebar_depth_bench.scoring.score import score
from rebar_depth_bench.submission import SubmissionWriter
from tests.bench.studies.commands import run_study_command

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


def test_known_scale_is_recovered(noisy: Depths, tiny_root: Path, archive_of: Archive) -> None:
    study = run_anchor_study(archive_of(noisy), tiny_root, given_scale=TRUE_SCALE, counts=(1, 2, 3, 5, 9))
    for row in study.rows[:4]:
        assert row.scale.low <= TRUE_SCALE <= row.scale.high
        assert row.deviation_percent.low <= 0 <= row.deviation_percent.high
    assert study.rows[0].scale.sd is not None
    assert study.rows[0].scale.sd > 2 * (study.rows[3].scale.sd or 0), "more views, less spread"
    all_views_row = study.rows[-1]
    assert all_views_row.scale.low == all_views_row.scale.high == study.all_views.scale
    assert all_views_row.scale.mean == pytest.approx(TRUE_SCALE, rel=0.01)
    assert study.coverage == pytest.approx(0.9, abs=0.02)


def test_study_errors_match_score_of_scaled_archive(noisy: Depths, tiny_root: Path, archive_of: Archive) -> None:
    """Write the archive again in float32, multiplied by a drawn scale, and score it with the protocol's scorer."""
    study = run_anchor_study(archive_of(noisy), tiny_root, counts=(1, 3), draws=2)
    for scaled_archive in (study.given, study.all_views, *study.draws[0], study.draws[1][0]):
        depths_m = {view: scaled_archive.scale * depth_m.astype(np.float64) for view, depth_m in noisy.items()}
        table = score(archive_of(depths_m, "scaled.zip"), tiny_root).tables["lattice"]
        assert table.native is not None
        assert (scaled_archive.abs_rel, scaled_archive.rmse_cm) == pytest.approx(
            (table.native.abs_rel, table.native.rmse_cm), rel=1e-7
        )


def test_study_is_invariant_to_unit_of_archive(noisy: Depths, tiny_root: Path, archive_of: Archive) -> None:
    study = run_anchor_study(archive_of(noisy), tiny_root, counts=(1, 4), draws=5)
    other_archive = archive_of({view: 1024 * depth_m for view, depth_m in noisy.items()}, "other.zip")
    other_study = run_anchor_study(other_archive, tiny_root, counts=(1, 4), draws=5)
    for draws, other_draws in zip(study.draws, other_study.draws, strict=True):
        assert [draw.scale / 1024 for draw in draws] == [draw.scale for draw in other_draws]
        assert [draw.abs_rel for draw in draws] == pytest.approx([draw.abs_rel for draw in other_draws], rel=1e-9)


def test_views_without_prediction_are_excluded(noisy: Depths, tiny_root: Path, archive_of: Archive) -> None:
    blank = sorted(noisy)[2]
    study = run_anchor_study(
        archive_of({**noisy, blank: np.zeros_like(noisy[blank])}), tiny_root, counts=(1, 8, 9, 50)
    )
    assert study.views_without_prediction == (blank,)
    assert [row.k for row in study.rows] == [1, 8]
    assert study.skipped_counts == (9, 50)
    notes = " ".join(to_page(study).notes)
    assert "1 of 9 views have no prediction: they are neither drawn nor scored." in notes
    assert "Skipped: k = 9, 50, more than the 8 views to draw from." in notes
    nothing = archive_of({view: -depth_m for view, depth_m in noisy.items()}, "nothing.zip")
    with pytest.raises(InputError, match="0 of 9 views of lattice have a prediction, expected at least 2"):
        run_anchor_study(nothing, tiny_root, counts=(2, 3))


def test_bad_archive_raises_same_problems_as_score(
    noisy: Depths, tiny_root: Path, archive_of: Archive, tmp_path: Path
) -> None:
    bad = tmp_path / "bad.zip"
    with zipfile.ZipFile(archive_of(noisy)) as source, zipfile.ZipFile(bad, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            target.writestr(name, content[:-7] if name.endswith(("0.npy", "5.npy")) else content)
    fewer = archive_of(dict(list(noisy.items())[1:]), "fewer.zip")
    for archive in (bad, fewer, tmp_path / "none.zip"):
        with pytest.raises(SubmissionError) as by_score:
            score(archive, tiny_root)
        with pytest.raises(SubmissionError) as by_study:
            run_anchor_study(archive, tiny_root)
        assert by_study.value.problems == by_score.value.problems


def test_archive_of_several_configs_needs_config_option(
    tiny_truth: Depths, tiny_root: Path, tmp_path: Path
) -> None:
    archive = tmp_path / "both.zip"
    shape = next(iter(tiny_truth.values())).shape
    manifest = json.loads((tiny_root / "manifest.json").read_text())
    with SubmissionWriter(archive, method="test") as writer:
        for config in manifest["configs"].values():
            for view in config["views"]:
                writer.add(view["view_id"], np.ones(shape, np.float32))
    with pytest.raises(InputError, match="holds lattice, lattice-orbit, expected --config with one of them"):
        run_anchor_study(archive, tiny_root)
    with pytest.raises(InputError, match="has no config 'pier', expected one of lattice, lattice-orbit"):
        run_anchor_study(archive, tiny_root, config="pier")
    assert run_anchor_study(archive, tiny_root, config="lattice-orbit", counts=(1,)).views == 2


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--baseline-scale", "0"), "--baseline-scale: got 0.0, expected a finite number above 0"),
        (("--baseline-scale", "nan"), "--baseline-scale: got nan, expected a finite number above 0"),
        (("--num-anchor-views", "0", "3"), "--num-anchor-views: got 0, expected 1 or more"),
        (("--draws", "0"), "--draws: got 0, expected 1 to 1000"),
        (("--seed", "-1"), "--seed: got -1, expected 0 to"),
        ((), "no such folder"),
    ],
)
def test_invalid_arguments_exit_with_status_2(
    arguments: tuple[str, ...], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status = run_study_command("anchor", tmp_path / "a.zip", "--data", tmp_path / "nowhere", *arguments)
    assert status == 2
    printed = capsys.readouterr()
    assert words in printed.err
    assert printed.out == ""


def test_command_output_is_deterministic(
    noisy: Depths, tiny_root: Path, archive_of: Archive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    archive = archive_of(noisy)
    for folder in ("one", "two"):
        files = [f"--{kind}={tmp_path / folder / f'study.{kind}'}" for kind in ("json", "csv", "html")]
        assert (
            run_study_command("anchor", archive, "--data", tiny_root, "--num-anchor-views", "1", "5", *files) == 0
        )
    for name in ("study.json", "study.csv", "study.html"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()
    content = json.loads((tmp_path / "one/study.json").read_text())
    assert [row["k"] for row in content["rows"]] == [1, 5]
    assert [len(row["draws"]) for row in content["rows"]] == [24, 24]
    digest = json.loads((tiny_root / "manifest.json").read_text())["ground_truth"]["digest"]
    assert content["dataset"]["digest"] == digest
    header, first, *rest = (tmp_path / "one/study.csv").read_text().splitlines()
    assert len(rest) == 1
    assert dict(zip(header.split(","), first.split(","), strict=True))["dataset_digest"] == digest
    printed = capsys.readouterr()
    assert "one scale for the whole archive, from k views of known depth" in printed.out
    assert "errors of lattice: 9 of 9" in printed.err


@pytest.mark.parametrize(("counts", "markers"), [((1, 3), 6), ((2,), 6), ((1,), 12), ((1,), None)])
def test_published_numbers_are_beside_those_of_study(
    counts: tuple[int, ...],
    markers: int | None,
    noisy: Depths,
    tiny_root: Path,
    archive_of: Archive,
) -> None:
    study = run_anchor_study(archive_of(noisy), tiny_root, counts=counts, draws=2)
    assert study.markers == 6
    study = replace(study, markers=markers)
    published = to_page(study).tables[-1]
    assert "Sec. III.C" in published.caption
    assert "measured on the authors' renders" in published.caption
    assert [row[1] for row in published.rows] == ["within 0.15", "1.60", "1.69"]
    rmse_cm = f"{study.given.rmse_cm:.2f}"
    one_view = f"{study.rows[0].deviation_percent.mean:+.2f}" if 1 in counts else "–"
    expected = {6: [rmse_cm, "–"], 12: ["–", rmse_cm], None: ["–", "–"]}[markers]
    assert [row[2] for row in published.rows] == [one_view, *expected]
    assert "test on lattice" in published.heads[2][0]


def test_every_study_has_help() -> None:
    for name in STUDIES:
        with pytest.raises(SystemExit) as exit_info:
            run_study_command(name, "--help")
        assert exit_info.value.code == 0
