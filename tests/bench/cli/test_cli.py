"""``rebar-bench`` as a user runs it: outputs, exit statuses, words."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rebar_depth_bench import score
from rebar_depth_bench.errors import MAX_PROBLEMS_SHOWN

Depths = dict[str, np.ndarray]


def bench(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "rebar_depth_bench", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


@pytest.fixture(scope="session")
def predicted(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The archives of the two methods on the tiny lattice."""
    folder = tmp_path_factory.mktemp("predicted")
    archives = {method: folder / f"{method}.zip" for method in ("sgbm", "constant")}
    for method, archive in archives.items():
        finished = bench("predict", method, "--data", tiny_root, "--out", archive, "--config", "lattice")
        assert finished.returncode == 0, finished.stderr
        assert finished.stdout.strip() == str(archive)
    return archives


def test_score_writes_table_json_csv_and_report(
    predicted: dict[str, Path], tiny_root: Path, tmp_path: Path
) -> None:
    targets = {kind: tmp_path / f"out.{kind}" for kind in ("json", "csv", "html")}
    options = [part for kind, path in targets.items() for part in (f"--{kind}", path)]
    finished = bench("score", predicted["sgbm"], "--data", tiny_root, *options)
    assert finished.returncode == 0, finished.stderr
    result = json.loads(targets["json"].read_text())
    table = result["tables"]["lattice"]
    assert f"{table['native']['abs_rel']:.4f}" in finished.stdout
    assert f"{table['scaled']['abs_rel']:.4f}" in finished.stdout
    assert "native (no alignment)" in finished.stdout
    assert "s = median(z)/median(p)" in finished.stdout
    row = next(csv.DictReader(targets["csv"].read_text().splitlines()))
    assert table["native"]["abs_rel"] in {float(value) for value in row.values() if _is_number(value)}
    page = targets["html"].read_text()
    assert page.startswith("<!DOCTYPE html>")
    assert all(view["view_id"] in page for view in result["views"])


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def test_the_papers_finding_shows_on_the_two_methods(predicted: dict[str, Path], tiny_root: Path) -> None:
    stereo = score(predicted["sgbm"], tiny_root).tables["lattice"]
    control = score(predicted["constant"], tiny_root).tables["lattice"]
    assert stereo.native is not None
    assert stereo.scale_median == pytest.approx(1, abs=0.15)  # at 160 x 90 a disparity step is centimetres
    assert control.native is not None
    assert control.scaled is not None
    assert control.scale_median == pytest.approx(0.33, abs=0.1)
    assert control.scaled.abs_rel < 0.1 * control.native.abs_rel


def entries(archive: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(archive) as source:
        return {name: source.read(name) for name in source.namelist() if name != "submission.json"}


def test_predicting_twice_gives_the_same_depths(
    predicted: dict[str, Path], tiny_root: Path, tmp_path: Path
) -> None:
    again = tmp_path / "again.zip"
    assert bench("predict", "constant", "--data", tiny_root, "--out", again, "--config", "lattice").returncode == 0
    assert entries(again) == entries(predicted["constant"])  # submission.json tells how long each view took


def test_check_passes_a_good_archive(predicted: dict[str, Path], tiny_root: Path) -> None:
    finished = bench("check", predicted["sgbm"], "--data", tiny_root)
    assert finished.returncode == 0
    assert "no problem found" in finished.stdout


@pytest.mark.parametrize("command", ["score", "check"])
def test_a_bad_archive_ends_in_words_with_every_problem(command: str, tiny_root: Path, tmp_path: Path) -> None:
    archive = tmp_path / "bad.zip"
    with zipfile.ZipFile(archive, "w") as target:
        target.writestr("lattice/0028.npy", b"no array")
        for n in range(30):
            target.writestr(f"stranger-{n}.npy", b"")
    finished = bench(command, archive, "--data", tiny_root)
    assert finished.returncode == 2
    assert finished.stdout == ""
    assert "Traceback" not in finished.stderr
    assert finished.stderr.count("\n  - ") == MAX_PROBLEMS_SHOWN
    assert "more" in finished.stderr.splitlines()[-1]


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (("score", "nothing.zip", "--data", "ROOT"), 2, "does not exist"),
        (("score", "nothing.zip", "--data", "/nowhere"), 2, "no such folder"),
        (("predict", "magic", "--data", "ROOT", "--out", "x.zip"), 2, "no method 'magic', expected one of sgbm"),
        (("predict", "sgbm", "--data", "ROOT", "--out", "x.zip", "--config", "pier"), 2, "no config 'pier'"),
        (("score",), 2, "usage:"),
        ((), 2, "usage:"),
        (("methods",), 0, ""),
    ],
)
def test_exit_statuses(arguments: tuple[str, ...], status: int, words: str, tiny_root: Path) -> None:
    finished = bench(*(str(tiny_root) if part == "ROOT" else part for part in arguments))
    assert finished.returncode == status
    assert words in finished.stderr
    assert "Traceback" not in finished.stderr
    assert not Path("x.zip").exists()


def test_methods_lists_each_with_its_licence() -> None:
    listed = bench("methods").stdout
    assert "sgbm" in listed
    assert "constant" in listed
    assert "Apache-2.0" in listed


def test_a_closed_pipe_is_no_traceback(predicted: dict[str, Path], tiny_root: Path) -> None:
    command = f"{sys.executable} -m rebar_depth_bench score {predicted['constant']} --data {tiny_root} | head -n 1"
    finished = subprocess.run(command, shell=True, capture_output=True, text=True, check=False)
    assert "Traceback" not in finished.stderr
    assert "constant" in finished.stdout


def test_the_archive_fixture_and_cli_agree_on_the_format(
    tiny_truth: Depths, tiny_root: Path, archive_of: Callable[..., Path]
) -> None:
    finished = bench("score", archive_of(tiny_truth), "--data", tiny_root)
    assert "0.0000" in finished.stdout
    assert "1.000" in finished.stdout
