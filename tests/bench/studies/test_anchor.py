"""``study anchor`` on a really rendered dataset: what was put into an archive comes out."""

from __future__ import annotations

import argparse
import json
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rebar_depth_bench.cli.console import run_command
from rebar_depth_bench.errors import InputError, SubmissionError
from rebar_depth_bench.scoring.score import score
from rebar_depth_bench.studies.registry import STUDIES, add_study_commands
from rebar_depth_bench.studies.scale_anchor.command import study_anchor
from rebar_depth_bench.studies.scale_anchor.output import page
from rebar_depth_bench.submission import SubmissionWriter

Depths = dict[str, np.ndarray]
Archive = Callable[..., Path]
TRUE_SCALE = 1.7


def study_command(*arguments: str | Path) -> int:
    """Run ``rebar-bench study`` as it is wired, without the other commands."""
    parser = argparse.ArgumentParser()
    add_study_commands(parser)
    options = parser.parse_args([str(argument) for argument in arguments])
    return run_command(lambda: options.run(options))


@pytest.fixture
def noisy(tiny_truth: Depths) -> Depths:
    """Predictions that need ``TRUE_SCALE``, give or take 1 % a view and 3 % a pixel, with a tenth missing."""
    rng = np.random.default_rng(7)
    predictions = {}
    for view, depth_m in tiny_truth.items():
        p_m = depth_m / TRUE_SCALE * np.exp(rng.normal(0, 0.01)) * (1 + rng.normal(0, 0.03, depth_m.shape))
        p_m[rng.random(depth_m.shape) < 0.1] = np.nan
        predictions[view] = p_m.astype(np.float32)
    return predictions


def test_a_known_scale_is_recovered(noisy: Depths, tiny_root: Path, archive_of: Archive) -> None:
    study = study_anchor(archive_of(noisy), tiny_root, given_scale=TRUE_SCALE, counts=(1, 2, 3, 5, 9))
    for row in study.rows[:4]:
        assert row.scale.low <= TRUE_SCALE <= row.scale.high
        assert row.deviation_percent.low <= 0 <= row.deviation_percent.high
    assert study.rows[0].scale.sd is not None
    assert study.rows[0].scale.sd > 2 * (study.rows[3].scale.sd or 0), "more views, less spread"
    everything = study.rows[-1]
    assert everything.scale.low == everything.scale.high == study.all_views.scale
    assert everything.scale.mean == pytest.approx(TRUE_SCALE, rel=0.01)
    assert study.coverage == pytest.approx(0.9, abs=0.02)


def test_every_scaled_archive_scores_what_the_study_says(
    noisy: Depths, tiny_root: Path, archive_of: Archive
) -> None:
    """Writes the archive anew, in float32, times a drawn scale and scores it by the protocol's own scorer."""
    study = study_anchor(archive_of(noisy), tiny_root, counts=(1, 3), draws=2)
    for one in (study.given, study.all_views, *study.draws[0], study.draws[1][0]):
        scaled = {view: one.scale * depth_m.astype(np.float64) for view, depth_m in noisy.items()}
        table = score(archive_of(scaled, "scaled.zip"), tiny_root).tables["lattice"]
        assert table.native is not None
        assert (one.abs_rel, one.rmse_cm) == pytest.approx((table.native.abs_rel, table.native.rmse_cm), rel=1e-7)


def test_the_unit_of_an_up_to_scale_archive_does_not_matter(
    noisy: Depths, tiny_root: Path, archive_of: Archive
) -> None:
    metres = study_anchor(archive_of(noisy), tiny_root, counts=(1, 4), draws=5)
    other = archive_of({view: 1024 * depth_m for view, depth_m in noisy.items()}, "other.zip")
    found = study_anchor(other, tiny_root, counts=(1, 4), draws=5)
    for ours, theirs in zip(metres.draws, found.draws, strict=True):
        assert [one.scale / 1024 for one in ours] == [one.scale for one in theirs]
        assert [one.abs_rel for one in ours] == pytest.approx([one.abs_rel for one in theirs], rel=1e-9)


def test_views_without_a_prediction_are_neither_drawn_nor_scored(
    noisy: Depths, tiny_root: Path, archive_of: Archive
) -> None:
    blank = sorted(noisy)[2]
    study = study_anchor(
        archive_of({**noisy, blank: np.zeros_like(noisy[blank])}), tiny_root, counts=(1, 8, 9, 50)
    )
    assert study.unpredicted == (blank,)
    assert [row.k for row in study.rows] == [1, 8]
    assert study.left_out == (9, 50)
    notes = " ".join(page(study).notes)
    assert "1 of 9 views have no prediction: neither drawn nor scored." in notes
    assert "Left out: k = 9, 50, more than the 8 views to draw from." in notes
    nothing = archive_of({view: -depth_m for view, depth_m in noisy.items()}, "nothing.zip")
    with pytest.raises(InputError, match="0 of 9 views of lattice have a prediction, expected at least 2"):
        study_anchor(nothing, tiny_root, counts=(2, 3))


def test_a_bad_archive_is_refused_with_the_words_of_score(
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
            study_anchor(archive, tiny_root)
        assert by_study.value.problems == by_score.value.problems


def test_one_of_several_configs_must_be_named(tiny_truth: Depths, tiny_root: Path, tmp_path: Path) -> None:
    archive = tmp_path / "both.zip"
    shape = next(iter(tiny_truth.values())).shape
    manifest = json.loads((tiny_root / "manifest.json").read_text())
    with SubmissionWriter(archive, method="test") as writer:
        for config in manifest["configs"].values():
            for view in config["views"]:
                writer.add(view["view_id"], np.ones(shape, np.float32))
    with pytest.raises(InputError, match="holds lattice, lattice-orbit, expected --config with one of them"):
        study_anchor(archive, tiny_root)
    with pytest.raises(InputError, match="has no config 'pier', expected one of lattice, lattice-orbit"):
        study_anchor(archive, tiny_root, config="pier")
    assert study_anchor(archive, tiny_root, config="lattice-orbit", counts=(1,)).views == 2


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--given-scale", "0"), "--given-scale is 0, expected a finite number above 0"),
        (("--given-scale", "nan"), "--given-scale is nan, expected a finite number above 0"),
        (("--k", "0", "3"), "--k has 0, expected 1 or more"),
        (("--draws", "0"), "--draws is 0, expected 1 to 1000"),
        (("--seed", "-1"), "--seed is -1, expected 0 to"),
        ((), "no such folder"),
    ],
)
def test_arguments_that_cannot_be_are_refused_in_words(
    arguments: tuple[str, ...], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status = study_command("anchor", tmp_path / "a.zip", "--data", tmp_path / "nowhere", *arguments)
    assert status == 2
    printed = capsys.readouterr()
    assert words in printed.err
    assert printed.out == ""


def test_the_command_writes_the_same_bytes_twice(
    noisy: Depths, tiny_root: Path, archive_of: Archive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    archive = archive_of(noisy)
    for folder in ("one", "two"):
        files = [f"--{kind}={tmp_path / folder / f'study.{kind}'}" for kind in ("json", "csv", "html")]
        assert study_command("anchor", archive, "--data", tiny_root, "--k", "1", "5", *files) == 0
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


def test_every_study_can_be_asked_for_help() -> None:
    for name in STUDIES:
        with pytest.raises(SystemExit) as left:
            study_command(name, "--help")
        assert left.value.code == 0
