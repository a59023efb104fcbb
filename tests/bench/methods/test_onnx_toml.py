"""Validation of the TOML files of ONNX methods: every problem is reported in one error."""

from __future__ import annotations

import re
from pathlib import Path
from textwrap import dedent
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rebar_depth_bench.cli.main import main
from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods import find_method
from rebar_depth_bench.methods.onnx import spec as onnx_toml
from rebar_depth_bench.validation import FieldType, TableReader, choice, number, text, three_numbers, whole_number
from tests.bench.methods.onnx_models import write_mixer_model, write_toml

INVALID_EDITS = [
    ("licence = 'MIT'", "", "licence is missing, expected the licence of the model's weights"),
    ("'MIT'", "'  '", "licence: got ' ', expected the licence"),
    ("'MIT'", "7", "licence: got 7, expected"),
    ("'model.onnx'", "'no.onnx'", "model: no such file: "),
    ("'model.onnx'", "'.'", "model: no such file: "),
    ("'model.onnx'", f"'{'x' * 900}'", "model: no such file: "),
    ("'model.onnx'", "'a\\u0000b'".replace("'", '"'), "model: got 'a\\x00b', expected the ONNX file's path"),
    ("licence", "naem = 'x'\nlicence", "'naem' is not a known key, did you mean name?"),
    ("[output]", "[outptu]", "'outptu' is not a known key, did you mean output?\n  - output is missing"),
    ("[input]\n", "input = 3\n[x]\n", "input: got 3, expected a table"),
    ("width = 6", "", "[input] width is missing, expected a whole number from 1 to 8192"),
    ("width = 6\nheight = 4", "", "[input] size: got neither, expected width and height, or longest_side"),
    ("width = 6", "width = 6\nlongest_side = 9", "[input] size: got both, expected"),
    ("width = 6", "width = 6.0", "[input] width: got 6.0, expected a whole number"),
    ("width = 6", "width = true", "[input] width: got True"),
    ("height = 4", "height = 0", "[input] height: got 0"),
    ("height = 4", "height = 9999", "[input] height: got 9999"),
    (
        "width = 6\nheight = 4",
        "longest_side = 500\nmultiple_of = 14",
        "got 500, expected a multiple of multiple_of",
    ),
    ("width = 6\nheight = 4", "multiple_of = 14", "[input] longest_side is missing"),
    ("'stretch'", "'crop'", '[input] resize: got \'crop\', expected "stretch" or "pad"'),
    ("range = 255", "range = 256", "[input] range: got 256, expected 1 or 255"),
    ("range = 255", "range = true", "[input] range: got True, expected 1 or 255"),
    ("range = 255", "", "[input] range is missing, expected 1 or 255"),
    ("range = 255", "range = 1\nmean = [123.7, 116.3, 103.5]", "expected three numbers from 0 to 1: red, green"),
    ("range = 255", "range = 255\nstd = [0.229, 0.224, 0.225]", "expected three numbers from 1 to 255"),
    ("range = 255", "range = 255\nmean = [1, 2]", "[input] mean: got [1, 2], expected three numbers"),
    ("range = 255", "range = 255\nstd = [1, 2, nan]", "[input] std: got [1, 2, nan], expected"),
    ("range = 255", "range = 255\nstd = [0, 0, 0]", "[input] std: got [0, 0, 0], expected"),
    ("range = 255", "range = 255\nlayout = 'NHWC'", "[input] 'layout' is not a known key, expected only width"),
    ("'depth'", "'disparity'", '[output] meaning: got \'disparity\', expected "depth", "inverse-depth", "canon'),
    ("'depth'", "'canonical-depth'", "[output] focal_canonical_px is missing, expected a number from 1 to 100000"),
    ("'depth'", "'depth'\nfocal_canonical_px = 1000", 'expected none: meaning "depth" does not use it'),
    ("'depth'", "'depth'\nscale = 0", "[output] scale: got 0, expected a number above 0"),
    (
        "'depth'",
        "'depth'\nscale = inf",
        "[output] scale: got a number with a magnitude above 1e+09, expected a number above 0",
    ),
    ("'depth'", "'depth'\nscale = '1'", "[output] scale: got '1', expected a number above 0"),
    ("'depth'", "'depth'\nmin_m = 3\nmax_m = 2", "[output] min_m: got 3, expected less than max_m, 2"),
    ("'depth'", "'depth'\nname = 'y'\nindex = 0", "[output] has name and index, expected one of them"),
    ("'depth'", "'depth'\nindex = -1", "[output] index: got -1, expected a whole number from 0"),
    ("'depth'", "'depth'\nat_input_size = 1", "[output] at_input_size: got 1, expected true or false"),
    ("'depth'", "'depth'\nresize = 'area'", '[output] resize: got \'area\', expected "nearest" or "bilinear"'),
    ("range = 255", f"range = {'9' * 4000}", "[input] range: got 9999"),
    ("range = 255", f"range = {'9' * 5000}", "is not a valid TOML file"),
    ("range = 255", f"range = {'[' * 5000}", "is not a valid TOML file"),
    ("range = 255", "range = 255\nrange = 1", "is not a valid TOML file: Cannot overwrite a value"),
]


@pytest.mark.parametrize(("old", "new", "words"), INVALID_EDITS)
def test_invalid_toml_raises_with_reason(old: str, new: str, words: str, tmp_path: Path) -> None:
    write_mixer_model(tmp_path)
    path = write_toml(tmp_path)
    find_method(str(path))
    content = path.read_text()
    assert old in content
    path.write_text(content.replace(old, new, 1))
    with pytest.raises(MethodError, match=re.escape(words)) as caught:
        find_method(str(path))
    assert str(caught.value).startswith(f"{path}: ")
    assert max(map(len, str(caught.value).splitlines())) < 1500


def test_all_problems_are_reported_at_once(tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_text("nmae = 1\n[output]\n")
    with pytest.raises(MethodError) as caught:
        find_method(str(path))
    assert [line.split(",")[0] for line in str(caught.value).splitlines()[1:]] == [
        "  - 'nmae' is not a known key",
        "  - model is missing",
        "  - licence is missing",
        "  - input is missing",
        "  - [output] meaning is missing",
    ]


def test_example_in_docstring_is_valid(tmp_path: Path) -> None:
    write_mixer_model(tmp_path)
    path = tmp_path / "shown.toml"
    path.write_text(dedent((onnx_toml.__doc__ or "").split("::\n", 1)[1]))
    spec = onnx_toml.read_onnx_toml(path)
    assert spec.input.size_px == (1064, 616)
    assert (spec.output.focal_canonical_px, spec.output.name_or_index) == (1000, "predicted_depth")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "no such file, expected a TOML file that describes an ONNX model"),
        (b"\xff\xfe", "byte 0 is not UTF-8 text"),
        (b"#" * (1 << 21), "is larger than 1048576 bytes"),
        (b"\x00", "is not a valid TOML file"),
    ],
)
def test_unreadable_file_raises_with_reason(content: bytes | None, words: str, tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(MethodError, match=words):
        find_method(str(path))
    path.unlink(missing_ok=True)
    path.mkdir()
    with pytest.raises(MethodError, match=r"cannot be read|no such file"):
        find_method(str(path))


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=2),
)
FIELD_TYPES: list[FieldType[Any]] = [
    number(0, 9),
    whole_number(1, 9),
    text(5),
    choice({1: "1", 255: "255"}),
    three_numbers(0, 1),
]


@given(value=VALUES, kind=st.sampled_from(FIELD_TYPES))
def test_any_value_is_accepted_or_gives_one_line(value: object, kind: FieldType[Any]) -> None:
    problems: list[str] = []
    parsed = TableReader({"key": value}, "[t] ", problems).required("key", kind, "fallback")
    assert (parsed == "fallback") == bool(problems)
    assert all(problem.startswith("[t] key: got ") and "\n" not in problem for problem in problems)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(content=st.binary(max_size=200) | st.text(alphabet="[]\"'=.{}\n\\ab1,#", max_size=80).map(str.encode))
def test_random_bytes_raise_method_error(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "x.toml").write_bytes(content)
    with pytest.raises(MethodError):
        find_method(str(tmp_path / "x.toml"))


def test_predict_with_bad_toml_exits_with_status_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_toml(tmp_path)
    assert main(["predict", str(path), "--data", str(tmp_path), "--out", str(tmp_path / "a.zip")]) == 2
    assert "model: no such file" in capsys.readouterr().err
