"""Tests of the ``rebar-bench`` commands: results, exit statuses and messages."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import huggingface_hub
import numpy as np
import pytest

import rebar_depth_bench as rdb
from rebar_depth_bench.base.errors import MAX_PROBLEMS_SHOWN
from rebar_depth_bench.cli import check
from rebar_depth_bench.cli.demo import DEMO_METHODS
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.data.codecs import encode_depth
from rebar_depth_bench.data.files import file_sha256
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.methods import METHODS, MultiViewMethod, own_methods
from rebar_depth_bench.methods.base import WeightsMethod
from rebar_depth_bench.methods.registry import FROM_FOLDER
from tests.commands import run_in_process
from tests.damage import change_manifest, change_rows, copy_dataset, first_shard
from tests.project.pages import PAGES, blocks


def run_bench(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run ``rebar-bench`` in this process."""
    return run_in_process(main, *arguments)


def predict(method: str, root: Path, folder: Path) -> Path:
    """Run a method on the tiny lattice and return its archive."""
    archive = folder / f"{method}.zip"
    finished = run_bench("predict", method, "--data", root, "--out", archive, "--config", "lattice")
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout.strip() == str(archive)
    return archive


@pytest.fixture(scope="module")
def constant(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the archive that ``constant`` predicts on the tiny lattice."""
    return predict("constant", tiny_root, tmp_path_factory.mktemp("predicted"))


def test_sgbm_is_metric_and_constant_needs_scaling(constant: Path, tiny_root: Path, tmp_path: Path) -> None:
    pytest.importorskip("cv2")
    stereo = rdb.score(predict("sgbm", tiny_root, tmp_path), tiny_root).tables["lattice"]
    # At 160 x 90 one disparity step is centimetres of depth.
    assert stereo["scale_median"] == pytest.approx(1, abs=0.15)
    table = rdb.score(constant, tiny_root).tables["lattice"]
    assert table["scale_median"] == pytest.approx(0.33, abs=0.1)
    assert table["scaled.abs_rel"] < 0.1 * table["native.abs_rel"]


def test_table_says_why_the_rows_of_the_paper_are_absent(constant: Path, tiny_root: Path, tmp_path: Path) -> None:
    note = "rows are absent; the configs differ from its scenes: lattice (9 of 504 views, 160 x 90 pixels, not"
    shown = run_bench("table", constant, "--data", tiny_root, "--latex", tmp_path / "table.tex").stdout
    assert f"{note} 1280 x 720)." in " ".join(shown.split())
    assert f"{note} 1280 x 720)." in (tmp_path / "table.tex").read_text()
    assert "paper" not in run_bench("table", constant, "--data", tiny_root, "--no-published").stdout


def test_predicting_twice_gives_identical_depth_entries(constant: Path, tiny_root: Path, tmp_path: Path) -> None:
    entries = []
    for archive in (constant, predict("constant", tiny_root, tmp_path)):
        with zipfile.ZipFile(archive) as source:
            names = [name for name in source.namelist() if name != "submission.json"]  # It holds run times.
            entries.append({name: source.read(name) for name in names})
    assert entries[0] == entries[1]
    assert len(entries[0]) == 9


@pytest.mark.slow
def test_check_reads_the_manifest_once(
    constant: Path, tiny_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = shutil.copytree(tiny_root, tmp_path / "dataset")
    # Another manifest would not have the expected digest.
    monkeypatch.setattr(check, "print_verified", lambda _: (root / "manifest.json").unlink())
    finished = run_bench("check", constant, "--data", root, "--expect-digest", open_folder(root).digest)
    assert (finished.returncode, finished.stderr.count("error: ")) == (0, 0), finished.stderr
    assert finished.stdout == f"{constant}: the archive is valid\n"


@pytest.mark.parametrize("command", ["score", "check"])
def test_invalid_archive_exits_2_and_lists_problems(command: str, tiny_root: Path, tmp_path: Path) -> None:
    archive = tmp_path / "bad.zip"
    with zipfile.ZipFile(archive, "w") as target:
        target.writestr("lattice/0028.npy", b"no array")
        for n in range(30):
            target.writestr(f"stranger-{n}.npy", b"")
    finished = run_bench(command, archive, "--data", tiny_root)
    assert (finished.returncode, finished.stdout) == (2, "")
    assert "Traceback" not in finished.stderr
    assert finished.stderr.count("\n  - ") == MAX_PROBLEMS_SHOWN
    assert "more" in finished.stderr.splitlines()[-1]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("score nothing.zip --data ROOT", "does not exist"),
        ("score nothing.zip --data /nowhere", "no such folder"),
        ("predict magic --data ROOT --out x.zip", "unknown method 'magic', expected one of"),
        ("predict sgbm --data ROOT --out x.zip --config pier", "no config 'pier'"),
        ("score", "usage:"),
        ("", "usage:"),
        *(
            (
                f"predict x --nearest-distance={metres}",
                f"--nearest-distance: '{metres}' is not a distance above 0 m",
            )
            for metres in ("0", "-1", "nan", "inf", "near")
        ),
        *(
            (f"predict x --view-timeout={seconds}", f"--view-timeout: '{seconds}' is not a number above 0, up to")
            for seconds in ("0", "-1", "nan", "inf", "1e7", "soon", "")
        ),
    ],
)
def test_usage_and_input_errors_exit_2(arguments: str, words: str, tiny_root: Path) -> None:
    finished = run_bench(*arguments.replace("ROOT", str(tiny_root)).split())
    assert finished.returncode == 2
    assert words in finished.stderr
    assert "Traceback" not in finished.stderr
    assert not Path("x.zip").exists()


def test_methods_are_listed_in_a_line_each(monkeypatch: pytest.MonkeyPatch) -> None:
    for columns in ("80", "100", "600"):
        monkeypatch.setenv("COLUMNS", columns)
        lines = run_bench("methods").stdout.splitlines()
        assert len(lines) <= 40
        assert max(map(len, lines)) <= min(int(columns), 100)
        named = {line.split()[0]: line for line in lines}
        for name, method in own_methods().items():
            assert (f"{name} ‡" in named[name]) == method.info.uses_ground_truth
            assert method.info.summary[:20] in named[name]


def test_a_method_is_printed_whole_without_network_and_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "600")
    for function in ("hf_hub_download", "snapshot_download"):
        monkeypatch.setattr(huggingface_hub, function, None)
    monkeypatch.setitem(sys.modules, "torch", None)
    assert {name for name, method in METHODS.items() if isinstance(method, WeightsMethod)} == set(FROM_FOLDER)
    for name, method in own_methods().items():
        finished = run_bench("methods", name)
        assert (finished.returncode, finished.stderr) == (0, "")
        info, shown = method.info, finished.stdout
        assert info.name == name
        assert all(words in shown for words in (name, info.summary, info.source, info.licence, info.untested_note))
        assert bool(info.untested_note) >= (name in FROM_FOLDER)
        assert ("prepares a whole config" in shown) == isinstance(method, MultiViewMethod)
        assert ("both rgb, both" in shown) == ("right_rgb" in info.columns)
        assert ("reads: left_depth" in shown) == (info.columns == ("left_depth",))
    unknown = run_bench("methods", "magic")
    assert unknown.returncode == 2
    assert "unknown method 'magic', expected one of" in unknown.stderr


@pytest.fixture
def copy(tiny_root: Path, tmp_path: Path) -> Path:
    return copy_dataset(tiny_root, tmp_path / "dataset")


def test_sound_folder_passes_with_one_line(copy: Path) -> None:
    digest = open_folder(copy).digest
    finished = run_bench("verify", copy)
    assert (finished.returncode, finished.stdout.count("\n")) == (0, 1), finished.stderr
    assert f"no problem found in 10 files, 11 views; dataset {digest}" in finished.stdout
    assert "files: 10 of 10" in finished.stderr
    files_only = run_bench("verify", copy, "--files-only")
    assert "views" not in files_only.stdout


def test_changed_missing_and_further_files_are_listed(copy: Path) -> None:
    shard = first_shard(copy)
    shard.write_bytes(shard.read_bytes()[:-100])
    (copy / "bars.parquet").unlink()
    (copy / "lattice" / "extra\x1b[2J").write_text("")
    (copy / "meshes" / "link").symlink_to("/tmp")
    change_manifest(copy, lambda manifest, _: manifest["files"].pop("meshes/lattice.ply"))
    finished = run_bench("verify", copy)
    assert (finished.returncode, finished.stdout) == (2, "")
    problems = [line[4:] for line in finished.stderr.splitlines() if line.startswith("  - ")]
    assert problems[0] == "bars.parquet: is missing"
    assert problems[1].startswith(f"{shard.relative_to(copy)}: SHA-256 is ")
    assert problems[2].startswith("meshes/lattice.ply: has no SHA-256 in the manifest")
    assert problems[3:] == [
        "'lattice/extra\\x1b[2J': is not in the manifest",
        "meshes/link: is not in the manifest",
    ]


def test_right_depth_that_differs_from_its_digest_is_listed(copy: Path) -> None:
    """Refuse other ground truth, also where the SHA-256 of the file was changed with it."""
    depth = encode_depth(np.ones((90, 160), np.float32))
    shard = first_shard(copy)
    change_rows(shard, lambda rows: rows[1].update(right_depth=depth))
    name = shard.relative_to(copy).as_posix()
    change_manifest(copy, lambda manifest, _: manifest["files"].update({name: file_sha256(shard)}))
    finished = run_bench("verify", copy)
    assert finished.returncode == 2
    assert "lattice-orbit/0075: the right ground truth has the digest" in finished.stderr
    assert run_bench("verify", copy, "--files-only").returncode == 0


def reading_commands(archive: Path, data: Path, out: Path) -> list[list[str | Path]]:
    """Return a command line of each command that reads a dataset; results are written beside or at ``out``."""
    return [
        ["score", archive, "--data", data, "--json", out],
        ["check", archive, "--data", data],
        ["predict", "constant", "--data", data, "--out", out, "--config", "lattice-orbit"],
        ["table", archive, "--data", data, "--csv", out],
        ["compare", archive, archive, "--data", data, "--csv", out],
        ["verify", data, "--files-only"],
    ]


@pytest.mark.slow
def test_other_dataset_than_expected_is_refused(
    tiny_root: Path, tiny_truth: dict[str, np.ndarray], archive_of: Callable[..., Path], tmp_path: Path
) -> None:
    archive, digest = archive_of(tiny_truth), open_folder(tiny_root).digest
    commands = reading_commands(archive, tiny_root, tmp_path / "out")
    other = "sha256:" + "0" * 64
    for command in commands:
        for wrong, said in ((other, f"has the digest {digest}, expected {other}"), ("md5:1", "expected sha256:")):
            finished = run_bench(*command, "--expect-digest", wrong)
            assert (finished.returncode, finished.stdout) == (2, ""), command
            assert said in finished.stderr
        assert not list(tmp_path.glob("*out*"))
    for command in commands:
        finished = run_bench(*command, "--expect-digest", digest)
        assert finished.returncode == 0, finished.stderr
        notes = [
            line for line in finished.stderr.splitlines() if line.startswith(f"dataset {digest} of {tiny_root}: ")
        ]
        assert len(notes) == (command[0] in ("score", "check", "predict"))
    with pytest.raises(rdb.DatasetError, match=f"expected {other}"):
        rdb.score(archive, tiny_root, expect_digest=other)
    assert rdb.score(archive, tiny_root, expect_digest=digest).dataset.digest == digest


def test_false_digest_is_refused_by_every_command(
    copy: Path, tiny_truth: dict[str, np.ndarray], archive_of: Callable[..., Path]
) -> None:
    manifest = (copy / "manifest.json").read_text()
    (copy / "manifest.json").write_text(manifest.replace(open_folder(copy).digest, "sha256:" + "0" * 64))
    commands = reading_commands(archive_of(tiny_truth), copy, copy.with_name("out"))
    for command in commands:
        arguments = [argument for argument in command if argument != "--files-only"]
        finished = run_bench(*arguments)
        assert (finished.returncode, finished.stdout) == (2, "")
        assert "ground_truth.digest" in finished.stderr


@pytest.mark.slow
def test_demo_on_the_sample_prints_what_the_readme_shows(tmp_path: Path) -> None:
    pytest.importorskip("cv2")
    finished = run_bench("demo", "--sample", "--out", tmp_path)
    assert finished.returncode == 0, finished.stderr
    shown, *_ = blocks(PAGES[0], "text")
    assert "\n".join(map(str.rstrip, finished.stdout.splitlines())).startswith(shown)
    out = tmp_path / "sample"
    assert run_bench("verify", out / "dataset").returncode == 0
    reports = [Path(line.strip()) for line in finished.stdout.partition("Reports")[2].splitlines()[1:]]
    assert reports == [out / f"{name}.html" for name in DEMO_METHODS]
    assert all(path.read_text().startswith("<!DOCTYPE html>") for path in reports)
    for name in DEMO_METHODS:
        result = rdb.score(out / f"{name}.zip", out / "dataset")
        assert (out / f"{name}.json").read_bytes() == result.to_json()
        assert not [note for note in result.notes if "mistake" in note]
        assert f"{name} " in shown
