"""Tests of the check of output paths that precedes any work: input files are never overwritten."""

from __future__ import annotations

from pathlib import Path

import pytest

from rebar_depth_bench import InputError
from rebar_depth_bench.cli.console import InputFile, InputFolder, OutputArchive, OutputFile, check_outputs
from rebar_depth_bench.cli.main import main


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
    ("options", "message"),
    [
        ({"json": "x", "html": "./x"}, r"--html and --json both name x, expected different files"),
        ({"json": "."}, r"--json names \., which is a folder"),
        (
            {"extended_csv": "file/x.csv"},
            r"--extended-csv names file/x\.csv, but .*file is a file: expected a folder",
        ),
    ],
)
def test_unwritable_output_raises_input_error(
    options: dict[str, str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    with pytest.raises(InputError, match=message):
        check_outputs({name: OutputFile(value) for name, value in options.items()})


def test_method_file_and_prediction_folder_are_inputs(tmp_path: Path) -> None:
    method, predictions = tmp_path / "mine.py", tmp_path / "predictions"
    method.touch()
    predictions.mkdir()
    with pytest.raises(InputError, match="which is an input"):
        check_outputs({"method": InputFile(f"{method}:METHOD"), "out": OutputFile(method)})
    with pytest.raises(InputError, match="inside"):
        check_outputs({"maps": [InputFolder(predictions)], "csv": OutputFile(predictions / "t.csv")})
    check_outputs({"maps": [InputFolder(predictions)], "out": OutputArchive(predictions / "a.zip")})


def test_folder_named_like_config_or_method_is_no_input(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("lattice", "sgbm"):
        Path(name).mkdir()
    inputs = {"config": ["lattice"], "method": InputFile("sgbm")}
    check_outputs({**inputs, "csv": OutputFile("lattice/t.csv"), "out": OutputFile("sgbm/a.zip")})


def test_new_files_in_new_folders_are_accepted(tmp_path: Path) -> None:
    outputs = {"json": OutputFile(tmp_path / "a" / "b.json"), "csv": OutputFile(tmp_path / "c.csv")}
    check_outputs({**outputs, "data": InputFolder(tmp_path / "data")})
