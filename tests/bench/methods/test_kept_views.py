"""Kept predictions of an interrupted run: resumption, damaged, renamed and foreign files, links and pipes."""

from __future__ import annotations

import io
import json
import os
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rebar_depth_bench import score
from rebar_depth_bench.base.errors import InputError
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
    (views.work_folder("orbit") / "any").touch()
    return views


def tree(folder: Path) -> list[Path]:
    """Return all files and folders below a folder."""
    return sorted(folder.rglob("*"))


def npz(**arrays: object) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)  # type: ignore[arg-type]
    return stream.getvalue()


def stored(depth: object = None, seconds: object = 0.5, view_id: str = VIEW) -> bytes:
    """Return the content of a kept prediction, whose parts can be replaced."""
    depth = np.full(GRID, 9, np.float32) if depth is None else depth
    return npz(**{view_id: depth, "seconds": np.array([[seconds]])})


def with_declared_shape(shape: str) -> bytes:
    """Return a kept prediction whose header declares another shape, with right checksums."""
    stream, old = io.BytesIO(), f"{GRID}, }}".encode()
    with zipfile.ZipFile(io.BytesIO(stored())) as source, zipfile.ZipFile(stream, "w") as target:
        for name in source.namelist():
            padded = old + b" " * (len(shape) - len(str(GRID)))
            target.writestr(name, source.read(name).replace(padded, f"{shape}, }}".encode()))
    return stream.getvalue()


DAMAGED = {
    "another shape": stored(np.zeros((3, 4), np.float32)),
    "another rank": stored(np.zeros((90, 160, 1), np.float32)),
    "integers": stored(np.zeros(GRID, np.int32)),
    "objects": stored(np.full(GRID, None)),
    "declared huge": with_declared_shape("(900000000, 160000000)"),
    "another view": stored(view_id="orbit/0099"),
    "no runtime": npz(**{VIEW: np.zeros(GRID, np.float32)}),
    "negative runtime": stored(seconds=-1.0),
    "infinite runtime": stored(seconds=np.inf),
    "undefined runtime": stored(seconds=np.nan),
    "runtime as text": stored(seconds="soon"),
    "three arrays": npz(**{VIEW: np.zeros(GRID), "seconds": np.zeros((1, 1)), "more": np.zeros(9)}),
    "empty": b"",
    "text": b"damaged",
    "truncated": stored()[:-100],
    "cut in the end record": stored()[:-10],
    "a flipped bit": stored()[:30_000] + b"\x99" + stored()[30_001:],
    "a pickle": b"\x80\x04cos\nsystem\n.",
}


@pytest.mark.parametrize("content", DAMAGED.values(), ids=DAMAGED)
def test_damaged_prediction_is_refused(content: bytes, kept: KeptViews) -> None:
    (kept.path / f"{VIEW}.npz").write_bytes(content)
    with pytest.raises(InputError, match=r"0001\.npz"):
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
    assert f"starting over: {kept.path} holds 1 views of " in capsys.readouterr().err
    assert tree(kept.path) == [file]
    KeptViews.open(kept.path, {"other": "method"})
    assert capsys.readouterr().err == "", "there are no views to lose"


def test_report_is_read_as_it_was_written(kept: KeptViews) -> None:
    kept.put_report("other", PreparationReport(notes={}, seconds=None))
    again = KeptViews.open(kept.path, json.loads(json.dumps(KEY)))
    assert again.run.reports == {"orbit": REPORT, "other": PreparationReport(notes={}, seconds=None)}


def place_text(path: Path, _: Path) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_text("text")


def place_file(path: Path, documents: Path) -> None:
    remove(path)
    place_text(path, documents)


def place_pipe(path: Path, _: Path) -> None:
    remove(path)
    os.mkfifo(path)


def place_link(path: Path, documents: Path) -> None:
    remove(path)
    path.symlink_to(documents)


def remove(path: Path) -> None:
    """Remove a file or folder if it exists."""
    if path.is_dir():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)


def place_views_without_parameters(path: Path, _: Path) -> None:
    remove(path)
    (path / "scans").mkdir(parents=True)
    (path / "scans" / "0001.npz").write_text("text")


FOREIGN: dict[str, tuple[str, Callable[[Path, Path], None]]] = {
    "document": ("thesis.tex", place_text),
    "document beside views": ("orbit/notes.txt", place_text),
    "hidden file": (".bashrc", place_text),
    "file in a folder": ("photos/1.jpg", place_text),
    "folder in a folder": ("orbit/deep", lambda path, _: path.mkdir()),
    "pipe as parameters": ("run.json", place_pipe),
    "pipe as view": ("orbit/0001.npz", place_pipe),
    "link as parameters": ("run.json", place_link),
    "link as view": ("orbit/0001.npz", place_link),
    "link as config": ("orbit", place_link),
    "link as work folder": ("orbit.work", place_link),
    "link": ("", place_link),
    "link to nowhere": ("", lambda path, documents: place_link(path, documents / "nowhere")),
    "file": ("", place_file),
    "pipe": ("", place_pipe),
    "views without parameters": ("", place_views_without_parameters),
}


@pytest.mark.parametrize(("name", "place"), FOREIGN.values(), ids=FOREIGN)
def test_foreign_content_is_refused_and_kept(
    name: str, place: Callable[[Path, Path], None], kept: KeptViews, tmp_path: Path
) -> None:
    documents = tmp_path / "documents"
    documents.mkdir()
    (documents / "thesis.tex").write_text("text")
    place(kept.path / name, documents)
    before = tree(tmp_path)
    for key in (KEY, {}):
        with pytest.raises(InputError) as caught:
            KeptViews.open(kept.path, key)
        assert str(kept.path / name.split("/")[0]) in str(caught.value)
    assert tree(tmp_path) == before


def test_empty_folder_and_remains_of_a_killed_run_are_used(tmp_path: Path) -> None:
    (tmp_path / ".run.json.abc.tmp").write_text("{")
    assert KeptViews.open(tmp_path, KEY).run.reports == {}
    assert tree(tmp_path) == [tmp_path / "run.json"]


def test_links_in_work_folder_are_not_followed_when_it_is_deleted(kept: KeptViews, tmp_path: Path) -> None:
    (tmp_path / "documents").mkdir()
    (tmp_path / "documents" / "thesis.tex").write_text("text")
    (kept.work_folder("orbit") / "pictures").symlink_to(tmp_path / "documents")
    KeptViews.open(kept.path, KEY).remove()
    assert {path.name for path in tmp_path.rglob("*")} == {"documents", "thesis.tex"}


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


def test_resumed_run_keeps_work_finished_configs_and_sound_views(
    tiny_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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
    [notice] = [line for line in capsys.readouterr().err.splitlines() if "again" in line]
    assert f"{views[0]}.npz" in notice
    with zipfile.ZipFile(archive) as source:
        depths_m = [np.load(io.BytesIO(source.read(f"{view}.npy"))) for view in views]
    assert all((depth_m == 2).all() for depth_m in depths_m)
    assert [path.name for path in tmp_path.iterdir()] == ["whole.zip"]
