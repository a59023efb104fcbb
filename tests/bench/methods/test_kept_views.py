"""Kept predictions of an interrupted run: resumption, damaged and foreign files, links and pipes."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rebar_depth_bench import score
from rebar_depth_bench.base.errors import EntryError, InputError
from rebar_depth_bench.methods.kept_views import KeptViews, PreparationReport
from rebar_depth_bench.methods.run import predict
from tests.bench.methods.predictors import counting_method, metadata_of, orbit_view_ids, stop_after

KEY = {"method": "whole", "columns": ("a", "b")}
VIEW, GRID = "orbit/0001", (90, 160)
REPORT = PreparationReport(notes={"text": "Größe", "list": [1, 2.5, None, True]}, seconds=1.5)


@pytest.fixture
def kept(tmp_path: Path) -> KeptViews:
    """Return the kept view, report and work folder of an interrupted run."""
    views = KeptViews.open(tmp_path / "views", KEY)
    views.put(VIEW, np.ones(GRID, np.float32), 0.25)
    views.put_report("orbit", REPORT)
    views.path_of("orbit.work").mkdir()
    (views.path_of("orbit.work") / "any").touch()
    return views


def tree(folder: Path) -> list[Path]:
    """Return all files and folders below a folder."""
    return sorted(folder.rglob("*"))


def npz(*arrays: object) -> bytes:
    """Return the content of a kept prediction with these arrays."""
    stream = io.BytesIO()
    np.savez(stream, *arrays)  # type: ignore[arg-type]
    return stream.getvalue() + bytes(8)


SOUND = npz(np.full(GRID, 9, np.float32))


def with_declared_shape(shape: str) -> bytes:
    """Return a kept prediction whose header declares another shape, with right checksums."""
    stream, old = io.BytesIO(), f"{GRID}, }}".encode()
    with zipfile.ZipFile(io.BytesIO(SOUND[:-8])) as source, zipfile.ZipFile(stream, "w") as target:
        for name in source.namelist():
            padded = old + b" " * (len(shape) - len(str(GRID)))
            target.writestr(name, source.read(name).replace(padded, f"{shape}, }}".encode()))
    return stream.getvalue() + bytes(8)


DAMAGED = {
    "another shape": npz(np.zeros((3, 4), np.float32)),
    "integers": npz(np.zeros(GRID, np.int32)),
    "objects": npz(np.full(GRID, None)),
    "declared huge": with_declared_shape("(900000000, 160000000)"),
    "two arrays": npz(np.zeros(GRID), np.zeros((1, 1))),
    "empty": b"",
    "text": b"damaged",
    "truncated": SOUND[:-100],
    "a flipped bit": SOUND[:30_000] + b"\x99" + SOUND[30_001:],
    "a pickle": b"\x80\x04cos\nsystem\n.",
}


@pytest.mark.parametrize("content", DAMAGED.values(), ids=DAMAGED)
def test_damaged_prediction_is_refused(content: bytes, kept: KeptViews) -> None:
    (kept.path / f"{VIEW}.npz").write_bytes(content)
    with pytest.raises(EntryError, match=r"0001\.npz"):
        kept.get(VIEW, GRID)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, np.longdouble, ">f4"])
def test_float_types_can_be_read_again(dtype: Any, kept: KeptViews) -> None:
    kept.put("a/0", np.asfortranarray(np.arange(6).reshape(2, 3).astype(dtype)), 0.25)
    depth_m, seconds = kept.get("a/0", (2, 3))
    assert (depth_m.tolist(), seconds) == ([[0, 1, 2], [3, 4, 5]], 0.25)
    assert depth_m.dtype == (np.float32 if dtype is np.longdouble else np.dtype(dtype).newbyteorder("="))


@pytest.mark.parametrize("view_id", ["../x", "a/../../x", "/x", "a/b\0", "a/.hidden", "", "a//b"])
def test_view_id_cannot_leave_the_folder(view_id: str, kept: KeptViews, tmp_path: Path) -> None:
    before = tree(tmp_path)
    with pytest.raises(InputError, match="is not a path in this folder"):
        kept.put(view_id, np.ones((2, 3)), 0.0)
    assert tree(tmp_path) == before


def report(notes: str = "{}", seconds: str = "1") -> Callable[[str], bytes]:
    """Return a function that gives ``run.json`` another report, as text."""

    def replace_report(text: str) -> bytes:
        table = json.dumps(json.loads(text) | {"reports": {"orbit": "REPORT"}})
        return table.replace('"REPORT"', f'{{"notes": {notes}, "seconds": {seconds}}}').encode()

    return replace_report


DAMAGED_RUNS: dict[str, Callable[[str], bytes]] = {
    "text": lambda _: b"damaged",
    "empty": lambda _: b"",
    "cut": lambda text: text[:-3].encode(),
    "list": lambda _: b"[]",
    "unknown key": lambda text: text.replace("{", '{"more": 1, ', 1).encode(),
    "missing key": lambda text: text.replace('"key"', '"other"', 1).encode(),
    "not UTF-8": lambda text: text.encode().replace(b"whole", b"who\xffe"),
    "other method": lambda text: text.replace("whole", "other").encode(),
    "notes as list": report(notes="[]"),
    "negative": report(seconds="-1"),
    "not a number": report(seconds="NaN"),
    "huge": report(seconds="1e999"),
    "long integer": report(notes='{"x": ' + "9" * 4400 + "}"),
    "deep": report(notes='{"x": ' + "[" * 100_000 + "]" * 100_000 + "}"),
    "twice": report(notes='{}, "notes": {}'),
}


@pytest.mark.parametrize("damage", DAMAGED_RUNS.values(), ids=DAMAGED_RUNS)
def test_run_with_damaged_or_other_parameters_starts_over(
    damage: Callable[[str], bytes], kept: KeptViews, capsys: pytest.CaptureFixture[str]
) -> None:
    file = kept.path / "run.json"
    file.write_bytes(damage(file.read_text()))
    assert KeptViews.open(kept.path, KEY).run.reports == {}
    assert f"starting over: {kept.path} is of another method" in capsys.readouterr().err
    assert tree(kept.path) == [file]


def test_report_is_read_as_it_was_written(kept: KeptViews) -> None:
    kept.put_report("other", PreparationReport(notes={}, seconds=None))
    again = KeptViews.open(kept.path, json.loads(json.dumps(KEY)))
    assert again.run.reports == {"orbit": REPORT, "other": PreparationReport(notes={}, seconds=None)}


def test_other_folder_is_refused_and_kept(tmp_path: Path) -> None:
    folder, link, file, pipe = (tmp_path / name for name in ("folder", "link", "file", "pipe"))
    (folder / "orbit").mkdir(parents=True)
    (folder / "orbit" / "0001.npz").write_bytes(SOUND)
    link.symlink_to(folder)
    file.write_text("text")
    os.mkfifo(pipe)
    before = tree(tmp_path)
    for path in (folder, link, file, pipe):
        with pytest.raises(InputError, match=re.escape(str(path))):
            KeptViews.open(path, KEY)
    os.mkfifo(folder / "run.json")
    with pytest.raises(InputError, match=r"has no run\.json"):
        KeptViews.open(folder, KEY)
    (folder / "run.json").unlink()
    assert tree(tmp_path) == before


def test_empty_folder_is_used(tmp_path: Path) -> None:
    assert KeptViews.open(tmp_path, KEY).run.reports == {}
    assert tree(tmp_path) == [tmp_path / "run.json"]


def test_links_are_not_followed(kept: KeptViews, tmp_path: Path) -> None:
    documents = tmp_path / "documents"
    documents.mkdir()
    (documents / "thesis.tex").write_text("text")
    (kept.path / "site").symlink_to(documents)
    with pytest.raises(InputError, match="site: is a symbolic link"):
        kept.put("site/0001", np.ones(GRID), 0.0)
    link = tmp_path / "link"
    link.symlink_to(kept.path)
    with pytest.raises(InputError, match="link: is a symbolic link"):
        KeptViews.open(link, {})
    link.unlink()
    KeptViews.open(kept.path, {})  # This deletes the folder with the link.
    assert tree(tmp_path) == [documents, documents / "thesis.tex", kept.path, kept.path / "run.json"]


def test_multi_view_method_is_prepared_once_per_config(tiny_root: Path, tmp_path: Path) -> None:
    log: list[str] = []
    archive = tmp_path / "whole.zip"
    prepared = predict(counting_method(log), tiny_root, archive)
    assert log[:3] == ["check lattice", "check lattice-orbit", "prepare lattice False"]
    assert log.count("prepare lattice False") == log.count("prepare lattice-orbit False") == 1
    assert len(log) == 4 + 9 + 2
    notes = {"lattice": {"counted": 9}, "lattice-orbit": {"counted": 2}}
    assert {name: report.notes for name, report in prepared.items()} == notes
    metadata = metadata_of(archive)
    assert metadata["notes"] == notes
    assert set(metadata["runtime"]["preparing"]) == {"lattice", "lattice-orbit"}
    assert score(archive, tiny_root).tables["lattice"].ranked


def test_resumed_run_keeps_work_finished_configs_and_sound_views(tiny_root: Path, tmp_path: Path) -> None:
    archive, views = tmp_path / "whole.zip", orbit_view_ids(tiny_root)
    with pytest.raises(KeyboardInterrupt):
        predict(counting_method([]), tiny_root, archive, progress=stop_after(1, "on lattice-orbit"))
    kept = tmp_path / ".whole.zip.views"
    shutil.copytree(kept, tmp_path / "before")
    log: list[str] = []
    prepared = predict(counting_method(log), tiny_root, archive)
    assert log[2:] == ["prepare lattice-orbit True", views[1]]
    assert set(prepared) == {"lattice", "lattice-orbit"}
    (tmp_path / "before").rename(kept)
    (kept / f"{views[0]}.npz").write_bytes(b"damaged")
    predict(counting_method(log), tiny_root, archive)
    assert log[-2:] == views
    with zipfile.ZipFile(archive) as source:
        depths_m = [np.load(io.BytesIO(source.read(f"{view}.npy"))) for view in views]
    assert all((depth_m == 2).all() for depth_m in depths_m)
    assert [path.name for path in tmp_path.iterdir()] == ["whole.zip"]
