"""Full and read-only disks and file-size limits: told in words with exit status 1, and finished by a later run."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from rebar_depth_bench.cli.main import main
from tests.commands import run_in_process
from tests.small_disks import NewDisk

KIB = 1024


@pytest.fixture(scope="module")
def archive(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an archive of both configs, 637 kB."""
    path = tmp_path_factory.mktemp("full") / "sweep.zip"
    assert run_in_process(main, "predict", "constant", "--data", tiny_root, "--out", path).returncode == 0
    return path


def _refused(finished: subprocess.CompletedProcess[str], path: Path, reason: str) -> None:
    last = finished.stderr.splitlines()[-1]
    assert (finished.returncode, finished.stdout) == (1, ""), finished.stderr
    assert last.startswith("error: ")
    assert str(path) in last
    assert reason in last
    assert "Traceback" not in finished.stderr


def test_prediction_on_a_full_disk_is_finished_by_a_later_run(new_disk: NewDisk, tiny_root: Path) -> None:
    disk = new_disk(8 * KIB)
    out = disk.root / "a.zip"
    command = ("predict", "constant", "--data", tiny_root, "--out", out)
    for size_kib, kept in ((8, 0), (400, 6), (900, 11), (1240, 11)):
        disk.resize(size_kib * KIB)
        _refused(run_in_process(main, *command), disk.root, "No space left on device")
        assert "a.zip" not in disk.files()
        assert sum(name.endswith(".npz") for name in disk.files()) == kept
        assert not any(name.endswith(".tmp") for name in disk.files())
    disk.resize(2000 * KIB)
    finished = run_in_process(main, *command)
    assert finished.returncode == 0
    assert "resuming: 11 views" in finished.stderr
    assert disk.files() == {"a.zip"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "option", "suffix"),
    [
        ("score", "--json", "json"),
        ("score", "--csv", "csv"),
        ("score", "--html", "html"),
        ("score", "--extended-csv", "csv"),
        ("table", "--latex", "tex"),
        ("table", "--figure", "pdf"),
    ],
)
def test_outputs_on_full_and_read_only_disks(
    new_disk: NewDisk, archive: Path, tiny_root: Path, command: str, option: str, suffix: str
) -> None:
    if option == "--figure":
        pytest.importorskip("matplotlib")
    disk = new_disk(8 * KIB)
    target = disk.root / f"out.{suffix}"
    target.write_text("old")
    (disk.root / "other").write_bytes(bytes(4 * KIB))
    arguments: tuple[str | Path, ...] = (*command.split(), archive, "--data", tiny_root, option, target)
    _refused(run_in_process(main, *arguments), target, "No space left on device")
    assert target.read_text() == "old"
    assert disk.files() == {target.name, "other"}
    disk.make_read_only()
    _refused(run_in_process(main, *arguments), target, "cannot be written")


@pytest.mark.slow
def test_full_standard_output_is_told_in_words(archive: Path, tiny_root: Path) -> None:
    for extra in ((), ("--json", "-")):
        command = [sys.executable, "-m", "rebar_depth_bench", "score", archive, "--data", tiny_root, *extra]
        with Path("/dev/full").open("w") as full:
            finished = subprocess.run(
                command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=100, check=False
            )
        assert finished.returncode == 1
        assert finished.stderr.splitlines()[-1] == "error: standard output: No space left on device"


LIMITED = """
import resource, sys
from rebar_depth_bench.cli.main import main
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), int(sys.argv[1])))
sys.exit(main(sys.argv[2:]))
"""


@pytest.mark.slow
def test_file_size_limit_is_told_in_words(tiny_root: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.zip"
    command = ["predict", "constant", "--data", str(tiny_root), "--out", str(out)]
    limited = [sys.executable, "-c", LIMITED, str(300 * KIB), *command]
    finished = subprocess.run(limited, capture_output=True, text=True, timeout=100, check=False)
    _refused(finished, tmp_path, "File too large")
    assert not out.exists()
    assert run_in_process(main, *command).returncode == 0
    assert {path.name for path in tmp_path.iterdir()} == {"a.zip"}


def test_score_needs_no_space_in_its_cache(
    new_disk: NewDisk, archive: Path, tiny_root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = run_in_process(main, "score", archive, "--data", tiny_root, "--json", "-")
    disk = new_disk(8 * KIB)
    monkeypatch.setenv("XDG_CACHE_HOME", str(disk.root))
    finished = run_in_process(main, "score", archive, "--data", tiny_root, "--json", "-")
    assert (finished.returncode, finished.stdout) == (0, expected.stdout)
    assert "not cached, but computed whenever it is needed" in finished.stderr
    assert disk.files() == set()
