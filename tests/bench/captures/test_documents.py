"""YAML as programs dump it: aliases, merge keys, Python tags, byte order marks and UTF-16."""

from __future__ import annotations

import codecs
import json
import time
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("cv2")

import numpy as np
import yaml

from rebar_depth_bench.base.errors import CalibrationError
from rebar_depth_bench.captures.camera_files import read_cameras
from rebar_depth_bench.captures.documents import parse_document

K = [[405.0, 0.0, 321.2], [0.0, 405.0, 197.5], [0.0, 0.0, 1.0]]
D = [-0.05, 0.01, 0.0001, -0.0001, 0.002]
PAIR: dict[str, Any] = {"K1": K, "K2": K, "D1": D, "D2": D, "R": np.eye(3).tolist(), "T": [-0.12, 0.0, 0.0]}


def read(folder: Path, content: bytes | str, name: str = "stereo.yaml") -> Any:
    (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_cameras(folder, ["a"], 640, 400, is_stereo=True).calibration


def problems(name: str, text: str) -> str:
    found: list[Any] = []
    assert parse_document(name, text.encode(), found) == {}
    return str(found[0])


ANCHORED = """\
base: &base {K1: &K [405.0, 0, 321.2, 0, 405.0, 197.5, 0, 0, 1], D1: &D [-0.05, 0.01, 0.0001, -0.0001, 0.002]}
<<: *base
K2: *K
D2: *D
R: [1, 0, 0, 0, 1, 0, 0, 0, 1]
T: [-0.12, 0, 0]
"""


@pytest.mark.parametrize("text", [yaml.dump(PAIR), yaml.dump(PAIR, default_flow_style=True), ANCHORED])
def test_aliases_and_merge_keys_are_read(text: str, tmp_path: Path) -> None:
    assert "*" in text
    calibration = read(tmp_path, text)
    for lens in (calibration.left, calibration.right):
        assert (lens.fx, lens.fy, lens.cx, lens.cy, lens.distortion) == (405.0, 405.0, 321.2, 197.5, tuple(D))
    assert calibration.baseline_m == 0.12


def laughs(levels: int, copies: int) -> str:
    """Return a text whose last list has ``copies ** levels`` values after the aliases are replaced."""
    lines = ["a0: &a0 [1, 1]"]
    lines += [f"a{at}: &a{at} [{', '.join([f'*a{at - 1}'] * copies)}]" for at in range(1, levels)]
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (laughs(30, 9), "line 5: the aliases (*) stand for more than 10000 values"),
        (laughs(40, 2), "line 12: the aliases (*) stand for more than 10000 values"),
        (laughs(1000, 1), "the aliases (*) stand for more than 10000 values"),
        ("[" * 100 + "]" * 100, "the values are nested too deep"),
        ("a: &a {b: [1, *a]}", "line 1: the alias *a stands for no complete value"),
        ("K1: *K\nK2: &K [1]", "line 1: the alias *K stands for no complete value"),
        ("<<: &a {<<: *a}", "line 1: the alias *a stands for no complete value"),
        (
            yaml.dump({"K1": np.eye(3)}),
            "line 1: a Python object (!!python/...), expected plain lists: array.tolist()",
        ),
        (
            yaml.dump({"fx": np.float64(3)}),
            "line 1: a Python object (!!python/...), expected plain lists: array.tolist()",
        ),
        (yaml.dump({"a": 1, "size": (640, 400)}), "line 2: a Python object (!!python/...)"),
        ("a: !<tag:yaml.org,2002:python/name:os.system> ''", "line 1: a Python object"),
    ],
)
def test_what_is_too_large_endless_or_of_python_is_refused_fast(text: str, words: str) -> None:
    start = time.process_time()
    assert words in problems("a.yaml", text)
    assert time.process_time() - start < 1


def test_many_values_without_aliases_are_read() -> None:
    found: list[Any] = []
    points = parse_document("a.yaml", yaml.dump({"points": list(range(20_000))}).encode(), found)["points"]
    assert len(points) == 20_000
    assert not found


ROWS = "".join(f"<{key}>{' '.join(map(str, np.ravel(value)))}</{key}>" for key, value in PAIR.items())
TEXTS = {
    "a.yaml": yaml.dump(PAIR),
    "a.json": json.dumps(PAIR),
    "a.xml": f"<opencv_storage>{ROWS}</opencv_storage>",
}


@pytest.mark.parametrize("name", TEXTS)
def test_byte_order_mark_is_skipped_and_utf_16_is_named(name: str, tmp_path: Path) -> None:
    assert read(tmp_path, codecs.BOM_UTF8 + TEXTS[name].encode(), name) == read(tmp_path, TEXTS[name], name)
    for encoding in ("utf-16-le", "utf-16-be"):
        with pytest.raises(CalibrationError, match=f"{name}: the text is UTF-16, expected UTF-8 text"):
            read(tmp_path, f"\ufeff{TEXTS[name]}".encode(encoding), name)


def test_byte_order_mark_before_the_header_of_opencv(tmp_path: Path) -> None:
    text = "%YAML:1.0\n---\n" + yaml.dump(PAIR)
    assert read(tmp_path, codecs.BOM_UTF8 + text.encode()) == read(tmp_path, text)
