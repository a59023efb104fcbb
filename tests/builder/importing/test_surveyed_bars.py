"""``bars.csv`` as surveyors and spreadsheets write it."""

from __future__ import annotations

from pathlib import Path

import pytest

from dataset_builder.importing.survey_check import read_bars_file
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.data.bars import Bar

HEADER = "bar_id,role,diameter_m,x_m,y_m,z_m"
PLAIN = f"""{HEADER}
7,main,0.016,0.25,-0.1,2
3,stirrup,0.008,0,0,0
7,main,0.016,0.5,-0.1,2
3,stirrup,0.008,1e-3,0,0
"""
BARS = (
    Bar(3, "stirrup", 0.008, ((0, 0, 0), (0.001, 0, 0))),
    Bar(7, "main", 0.016, ((0.25, -0.1, 2), (0.5, -0.1, 2))),
)
SEMICOLONS = PLAIN.replace(",", ";")

READ: dict[str, str] = {
    "plain": PLAIN,
    "byte order mark and CRLF": "\ufeff" + PLAIN.replace("\n", "\r\n"),
    "old Macintosh": PLAIN.replace("\n", "\r"),
    "semicolons": SEMICOLONS,
    "tabs": PLAIN.replace(",", "\t"),
    "Excel": "\ufeffsep=;\r\n" + SEMICOLONS.replace("\n", "\r\n"),
    "names as people write them": SEMICOLONS.replace("bar_id", "Bar ID")
    .replace("diameter_m", "Diameter [m]")
    .replace("x_m;y_m;z_m", "X (m);Y (m);Z_M"),
    "quotes": PLAIN.replace("main", '"main"').replace("0.016", '"0.016"'),
    "blanks": PLAIN.replace(",", " , ").replace("\n", " \n\n"),
    "empty cells at the end": SEMICOLONS.replace("\n", ";;\n").replace("z_m;;", "z_m") + ";;;;;;;\n",
    "other columns": "\n".join(
        f"{line},{end}" for line, end in zip(PLAIN.split(), ("Remark", "a", "", "b", ""), strict=True)
    ),
}


@pytest.mark.parametrize("name", READ)
def test_bars_are_read(name: str, tmp_path: Path) -> None:
    (tmp_path / "bars.csv").write_bytes(READ[name].encode())
    assert read_bars_file(tmp_path / "bars.csv") == BARS


LINE = "1,main,0.016,0,0,0\n1,main,0.016,1,0,0\n"
REFUSED: dict[str, tuple[str | bytes, str]] = {
    "empty": ("", "bars.csv"),
    "header alone": (f"{HEADER}\n", "bars.csv"),
    "UTF-16": (PLAIN.encode("utf-16"), "the text is UTF-16, expected UTF-8"),
    "Windows-1252": (PLAIN.replace("main", "Bügel").encode("cp1252"), "is not UTF-8"),
    "decimal commas between commas": (f"{HEADER}\n1,main,0,016,1,5,2,5,0\n", "line 2 has 9 cells, expected 6"),
    # pandas takes the first of seven cells as the name of the line, and shifts the others.
    "one more cell in each line": (
        f"{HEADER}\n" + LINE.replace("0.016", "0,016"),
        "line 2 has 7 cells, expected 6",
    ),
    "quoted decimal commas between commas": (f'{HEADER}\n1,main,"0,016",0,0,0\n', "numbers with decimal points"),
    "decimal commas": (SEMICOLONS.replace(".", ","), "got 7, 0,016, 0,25, -0,1, 2, expected .* decimal"),
    "thousands": (SEMICOLONS.replace("0.25", "5.800.000"), "line 2: got 7, 0.016, 5.800.000, -0.1, 2, expected"),
    "comma in an id": (SEMICOLONS.replace("7;", "1,000;"), "expected a bar_id from 1 to 65535"),
    "units in cells": (PLAIN.replace("0.25", "0.25 m"), "numbers with decimal points"),
    "millimetres in the header": (PLAIN.replace("x_m", "x_mm"), "without one x_m, expected the columns bar_id"),
    "no header": (LINE, "line 1 is 1,main,0.016,0,0,0, without one bar_id, one diameter_m"),
    "blanks between columns": (PLAIN.replace(",", " "), "between commas, semicolons or tabs"),
    "a column twice": (PLAIN.replace("role", "X [m]"), "without one x_m, expected the columns"),
    "diameter in millimetres": (PLAIN.replace("0.016", "16"), "a diameter up to 0.5 m"),
    "survey grid": (
        PLAIN.replace("-0.1", "5800123.25"),
        r"got 7, 0.016, 0.25, 5800123.25, 2, expected less than 1e\+06",
    ),
    "role with a control character": (PLAIN.replace("main", "ma\x01in"), "bar 7: has the role"),
    "open quote": (PLAIN + '"', "expected a CSV file"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_bars_are_refused_in_words(name: str, tmp_path: Path) -> None:
    content, words = REFUSED[name]
    (tmp_path / "bars.csv").write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError, match=words):
        read_bars_file(tmp_path / "bars.csv")


@pytest.mark.parametrize("line", ["x,main,0.016,0,0,0\n", "1,main\n"])
def test_number_of_problems_is_limited(line: str, tmp_path: Path) -> None:
    (tmp_path / "bars.csv").write_text(f"{HEADER}\n{20_000 * line}")
    with pytest.raises(InputError) as caught:
        read_bars_file(tmp_path / "bars.csv")
    assert len(caught.value.problems) == 100
