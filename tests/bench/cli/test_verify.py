"""``rebar-bench verify`` and ``--expect-digest``: damaged files and other datasets are refused."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import rebar_depth_bench as rdb
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.data.codecs import encode_depth
from rebar_depth_bench.data.files import file_sha256
from rebar_depth_bench.data.manifest import open_folder
from tests.commands import run_in_process
from tests.damage import change_manifest, change_rows, copy_dataset, first_shard

Depths = dict[str, np.ndarray]


def run_bench(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return run_in_process(main, *arguments)


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


def test_file_that_builds_no_longer_write_is_verified_if_it_is_listed(copy: Path) -> None:
    (copy / "eval.yaml").write_text("name: Industrial rebar metric depth\n")
    sha256 = file_sha256(copy / "eval.yaml")
    change_manifest(copy, lambda manifest, _: manifest["files"].update({"eval.yaml": sha256}))
    assert "no problem found in 11 files" in run_bench("verify", copy).stdout
    (copy / "eval.yaml").write_text("name: another\n")
    finished = run_bench("verify", copy)
    assert finished.returncode == 2
    assert "eval.yaml: SHA-256 is " in finished.stderr


def test_changed_missing_and_further_files_are_listed(copy: Path) -> None:
    shard = first_shard(copy)
    shard.write_bytes(shard.read_bytes()[:-100])
    (copy / "bars.parquet").unlink()
    (copy / "lattice" / "extra\x1b[2J").write_text("")
    (copy / "meshes" / "link").symlink_to("/tmp")
    finished = run_bench("verify", copy)
    assert (finished.returncode, finished.stdout) == (2, "")
    problems = [line[4:] for line in finished.stderr.splitlines() if line.startswith("  - ")]
    assert len(problems) == 4
    assert problems[0] == "bars.parquet: is missing"
    assert problems[1].startswith(f"{shard.relative_to(copy)}: SHA-256 is ")
    assert problems[2:] == [
        "'lattice/extra\\x1b[2J': is not in the manifest",
        "meshes/link: is not in the manifest",
    ]


def test_file_without_sha256_in_the_manifest_is_listed(copy: Path) -> None:
    change_manifest(copy, lambda manifest, _: manifest["files"].pop("meshes/lattice.ply"))
    finished = run_bench("verify", copy)
    assert finished.returncode == 2
    assert "meshes/lattice.ply: has no SHA-256 in the manifest" in finished.stderr


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


def test_other_dataset_than_expected_is_refused(
    tiny_root: Path, tiny_truth: Depths, archive_of: Callable[..., Path], tmp_path: Path
) -> None:
    archive, digest, out = archive_of(tiny_truth), open_folder(tiny_root).digest, tmp_path / "out"
    commands: list[list[str | Path]] = [
        ["score", archive, "--data", tiny_root, "--json", out],
        ["check", archive, "--data", tiny_root],
        ["predict", "constant", "--data", tiny_root, "--out", out, "--config", "lattice-orbit"],
        ["table", archive, "--data", tiny_root, "--csv", out],
        ["compare", archive, archive, "--data", tiny_root, "--csv", out],
        ["verify", tiny_root, "--files-only"],
    ]
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
    copy: Path, tiny_truth: Depths, archive_of: Callable[..., Path]
) -> None:
    archive = archive_of(tiny_truth)
    manifest = (copy / "manifest.json").read_text()
    (copy / "manifest.json").write_text(manifest.replace(open_folder(copy).digest, "sha256:" + "0" * 64))
    commands: list[list[str | Path]] = [
        ["score", archive, "--data", copy],
        ["table", archive, "--data", copy],
        ["check", archive, "--data", copy],
        ["predict", "constant", "--data", copy, "--out", copy.with_name("out")],
        ["verify", copy],
    ]
    for command in commands:
        finished = run_bench(*command)
        assert (finished.returncode, finished.stdout) == (2, "")
        assert "ground_truth.digest" in finished.stderr
