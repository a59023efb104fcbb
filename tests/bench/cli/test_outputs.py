"""What a command would write is looked at before any work: nothing that is read is ever overwritten."""

from __future__ import annotations

from pathlib import Path

import pytest

from rebar_depth_bench import InputError
from rebar_depth_bench.cli.arguments import check_outputs
from rebar_depth_bench.cli.main import main


def test_an_input_is_never_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
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
        ["study", "anchor", str(archive), "--data", str(data), "--csv", str(archive)],
        ["predict", "constant", "--data", str(archive), "--out", str(archive)],
    ]
    for command in commands:
        assert main(command) == 2, command
        said = capsys.readouterr().err
        assert "which is read" in said or "inside" in said
    assert archive.read_bytes() == b"precious"
    assert (data / "manifest.json").read_text() == "precious"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"json": "x", "html": "./x"}, r"--html and --json both name x, expected a file each"),
        ({"json": "."}, r"--json names \., which is a folder"),
        (
            {"extended_csv": "file/x.csv"},
            r"--extended-csv names file/x\.csv, but .*file is a file: expected a folder",
        ),
    ],
)
def test_what_cannot_be_written_is_said_first(
    options: dict[str, str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    with pytest.raises(InputError, match=message):
        check_outputs({name: Path(value) for name, value in options.items()})


def test_new_files_and_new_folders_are_fine(tmp_path: Path) -> None:
    check_outputs({"json": tmp_path / "a" / "b.json", "csv": tmp_path / "c.csv", "data": str(tmp_path / "data")})
