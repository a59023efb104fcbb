"""Outputs that are no plain files: standard output, devices, pipes, descriptors and links."""

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
from rebar_depth_bench.cli.console import InputFile, OutputFile, check_outputs
from rebar_depth_bench.cli.main import main
from tests.commands import run_in_process

BENCH = [sys.executable, "-m", "rebar_depth_bench"]


@pytest.fixture(scope="module")
def archive(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an archive of the two views of ``lattice-orbit``."""
    path = tmp_path_factory.mktemp("streams") / "constant.zip"
    command = ("predict", "constant", "--data", tiny_root, "--config", "lattice-orbit", "--out", path)
    assert run_in_process(main, *command).returncode == 0
    return path


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
        ["--json", "/dev/fd/987"],
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


def test_named_pipes_are_written_through(pipe: tuple[Path, Callable[[], bytes]]) -> None:
    path, received = pipe
    write_output(path, "zß")
    assert received() == "zß".encode()
    assert path.is_fifo()


def test_archives_are_written_through_pipes(pipe: tuple[Path, Callable[[], bytes]], tmp_path: Path) -> None:
    path, received = pipe
    for target in (path, tmp_path / "file.zip"):
        with SubmissionWriter(target, method="m") as writer:
            writer.add("lattice/0000", np.ones((3, 4), np.float32))
    assert received() == (tmp_path / "file.zip").read_bytes()


def test_open_descriptors_are_written_where_they_stand(tmp_path: Path) -> None:
    target = tmp_path / "file"
    with target.open("wb", buffering=0) as stream:
        stream.write(b"before ")
        (tmp_path / "link").symlink_to(f"/dev/fd/{stream.fileno()}")
        write_output(tmp_path / "link", "written")
        stream.write(b" after")
    assert target.read_bytes() == b"before written after"


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


def test_link_to_an_input_is_refused(archive: Path, tmp_path: Path) -> None:
    link = tmp_path / "link"
    link.symlink_to(archive)
    with pytest.raises(InputError, match="which is an input"):
        check_outputs({"archive": InputFile(archive), "json": OutputFile(link)})


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
