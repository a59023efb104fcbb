"""Validation of the TOML files of ONNX methods: every problem is reported in one error."""

from __future__ import annotations

from pathlib import Path
from textwrap import dedent
from typing import Annotated

import pytest

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

from hypothesis import given, settings
from hypothesis import strategies as st

from rebar_depth_bench.base.errors import MethodError, Problem
from rebar_depth_bench.base.validation import (
    StrictModel,
    Triple,
    number,
    one_of,
    text,
    three_numbers,
    validate_table,
    whole_number,
)
from rebar_depth_bench.methods import find_method
from rebar_depth_bench.methods.onnx import spec as onnx_toml
from tests.bench.methods.onnx_models import write_mixer_model, write_toml

NO_SIZE = "expected width and height, or longest_side"
LONGEST = "longest_side = 50"
INVALID_EDITS = [
    ("licence = 'MIT'", "", "missing licence", "expected the licence of the model's weights"),
    ("'MIT'", "'  '", "invalid licence", "got ' '"),
    ("'model.onnx'", "'no.onnx'", "missing model", "no such file: "),
    ("'model.onnx'", f"'{'x' * 900}'", "missing model", "no such file: "),
    ("'model.onnx'", '"a\\u0000b"', "invalid model", "got 'a\\x00b', expected the ONNX file's path"),
    ("licence", "naem = 'x'\nlicence", "unknown naem", "expected name"),
    ("[output]", "[outptu]", "missing output, unknown outptu", "expected a table"),
    ("[input]\n", "input = 3\n[x]\n", "invalid input, unknown x", "got 3, expected a table"),
    ("width = 6", "", "missing input.longest_side", f"got height, {NO_SIZE}"),
    ("width = 6\nheight = 4", "", "missing input.longest_side", NO_SIZE),
    ("width = 6", "width = 6\nlongest_side = 9", "conflict input.longest_side", NO_SIZE),
    ("width = 6", "width = 6\nmultiple_of = 1", "conflict input.longest_side", NO_SIZE),
    ("width = 6", "width = 6.0", "invalid input.width", "got 6.0, expected a whole number"),
    ("height = 4", "height = 0", "invalid input.height", "got 0"),
    ("height = 4", "height = 9999", "invalid input.height", "got 9999"),
    ("width = 6\nheight = 4", f"{LONGEST}\nmultiple_of = 14", "invalid input.longest_side", "multiple_of, 14"),
    ("width = 6\nheight = 4", "multiple_of = 14", "missing input.longest_side", NO_SIZE),
    ("'stretch'", "'crop'", "invalid input.resize", 'got \'crop\', expected "stretch" or "pad"'),
    ("range = 255", "range = 256", "invalid input.range", "got 256, expected 1 or 255"),
    ("range = 255", "", "missing input.range", "expected 1 or 255"),
    ("range = 255", "range = 1\nmean = [123.7, 116.3, 103.5]", "invalid input.mean", "from 0 to 1: red"),
    ("range = 255", "range = 255\nstd = [0.229, 0.224, 0.225]", "invalid input.std", "from 1 to 255"),
    ("range = 255", "range = 255\nmean = [1, 2]", "invalid input.mean", "got [1, 2], expected three numbers"),
    ("range = 255", "range = 255\nstd = [1, 2, nan]", "invalid input.std", "nan]"),
    ("range = 255", "range = 255\nstd = [0, 0, 0]", "invalid input.std", "expected three numbers from 1 to 255"),
    ("range = 255", "range = 255\nlayout = 'NHWC'", "unknown input.layout", "expected one of width"),
    ("'depth'", "'disparity'", "invalid output.meaning", 'expected "depth", "inverse-depth", "canon'),
    ("'depth'", "'canonical-depth'", "missing output.focal_canonical_px", "expected a number from 1 to 100000"),
    ("'depth'", "'depth'\nfocal_canonical_px = 1000", "conflict output.focal_canonical_px", 'meaning "depth"'),
    ("'depth'", "'depth'\nscale = 0", "invalid output.scale", "got 0, expected a number above 0"),
    ("'depth'", "'depth'\nscale = inf", "invalid output.scale", "got inf"),
    ("'depth'", "'depth'\nresize = 'nearest'", "unknown output.resize", "expected one of meaning"),
    ("range = 255", f"range = {'9' * 4000}", "invalid input.range", "got 9999"),
    ("range = 255", "range = 255\nrange = 1", "syntax ", "not a valid TOML file: Cannot overwrite a value"),
]


def located(problems: tuple[Problem, ...]) -> list[str]:
    return [f"{problem.code} {problem.where}" for problem in problems]


@pytest.mark.parametrize(("old", "new", "locations", "words"), INVALID_EDITS)
def test_invalid_toml_raises_with_reason(old: str, new: str, locations: str, words: str, tmp_path: Path) -> None:
    write_mixer_model(tmp_path)
    path = write_toml(tmp_path)
    find_method(str(path))
    content = path.read_text()
    assert old in content
    path.write_text(content.replace(old, new, 1))
    with pytest.raises(MethodError) as caught:
        find_method(str(path))
    assert located(caught.value.problems) == locations.split(", ")
    assert words in str(caught.value.problems[0])
    assert str(caught.value).startswith(f"{path}: ")
    assert max(map(len, str(caught.value).splitlines())) < 1500


@pytest.mark.parametrize(
    ("content", "locations"),
    [
        (
            "nmae = 1\n[output]\n",
            "missing model, missing licence, missing input, missing output.meaning, unknown nmae",
        ),
        (
            "model = 3\nlicence = 'MIT'\n[input]\nwidth = 0\nrange = 3\nresize = 'pad'\n",
            "invalid model, invalid input.width, invalid input.range, missing output",
        ),
    ],
)
def test_all_problems_are_reported_at_once(content: str, locations: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(content)
    with pytest.raises(MethodError) as caught:
        find_method(str(path))
    assert located(caught.value.problems) == locations.split(", ")


def test_example_in_docstring_is_valid(tmp_path: Path) -> None:
    write_mixer_model(tmp_path)
    path = tmp_path / "shown.toml"
    path.write_text(dedent((onnx_toml.__doc__ or "").split("::\n", 1)[1]))
    spec = onnx_toml.read_onnx_toml(path)
    assert (spec.input.width, spec.input.height) == (1064, 616)
    assert (spec.output.focal_canonical_px, spec.output.name) == (1000, "predicted_depth")


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=2),
)


class Fields(StrictModel):
    """One field for each description of valid values."""

    real: Annotated[float, number(0, 9)] = 1
    whole: Annotated[int, whole_number(1, 9)] = 1
    line: Annotated[str, text(5)] = "line"
    choice: Annotated[int, one_of(1, 255)] = 1
    triple: Annotated[Triple, three_numbers(0, 1)] = (0, 0, 0)


@settings(max_examples=50)
@given(value=VALUES, key=st.sampled_from([*Fields.model_fields]))
def test_any_value_is_accepted_or_gives_one_line(value: object, key: str) -> None:
    problems: list[Problem] = []
    parsed = validate_table(Fields, {key: value}, problems, "t")
    assert located(tuple(problems)) == ([f"invalid t.{key}"] if parsed is None else [])
    assert all(problem.found.startswith("got ") and "\n" not in str(problem) for problem in problems)
