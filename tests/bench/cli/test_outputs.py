"""Outputs: refused paths, standard output, devices, pipes and links, and full and read-only disks."""

from __future__ import annotations

import json
import os
import stat
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from rebar_depth_bench import InputError, SubmissionWriter
from rebar_depth_bench.base.errors import OutputError
from rebar_depth_bench.base.writing import STANDARD_OUTPUT, output_file, write_output
from rebar_depth_bench.cli.console import InputFile, InputFolder, OutputArchive, OutputFile, check_outputs
from rebar_depth_bench.cli.main import main
from tests.commands import run_in_process
from tests.small_disks import NewDisk

BENCH = [sys.executable, "-m", "rebar_depth_bench"]
KIB = 1024


@pytest.fixture(scope="module")
def archive(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an archive of the two views of ``lattice-orbit``."""
    path = tmp_path_factory.mktemp("outputs") / "constant.zip"
    command = ("predict", "constant", "--data", tiny_root, "--config", "lattice-orbit", "--out", path)
    assert run_in_process(main, *command).returncode == 0
    return path


@pytest.fixture(scope="module")
def whole_archive(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an archive of both configs."""
    path = tmp_path_factory.mktemp("outputs") / "whole.zip"
    assert run_in_process(main, "predict", "constant", "--data", tiny_root, "--out", path).returncode == 0
    return path


def test_output_that_is_an_input_is_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    archive, data = tmp_path / "a.zip", tmp_path / "data"
    archive.write_bytes(b"precious")
    data.mkdir()
    (data / "manifest.json").write_text("precious")
    commands = [
        ["score", str(archive), "--data", str(data), "--json", str(archive)],
        ["score", str(archive), "--data", str(data), "--html", str(data / ".." / "a.zip")],
        ["score", str(archive), "--data", str(data), "--json", str(data / "manifest.json")],
        ["compare", "b.zip", str(archive), "--data", str(data), "--csv", str(archive)],
        ["table", "b.zip", str(archive), "--data", str(data), "--latex", str(archive)],
        ["predict", "constant", "--data", str(archive), "--out", str(archive)],
    ]
    for command in commands:
        assert main(command) == 2, command
        stderr = capsys.readouterr().err
        assert "which is an input" in stderr or "inside" in stderr
    assert archive.read_bytes() == b"precious"
    assert (data / "manifest.json").read_text() == "precious"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"json": "x", "html": "./x"}, "--html and --json both name x, expected different files"),
        ({"json": "."}, r"--json names \., which is a folder"),
        (
            {"extended_csv": "file/x.csv"},
            r"--extended-csv names file/x\.csv, but .*file is a file: expected a folder",
        ),
    ],
)
def test_unwritable_output_is_refused(
    options: dict[str, str], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    with pytest.raises(InputError, match=words):
        check_outputs({name: OutputFile(value) for name, value in options.items()})


def test_method_file_and_prediction_folder_are_inputs(tmp_path: Path) -> None:
    method, predictions, link = tmp_path / "mine.py", tmp_path / "predictions", tmp_path / "link"
    method.touch()
    predictions.mkdir()
    link.symlink_to(method)
    for path in (method, link):
        with pytest.raises(InputError, match="which is an input"):
            check_outputs({"method": InputFile(f"{method}:METHOD"), "out": OutputFile(path)})
    with pytest.raises(InputError, match="inside"):
        check_outputs({"maps": [InputFolder(predictions)], "csv": OutputFile(predictions / "t.csv")})
    check_outputs({"maps": [InputFolder(predictions)], "out": OutputArchive(predictions / "a.zip")})


def test_folder_named_like_config_or_method_and_new_files_are_accepted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("lattice", "sgbm"):
        Path(name).mkdir()
    inputs = {"config": ["lattice"], "method": InputFile("sgbm"), "data": InputFolder(tmp_path / "data")}
    outputs = {"json": OutputFile(tmp_path / "a" / "b.json"), "csv": OutputFile("lattice/t.csv")}
    check_outputs({**inputs, **outputs, "out": OutputFile("sgbm/a.zip")})


@pytest.mark.slow
def test_json_or_csv_on_standard_output_replaces_the_table(
    archive: Path, tiny_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    outputs = ["--json", "r.json", "--csv", "r.csv"]
    with_table = run_in_process(main, "score", archive, "--data", tiny_root, *outputs)
    assert "rank" in with_table.stdout
    for option, file in (("--json", "r.json"), ("--csv", "r.csv")):
        finished = run_in_process(main, "score", archive, "--data", tiny_root, option, "-")
        assert (finished.returncode, finished.stdout) == (0, Path(file).read_text(encoding="utf-8"))
        assert finished.stderr
    for command in (("compare", archive, archive), ("table", archive)):
        option = "--csv" if command[0] == "table" else "--json"
        finished = run_in_process(main, *command, "--data", tiny_root, option, "-")
        assert finished.returncode == 0, finished.stderr
        assert json.loads(finished.stdout) if option == "--json" else finished.stdout.count(",") > 5
    run_in_process(main, "score", archive, "--data", tiny_root, "--json", "./-")
    assert {path.name for path in tmp_path.iterdir()} == {"r.json", "r.csv", "-"}


@pytest.mark.parametrize(
    "options",
    [
        ["--json", "-", "--csv", "-"],
        ["--json", "-", "--csv", "/dev/stdout"],
        ["--html", "-"],
        ["--extended-csv", "-"],
        ["--json", "loop"],
    ],
)
def test_impossible_streams_are_usage_errors(
    options: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("loop").symlink_to("loop")
    finished = run_in_process(main, "score", "a.zip", "--data", "absent", *options)
    assert finished.returncode == 2
    assert options[0] in finished.stderr or options[1] in finished.stderr
    assert "absent" not in finished.stderr.splitlines()[-1]


@pytest.mark.slow
def test_shell_can_redirect_and_substitute(archive: Path, tiny_root: Path, tmp_path: Path) -> None:
    score = f"{' '.join(BENCH)} score {archive} --data {tiny_root}"
    script = f"""
        {score} --json r.json --csv r.csv >table
        {score} --json - --csv >(cat >pipe.csv) >out.json
        echo first >appended
        {score} --json /dev/stdout >>appended
        {score} --json - | head -c 9 >head
        {score} --html /dev/null --json /dev/null >same-table
        {score} | head -n 1 >line
    """
    command = ["bash", "-c", f"set -u; {script}"]
    finished = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False)
    assert "Traceback" not in finished.stderr
    assert "Broken" not in finished.stderr
    read = {path.name: path.read_text(encoding="utf-8") for path in tmp_path.iterdir()}
    assert read["out.json"] == read["r.json"]
    assert read["pipe.csv"] == read["r.csv"]
    assert read["appended"] == f"first\n{read['r.json']}"
    assert read["head"] == read["r.json"][:9]
    assert read["same-table"] == read["table"]
    assert read["line"] == read["table"].splitlines(keepends=True)[0]
    assert Path("/dev/null").is_char_device()


@pytest.fixture
def pipe(tmp_path: Path) -> Iterator[tuple[Path, Callable[[], bytes]]]:
    """Yield a named pipe and a function that returns all that was written to it."""
    path = tmp_path / "pipe"
    os.mkfifo(path)
    with ThreadPoolExecutor(1) as pool:
        content = pool.submit(path.read_bytes)
        yield path, lambda: content.result(timeout=10)


def test_named_pipes_are_written_through(pipe: tuple[Path, Callable[[], bytes]], tmp_path: Path) -> None:
    path, received = pipe
    for target in (path, tmp_path / "file.zip"):
        with SubmissionWriter(target, method="m") as writer:
            writer.add("lattice/0000", np.ones((3, 4), np.float32))
    assert received() == (tmp_path / "file.zip").read_bytes()
    assert path.is_fifo()


def test_devices_stay_devices(tmp_path: Path) -> None:
    link = tmp_path / "null"
    link.symlink_to("/dev/null")
    for target in (Path("/dev/null"), link):
        write_output(target, b"content")
        with output_file(target) as temporary:
            temporary.write_bytes(b"content")
    assert link.is_symlink()
    assert Path("/dev/null").is_char_device()
    with pytest.raises(OutputError, match=r"^/dev/full: cannot be written: No space left on device$"):
        write_output(Path("/dev/full"), b"content")
    null = OutputFile("/dev/null")
    check_outputs({"json": null, "csv": null, "html": OutputFile(STANDARD_OUTPUT)})


def test_prediction_into_a_device_leaves_nothing_beside_it(tiny_root: Path) -> None:
    command = ("predict", "constant", "--data", tiny_root, "--config", "lattice-orbit", "--out", "/dev/null")
    finished = run_in_process(main, *command)
    assert (finished.returncode, finished.stdout) == (0, "/dev/null\n")
    assert Path("/dev/null").is_char_device()
    assert not [path for path in Path("/dev").iterdir() if "null." in path.name]


def test_link_stays_and_its_target_is_replaced(archive: Path, tiny_root: Path, tmp_path: Path) -> None:
    real, folder = tmp_path / "real.json", tmp_path / "links"
    folder.mkdir()
    real.write_text("old")
    kept = folder.parent / "kept"
    kept.hardlink_to(real)  # So that the number of its inode is not used again.
    for name, target in (("existing", "../real.json"), ("again", "existing"), ("dangling", "../new/file.json")):
        (folder / name).symlink_to(target)
        finished = run_in_process(main, "score", archive, "--data", tiny_root, "--json", folder / name)
        assert finished.returncode == 0, finished.stderr
        assert (folder / name).is_symlink()
    assert json.loads(real.read_text()) == json.loads((tmp_path / "new/file.json").read_text())
    assert not real.samefile(kept)
    (folder / "archive").symlink_to("../archive.zip")
    command = ("predict", "constant", "--data", tiny_root, "--config", "lattice-orbit")
    assert run_in_process(main, *command, "--out", folder / "archive").returncode == 0
    assert (folder / "archive").is_symlink()
    assert zipfile.is_zipfile(tmp_path / "archive.zip")
    assert {path.name for path in folder.iterdir()} == {"existing", "again", "dangling", "archive"}


def test_replaced_files_keep_their_permissions(tmp_path: Path) -> None:
    target, umask = tmp_path / "file", os.umask(0o027)
    try:
        write_output(target, "new")
        assert stat.S_IMODE(target.stat().st_mode) == 0o640
        target.chmod(0o604)
        write_output(target, "replaced")
        assert stat.S_IMODE(target.stat().st_mode) == 0o604
    finally:
        os.umask(umask)
    with pytest.raises(InputError, match="is a folder"):
        write_output(tmp_path, "x")


def assert_refused(finished: subprocess.CompletedProcess[str], path: Path, reason: str) -> None:
    """Check that a command ended with one line that names the path and why it cannot be written."""
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
        assert_refused(run_in_process(main, *command), disk.root, "No space left on device")
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
    new_disk: NewDisk, whole_archive: Path, tiny_root: Path, command: str, option: str, suffix: str
) -> None:
    if option == "--figure":
        pytest.importorskip("matplotlib")
    disk = new_disk(8 * KIB)
    target = disk.root / f"out.{suffix}"
    target.write_text("old")
    (disk.root / "other").write_bytes(bytes(4 * KIB))
    arguments: tuple[str | Path, ...] = (command, whole_archive, "--data", tiny_root, option, target)
    assert_refused(run_in_process(main, *arguments), target, "No space left on device")
    assert target.read_text() == "old"
    assert disk.files() == {target.name, "other"}
    disk.make_read_only()
    assert_refused(run_in_process(main, *arguments), target, "cannot be written")


@pytest.mark.slow
def test_full_standard_output_is_told_in_words(archive: Path, tiny_root: Path) -> None:
    for extra in ((), ("--json", "-")):
        command = [*BENCH, "score", archive, "--data", tiny_root, *extra]
        with Path("/dev/full").open("w") as full:
            finished = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
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
    assert_refused(finished, tmp_path, "File too large")
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
