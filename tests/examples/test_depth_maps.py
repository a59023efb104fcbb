"""Depth maps of folders and archives: formats, names, digests and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from depth_maps import open_maps
from rebar_depth_bench import SubmissionWriter
from rebar_depth_bench.base.errors import InputError
from tests.bench.submission.zips import exr, npz, png

DEPTH = np.linspace(0.5, 2.0, 12).reshape(3, 4).astype(np.float32)
VIEWS = {"walk/a": (3, 4), "walk/b": (3, 4)}


def test_folder_reads_every_format(tmp_path: Path) -> None:
    units = np.round(DEPTH.astype(np.float64) * 1000)
    (tmp_path / "submission.json").write_text('{"method": "mine", "depth_scale": 0.001}')
    (tmp_path / "walk").mkdir()
    files: dict[str, Callable[[Path], object]] = {
        "a.npy": lambda path: np.save(path, DEPTH),
        "a.npz": lambda path: path.write_bytes(npz(depth=DEPTH)),
        "walk/a.exr": lambda path: exr(path, {"Z": DEPTH}),
        "a.png": lambda path: path.write_bytes(png(units)),
    }
    for name, write in files.items():
        path = tmp_path / name
        write(path)
        with open_maps(tmp_path, VIEWS) as source:
            assert (source.method, source.view_ids) == ("mine", ("walk/a",))
            expected = units * 0.001 if name == "a.png" else DEPTH
            assert np.array_equal(source.read("walk/a"), expected), name
        path.unlink()


def test_folder_and_archive_are_read_alike(tmp_path: Path) -> None:
    archive, folder = tmp_path / "a.zip", tmp_path / "method-x"
    folder.mkdir()
    with SubmissionWriter(archive, method="method-y") as writer:
        for view_id in VIEWS:
            writer.add(view_id, DEPTH)
            np.save(folder / f"{view_id.partition('/')[2]}.npy", DEPTH)
    with open_maps(archive, VIEWS) as from_archive, open_maps(folder, VIEWS) as from_folder:
        assert (from_archive.method, from_folder.method) == ("method-y", "method-x")
        assert from_archive.view_ids == from_folder.view_ids == tuple(VIEWS)
        assert np.array_equal(from_archive.read("walk/b"), from_folder.read("walk/b"))
        before = from_folder.sha256
    np.save(folder / "b.npy", 2 * DEPTH)
    with open_maps(folder, VIEWS) as changed:
        assert changed.sha256 != before


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({"c.npy": b""}, "no depth file of any view was found"),
        ({"a.npy": b"", "a.npz": b""}, r"walk/a has the files a\.npy, a\.npz, expected one"),
        ({"a.png": b""}, "expected their depth_scale"),
        ({"a.npy": b"", "submission.json": b"{"}, "submission.json"),
        ({"a.npy": b"none"}, r"a\.npy"),
    ],
)
def test_unusable_folder_is_refused(files: dict[str, bytes], words: str, tmp_path: Path) -> None:
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=words), open_maps(tmp_path, VIEWS) as source:
        source.read("walk/a")
