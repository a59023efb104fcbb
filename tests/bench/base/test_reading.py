"""Strict JSON and TOML, regular files only, and names that stay in their folder."""

from __future__ import annotations

import os
import socket
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest

from rebar_depth_bench.base import limits
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.base.reading import (
    MAX_NESTING,
    check_no_links,
    open_regular,
    parse_json,
    parse_toml,
    path_below,
    read_file,
    remove_file,
    remove_folder,
)
from rebar_depth_bench.base.terminal import terminal_text
from rebar_depth_bench.base.writing import write_text
from rebar_depth_bench.captures.calibration_files import read_calibration
from rebar_depth_bench.captures.images import read_image, read_image_shape
from rebar_depth_bench.data.bars import read_bars
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.detections.reading import read_detections
from rebar_depth_bench.methods.onnx.spec import read_onnx_toml


def test_file_above_the_limit_is_not_read(tmp_path: Path) -> None:
    large = tmp_path / "large.json"
    with large.open("wb") as stream:
        stream.truncate(limits.JSON_BYTES.value() + 1)  # Sparse: it occupies no space.
    tracemalloc.start()
    with pytest.raises(InputError) as caught:
        read_file(large, limits.JSON_BYTES, "a manifest", InputError)
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert [problem.code for problem in caught.value.problems] == ["size"]
    assert peak_bytes < 1 << 20


@pytest.mark.parametrize(
    ("content", "code"),
    [
        (b'{"a": 1, "a": 2}', "duplicate"),
        (b'{"x": [{"a": 1, "b": {}, "a": 1}]}', "duplicate"),
        (b"[1e999]", "syntax"),
        (b"[NaN]", "syntax"),
        (b'["\\ud800"]', "syntax"),
        (b'"\xff"', "syntax"),
        ("{}".encode("utf-16"), "syntax"),
        (b"\xef\xbb\xbf\xef\xbb\xbf{}", "syntax"),
        (b"1" * 4400, "syntax"),
        (b"", "syntax"),
        (b'{"a": 1} x', "syntax"),
        (b"[" * 100_000, "size"),
        (b"[" * (MAX_NESTING + 1) + b"]" * (MAX_NESTING + 1), "size"),
        (b'{"a":' * 500 + b"1" + b"}" * 500, "size"),
    ],
)
def test_unclear_or_hostile_json_is_refused(content: bytes, code: str) -> None:
    value, [problem] = parse_json(content, "here")
    assert (value, problem.code, problem.where) == (None, code, "here")
    assert str(problem).isprintable()


def test_json_at_the_nesting_limit_is_read_and_constants_are_named() -> None:
    value, problems = parse_json(b"[" * MAX_NESTING + b"]" * MAX_NESTING)
    assert isinstance(value, list)
    assert problems == []
    assert "-Infinity is not JSON" in parse_json(b"[-Infinity]")[1][0].found


@pytest.mark.parametrize(
    "content",
    [
        ".".join(["a"] * 30_000) + " = 1",
        '"=".a.' * 10_000 + "a = 1",
        "1.1 . " * 20_000 + "1 = 1",
        "[" + ".".join(["a"] * 30_000) + "]",
        "x = {" + ".".join(["a"] * 30_000) + " = 1}",
        "x = " + "[" * 100_000,
        "x = " + "{a = " * 100 + "1" + "}" * 100,
    ],
)
def test_toml_that_takes_tomllib_seconds_is_refused_at_once(content: str) -> None:
    start = time.process_time()
    values, [problem] = parse_toml(content.encode())
    assert (values, problem.code) == ({}, "size")
    assert time.process_time() - start < 1


def test_long_lists_of_numbers_are_sound_toml() -> None:
    assert parse_toml(b"a = [" + b"-1.25, " * 50_000 + b"]") == ({"a": [-1.25] * 50_000}, [])


def test_only_regular_files_and_links_to_them_are_opened(tmp_path: Path) -> None:
    file, link, pipe = tmp_path / "file", tmp_path / "link", tmp_path / "pipe"
    file.write_bytes(b"content")
    link.symlink_to(file)
    os.mkfifo(pipe)
    for path in (file, link):
        with open_regular(path) as stream:
            assert stream.read() == b"content"
    for path in (pipe, tmp_path, Path("/dev/zero"), tmp_path / "missing", Path("a\0b")):
        with pytest.raises(OSError, match=r"."):
            open_regular(path)
        with pytest.raises(InputError) as raised:
            read_file(path, limits.TOML_BYTES, "a TOML file", InputError)
        assert raised.value.problems[0].code == ("missing" if path.name == "missing" else "unreadable")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "socket"))
        with pytest.raises(OSError, match=r"."):
            open_regular(tmp_path / "socket")


LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"4d" * 32 + b"\nsize 12345\n"
"""Pointer file, as the specification of git LFS defines it: the version comes first."""


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("manifest.json", lambda path: open_folder(path.parent)),
        ("bars.parquet", read_bars),
        ("left.png", read_image_shape),
        ("left.jpg", lambda path: read_image(path, (3, 4))),
        ("rig.toml", lambda path: read_calibration(path, 4, 3)),
        ("rows.csv", lambda path: read_detections(path, {})),
    ],
)
def test_pointer_of_git_lfs_is_named(tmp_path: Path, name: str, read: Callable[[Path], object]) -> None:
    path = tmp_path / name
    path.write_bytes(LFS)
    with pytest.raises(InputError, match=r"is a pointer of git LFS, .*git lfs pull"):
        read(path)
    path.write_bytes(LFS[:40])  # Any other text is as it was.
    with pytest.raises(InputError) as raised:
        read(path)
    assert "LFS" not in str(raised.value)


TEXTS: list[tuple[str, str, Callable[[Path], object]]] = [
    ("manifest.json", "{}", lambda path: open_folder(path.parent)),
    ("rows.csv", "view_id,x,y,z\nmat/0,1,2,3\n", lambda path: read_detections(path, {})),
    ("model.toml", "sumary = 1\n", read_onnx_toml),
]


@pytest.mark.parametrize(("name", "text", "read"), TEXTS)
def test_texts_of_windows_are_read_or_named(
    tmp_path: Path, name: str, text: str, read: Callable[[Path], object]
) -> None:
    """PowerShell 5.1 writes UTF-16 with ``>``, and a byte order mark with Set-Content -Encoding utf8."""
    messages = []
    for encoding in ("utf-8", "utf-8-sig", "utf-16", "utf-16-be"):
        mark = "\ufeff" if encoding == "utf-16-be" else ""
        (tmp_path / name).write_bytes((mark + text).encode(encoding))
        with pytest.raises(InputError) as raised:  # Other keys are expected, so what was read is in the message.
            read(tmp_path / name)
        messages.append(str(raised.value))
    assert messages[0] == messages[1]
    assert ["UTF-16" in message for message in messages] == [False, False, True, True]


def test_variable_raises_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"12345")
    monkeypatch.setenv("REBAR_MAX_TOML_BYTES", "4")
    with pytest.raises(InputError) as raised:
        read_file(file, limits.TOML_BYTES, "a TOML file", InputError)
    assert raised.value.problems[0].code == "size"
    assert "REBAR_MAX_TOML_BYTES" in str(raised.value)
    monkeypatch.setenv("REBAR_MAX_TOML_BYTES", "5")
    assert read_file(file, limits.TOML_BYTES, "a TOML file", InputError) == b"12345"
    for text in ("", "0", "-1", "1e3", "x", "9" * 30):
        monkeypatch.setenv("REBAR_MAX_TOML_BYTES", text)
        with pytest.raises(InputError):
            limits.TOML_BYTES.value()


def test_only_names_below_a_folder_become_paths() -> None:
    assert path_below(Path("/root"), "lattice/0000") == Path("/root/lattice/0000")
    assert path_below(Path("/root"), "pier-2/test-00000-of-00001.parquet").parts[-2] == "pier-2"
    escaping = ["", ".", "..", "../x", "a/../x", "/x", "a//b", "a/", ".x", "a/.x"]
    for name in (*escaping, "a\\b", "a\0", "a\n", "é", "a" * 201, "a/" * 10 + "a"):
        with pytest.raises(InputError):
            path_below(Path("/root"), name)


def test_links_are_never_written_through_or_deleted(tmp_path: Path) -> None:
    outside, root = tmp_path / "outside", tmp_path / "root"
    outside.mkdir()
    root.mkdir()
    (outside / "file").write_bytes(b"kept")
    (root / "folder").symlink_to(outside)
    (root / "file").symlink_to(outside / "file")
    for name in ("folder/file", "folder", "file"):
        with pytest.raises(InputError):
            check_no_links(root, name)
    remove_file(root / "file")
    remove_folder(root / "folder")
    assert (outside / "file").read_bytes() == b"kept"
    assert sorted(path.name for path in root.iterdir()) == ["file", "folder"]
    check_no_links(root, "other/file")


def test_terminal_text_shows_escape_sequences_and_truncates() -> None:
    shown = terminal_text("one\x1b[2J\u202e\n" + "x" * 10_000 + "\n" * 1000)
    assert "\x1b" not in shown
    assert "\\x1b[2J\\u202e" in shown
    assert len(shown) < 3000
    assert terminal_text("a: 2 problems\n  - é") == "a: 2 problems\n  - é"


def test_output_never_replaces_a_device_or_a_pipe(tmp_path: Path) -> None:
    """As root, a rename over ``/dev/null`` replaced the device by a file."""
    pipe, link = tmp_path / "pipe", tmp_path / "link"
    os.mkfifo(pipe)
    link.symlink_to("/dev/null")
    for target in (pipe, link):
        with pytest.raises(InputError):
            write_text(target, "content")
    assert pipe.is_fifo()
    assert link.is_symlink()
