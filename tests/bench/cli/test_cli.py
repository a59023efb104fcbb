"""Tests of the ``rebar-bench`` command line: outputs, exit statuses and messages."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rebar_depth_bench import score
from rebar_depth_bench.base.errors import MAX_PROBLEMS_SHOWN
from rebar_depth_bench.cli import check
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.data.manifest import open_folder
from tests.commands import run_in_process

Depths = dict[str, np.ndarray]


def run_bench(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run ``rebar-bench`` in this process."""
    return run_in_process(main, *arguments)


@pytest.mark.slow
def test_module_runs_as_program(tiny_root: Path, constant: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "rebar_depth_bench",
        "check",
        str(constant),
        "--data",
        str(tiny_root),
    ]
    process = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert process.returncode == 0, process.stderr
    assert process.stdout == f"{constant}: no problem found\n"


def predict(method: str, root: Path, folder: Path) -> Path:
    """Run a method on the tiny lattice and return its archive."""
    archive = folder / f"{method}.zip"
    finished = run_bench("predict", method, "--data", root, "--out", archive, "--config", "lattice")
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout.strip() == str(archive)
    return archive


@pytest.fixture(scope="session")
def constant(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the archive that ``constant`` predicts on the tiny lattice."""
    return predict("constant", tiny_root, tmp_path_factory.mktemp("predicted"))


def test_score_writes_table_json_csv_and_report(constant: Path, tiny_root: Path, tmp_path: Path) -> None:
    targets = {kind: tmp_path / f"out.{kind}" for kind in ("json", "csv", "html")}
    options = [part for kind, path in targets.items() for part in (f"--{kind}", path)]
    finished = run_bench("score", constant, "--data", tiny_root, *options)
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


def test_sgbm_is_metric(tiny_root: Path, tmp_path: Path) -> None:
    pytest.importorskip("cv2")
    stereo = score(predict("sgbm", tiny_root, tmp_path), tiny_root).tables["lattice"]
    assert stereo.native is not None
    # At 160 x 90 one disparity step is centimetres of depth.
    assert stereo.scale_median == pytest.approx(1, abs=0.15)


def test_constant_needs_scaling(constant: Path, tiny_root: Path) -> None:
    table = score(constant, tiny_root).tables["lattice"]
    assert table.native is not None
    assert table.scaled is not None
    assert table.scale_median == pytest.approx(0.33, abs=0.1)
    assert table.scaled.abs_rel < 0.1 * table.native.abs_rel


def depth_entries(archive: Path) -> dict[str, bytes]:
    """Return the content of every entry but ``submission.json``."""
    with zipfile.ZipFile(archive) as source:
        return {name: source.read(name) for name in source.namelist() if name != "submission.json"}


def test_predicting_twice_gives_identical_depth_entries(constant: Path, tiny_root: Path, tmp_path: Path) -> None:
    second = tmp_path / "again.zip"
    assert (
        run_bench("predict", "constant", "--data", tiny_root, "--out", second, "--config", "lattice").returncode
        == 0
    )
    # submission.json holds run times, which differ.
    assert depth_entries(second) == depth_entries(constant)


def test_check_accepts_valid_archive(constant: Path, tiny_root: Path) -> None:
    finished = run_bench("check", constant, "--data", tiny_root)
    assert finished.returncode == 0
    assert "no problem found" in finished.stdout


def test_check_reads_the_manifest_once(
    constant: Path, tiny_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = shutil.copytree(tiny_root, tmp_path / "dataset")
    # Another manifest would not have the expected digest.
    monkeypatch.setattr(check, "print_verified", lambda _: (root / "manifest.json").unlink())
    digest = open_folder(root).digest
    finished = run_in_process(main, "check", constant, "--data", root, "--expect-digest", digest)
    assert (finished.returncode, finished.stderr.count("error: ")) == (0, 0), finished.stderr


@pytest.mark.parametrize("command", ["score", "check"])
def test_invalid_archive_exits_2_and_lists_problems(command: str, tiny_root: Path, tmp_path: Path) -> None:
    archive = tmp_path / "bad.zip"
    with zipfile.ZipFile(archive, "w") as target:
        target.writestr("lattice/0028.npy", b"no array")
        for n in range(30):
            target.writestr(f"stranger-{n}.npy", b"")
    finished = run_bench(command, archive, "--data", tiny_root)
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
        (
            ("predict", "magic", "--data", "ROOT", "--out", "x.zip"),
            2,
            "unknown method 'magic', expected one of",
        ),
        (("predict", "sgbm", "--data", "ROOT", "--out", "x.zip", "--config", "pier"), 2, "no config 'pier'"),
        (("score",), 2, "usage:"),
        (("predict", "x", "--nearest-distance", "near"), 2, "'near' is not a distance above 0 m"),
        (("predict", "x", "--view-timeout", "soon"), 2, "'soon' is not a number above 0, up to"),
        ((), 2, "usage:"),
        (("methods",), 0, ""),
    ],
)
def test_exit_status_and_message(arguments: tuple[str, ...], status: int, words: str, tiny_root: Path) -> None:
    finished = run_bench(*(str(tiny_root) if part == "ROOT" else part for part in arguments))
    assert finished.returncode == status
    assert words in finished.stderr
    assert "Traceback" not in finished.stderr
    assert not Path("x.zip").exists()


def test_methods_lists_licences() -> None:
    listed = run_bench("methods").stdout
    assert "sgbm" in listed
    assert "constant" in listed
    assert "Apache-2.0" in listed


@pytest.mark.slow
def test_closed_stdout_pipe_gives_no_traceback(constant: Path, tiny_root: Path) -> None:
    command = f"{sys.executable} -m rebar_depth_bench score {constant} --data {tiny_root} | head -n 1"
    finished = subprocess.run(command, shell=True, capture_output=True, text=True, check=False)
    assert "Traceback" not in finished.stderr
    assert "constant" in finished.stdout


def test_score_prints_perfect_result_for_ground_truth(
    tiny_truth: Depths, tiny_root: Path, archive_of: Callable[..., Path]
) -> None:
    finished = run_bench("score", archive_of(tiny_truth), "--data", tiny_root)
    assert "0.0000" in finished.stdout
    assert "1.000" in finished.stdout
