"""Lines of keys: those of the table that a location names, in every format that is read."""

from __future__ import annotations

import time

import pytest

from rebar_depth_bench.base.errors import Problem
from rebar_depth_bench.base.validation import with_lines

TOML = '''\
# left.fx = 1, and [right]
title = """
[right]
fx = 2
"""
left = { K = [1], "cx" = 3 }  # cy = 4
note = "fx: 3"
right.fx = 8

[right.stereo]
rotation = [
  [1, 0],
  [0, 1]
]
angle = 15
[[pose]]
image = "a"
[pose.more]
x = 19
[[pose]]
  image = "b"
[pose.more]
x = 23
[lists]
item = [{ x = 25 }, { x = 25 }]
'''
YAML = """\
%YAML:1.0
cam0:
  # fx: 3
  model: "fx: 4"
  intrinsics: [1, 2,
    3]
cam1:
  T_cn_cnm1:
  - [1, 0]
  fx: 10
size: 11
"""
JSON = '{"left": {"cx": [1, {"deep": 2}]},\n "right":\n  {"cx": "fx:", "fx": 3},\n "size": [\n4,\n5], "width": 6}'
XML = """\
<?xml version="1.0"?>
<opencv_storage>
<!-- <M1>3</M1>
-->
<M2 type_id="opencv-matrix"><rows>5</rows>
  <data>6 6
  </data></M2>
<empty/><M1><rows>8</rows></M1>
</opencv_storage>
"""


@pytest.mark.parametrize(
    ("text", "lines"),
    [
        (TOML, {"left": 6, "left.K": 6, "left.cx": 6, "left.cy": None, "left.fx": None, "title": 2, "fx": None}),
        (TOML, {"right": 8, "right.fx": 8, "right.stereo.rotation 2: 1": 11, "right.stereo.angle": 15}),
        (
            TOML,
            {"pose": 16, "pose 1: image": 17, "pose 2": 20, "pose 2: image": 21, "pose 3: x": 16},
        ),
        (
            TOML,
            {"pose 1: more.x": 19, "pose 2: more.x": 23, "pose.x": None, "lists.item 2: x": 25},
        ),
        (YAML, {"cam0.intrinsics": 5, "cam0.fx": None, "cam1.fx": 10, "cam1": 7, "size": 11, "fx": None}),
        (JSON, {"left.cx": 1, "right.cx": 3, "left.fx": None, "right": 2, "right.fx": 3, "width": 6, "size 2": 4}),
        (XML, {"M1": 8, "M2.rows": 5, "M2.data": 6, "M1.data": None, "empty": 8, "rows": None}),
    ],
)
def test_lines_are_those_of_the_key_in_its_table(text: str, lines: dict[str, int | None]) -> None:
    problems = [Problem("invalid", f"a: {where}", "got 1") for where in lines]
    expected = ["got 1" if line is None else f"line {line}: got 1" for line in lines.values()]
    assert dict(zip(lines, [one.found for one in with_lines(problems, text.encode(), "a")], strict=True)) == dict(
        zip(lines, expected, strict=True)
    )


@pytest.mark.parametrize(
    ("line", "is_key"),
    [
        ("key{} = 1\n", True),
        ("{{a{}: 1, ", False),
        ("<a{}>", False),
        ("'''\n{}\"\"\"", False),
        ("<!-- {}", False),
        ('"\\"{}', False),
        ("[a{}.b.c]\n", False),
        ("  a{}:", False),
    ],
)
def test_time_does_not_grow_with_the_square_of_the_file(line: str, is_key: bool) -> None:
    count = 20_000
    text = "".join(line.format(index) for index in range(count))
    problems = [Problem("unknown", f"key{index}", "not a known key") for index in range(count)]
    start = time.process_time()
    located = with_lines(problems, text.encode())
    assert time.process_time() - start < 10  # 0.4 s; with a search for each problem more than 60 s.
    assert located[-1].found.startswith(f"line {count}: ") == is_key
