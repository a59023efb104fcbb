"""Kept predictions of an interrupted run: damaged, renamed and foreign files, links and pipes."""

from __future__ import annotations

import io
import json
import os
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.methods.kept_views import KeptViews, PreparationReport
from rebar_depth_bench.methods.run import predict
from tests.bench.methods.test_predict import counting_method, orbit_view_ids

GRID = (90, 160)


@pytest.fixture
def interrupted(tiny_root: Path, tmp_path: Path) -> Path:
    """Return the folder of a run of ``lattice-orbit`` that was interrupted after the first of two views."""
    predict_orbit(tiny_root, tmp_path, stop_after=1)
    return tmp_path / ".x.zip.views"


def predict_orbit(root: Path, folder: Path, stop_after: int = 0) -> list[str]:
    """Predict ``lattice-orbit`` until ``stop_after`` views are done, and return the log of the method."""
    log: list[str] = []

    def stop(task: str, done: int, _: int) -> None:
        if task.startswith("whole on") and done == stop_after:
            raise KeyboardInterrupt

    method, archive = counting_method(log), folder / "x.zip"
    if stop_after:
        with pytest.raises(KeyboardInterrupt):
            predict(method, root, archive, configs=["lattice-orbit"], progress=stop)
    else:
        predict(method, root, archive, configs=["lattice-orbit"], progress=stop)
    return log


def npz(**arrays: object) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)  # type: ignore[arg-type]
    return stream.getvalue()


def kept(view_id: str, depth: object = None, seconds: object = 0.5) -> bytes:
    """Return the content of a kept prediction, whose parts can be replaced."""
    depth = np.full(GRID, 9, np.float32) if depth is None else depth
    return npz(**{view_id: depth, "seconds": np.array([[seconds]])})


def declared_shape(view_id: str, shape: str) -> bytes:
    """Return a kept prediction whose header declares another shape, with right checksums."""
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(kept(view_id))) as source, zipfile.ZipFile(stream, "w") as target:
        for name in source.namelist():
            target.writestr(
                name, source.read(name).replace(b"(90, 160), }" + b" " * (len(shape) - 9), shape.encode() + b", }")
            )
    return stream.getvalue()


DAMAGED: dict[str, Callable[[str], bytes]] = {
    "another shape": lambda view: kept(view, np.zeros((3, 4), np.float32)),
    "another rank": lambda view: kept(view, np.zeros((90, 160, 1), np.float32)),
    "integers": lambda view: kept(view, np.zeros(GRID, np.int32)),
    "objects": lambda view: kept(view, np.full(GRID, None)),
    "declared huge": lambda view: declared_shape(view, "(900000000, 160000000)"),
    "another view": lambda _: kept("lattice-orbit/0099"),
    "no runtime": lambda view: npz(**{view: np.zeros(GRID, np.float32)}),
    "negative runtime": lambda view: kept(view, seconds=-1.0),
    "infinite runtime": lambda view: kept(view, seconds=np.inf),
    "undefined runtime": lambda view: kept(view, seconds=np.nan),
    "runtime as text": lambda view: kept(view, seconds="soon"),
    "three arrays": lambda view: npz(**{view: np.zeros(GRID), "seconds": np.zeros((1, 1)), "more": np.zeros(9)}),
    "old names": lambda _: npz(depth_m=np.zeros(GRID, np.float32), seconds=0.0),
    "empty": lambda _: b"",
    "text": lambda _: b"damaged",
    "truncated": lambda view: kept(view)[:-100],
    "a flipped bit": lambda view: kept(view)[:30_000] + b"\x99" + kept(view)[30_001:],
    "a pickle": lambda _: b"\x80\x04cos\nsystem\n.",
}


@pytest.mark.parametrize("content", DAMAGED.values(), ids=DAMAGED)
def test_damaged_prediction_is_predicted_again(
    content: Callable[[str], bytes],
    interrupted: Path,
    tiny_root: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    views = orbit_view_ids(tiny_root)
    (interrupted / f"{views[0]}.npz").write_bytes(content(views[0]))
    log = predict_orbit(tiny_root, tmp_path)
    assert log[-2:] == views
    [notice] = [line for line in capsys.readouterr().err.splitlines() if "again" in line]
    assert f"{views[0]}.npz" in notice
    with zipfile.ZipFile(tmp_path / "x.zip") as archive:
        depths = [np.load(io.BytesIO(archive.read(f"{view}.npy"))) for view in views]
    assert all((depth == 2).all() and depth.shape == GRID for depth in depths)
    assert [path.name for path in tmp_path.iterdir()] == ["x.zip"]


def test_every_cut_of_a_kept_prediction_is_noticed(tmp_path: Path) -> None:
    views = KeptViews.open(tmp_path / "views", {})
    views.put("a/0", np.ones((2, 3), np.float16), 0.25)
    file = tmp_path / "views" / "a" / "0.npz"
    good = file.read_bytes()
    for length in range(0, len(good), 5):
        file.write_bytes(good[:length])
        with pytest.raises(InputError, match=r"0\.npz"):
            views.get("a/0", (2, 3))
    file.write_bytes(good)
    depth_m, seconds = views.get("a/0", (2, 3))
    assert (depth_m.tolist(), depth_m.dtype, seconds) == ([[1, 1, 1], [1, 1, 1]], np.float16, 0.25)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, np.longdouble, ">f4"])
def test_float_types_can_be_read_again(dtype: str, tmp_path: Path) -> None:
    views = KeptViews.open(tmp_path / "views", {})
    views.put("a/0", np.asfortranarray(np.arange(6).reshape(2, 3).astype(dtype)), 0.0)
    assert views.get("a/0", (2, 3))[0].tolist() == [[0, 1, 2], [3, 4, 5]]


@pytest.mark.parametrize("view_id", ["../x", "a/../../x", "/x", "a/b\0", "a/.hidden", "", "a//b"])
def test_view_id_cannot_leave_the_folder(view_id: str, tmp_path: Path) -> None:
    views = KeptViews.open(tmp_path / "folder" / "views", {})
    with pytest.raises(InputError, match="is not a path in this folder"):
        views.put(view_id, np.ones((2, 3)), 0.0)
    assert {path.name for path in tmp_path.rglob("*")} == {"folder", "views", "run.json"}


def report(notes: str = "{}", seconds: str = "1") -> Callable[[str], bytes]:
    """Return a function that gives ``run.json`` another report, as text."""

    def replace_report(text: str) -> bytes:
        run = json.loads(text)
        table = json.dumps(run | {"reports": {"lattice-orbit": "REPORT"}})
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
    damage: Callable[[str], bytes],
    interrupted: Path,
    tiny_root: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = interrupted / "run.json"
    file.write_bytes(damage(file.read_text()))
    assert predict_orbit(tiny_root, tmp_path)[1:] == ["prepare lattice-orbit False", *orbit_view_ids(tiny_root)]
    assert f"starting over: {interrupted} holds 1 views of " in capsys.readouterr().err
    with zipfile.ZipFile(tmp_path / "x.zip") as archive:
        metadata = json.loads(archive.read("submission.json"))
    assert metadata["notes"] == {"lattice-orbit": {"counted": 2}}


def test_sound_report_is_reused(interrupted: Path, tiny_root: Path, tmp_path: Path) -> None:
    file = interrupted / "run.json"
    file.write_bytes(report('{"counted": 7}', "2.5")(file.read_text()))
    predict_orbit(tiny_root, tmp_path)
    with zipfile.ZipFile(tmp_path / "x.zip") as archive:
        metadata = json.loads(archive.read("submission.json"))
    assert metadata["notes"] == {"lattice-orbit": {"counted": 7}}
    assert metadata["runtime"]["preparing"] == {"lattice-orbit": 2.5}


def place_text(path: Path) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_text("text")


def place_pipe(path: Path) -> None:
    path.unlink(missing_ok=True)
    os.mkfifo(path)


def place_link(path: Path, target: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    path.symlink_to(target)


FOREIGN: dict[str, tuple[str, Callable[[Path, Path], None]]] = {
    "document": ("thesis.tex", lambda path, _: place_text(path)),
    "document beside views": ("lattice-orbit/notes.txt", lambda path, _: place_text(path)),
    "hidden file": (".bashrc", lambda path, _: place_text(path)),
    "folder": ("photos", lambda path, _: place_text(path / "1.jpg")),
    "folder in a folder": ("lattice-orbit/deep", lambda path, _: path.mkdir()),
    "pipe as parameters": ("run.json", lambda path, _: place_pipe(path)),
    "pipe as view": ("lattice-orbit/0001.npz", lambda path, _: place_pipe(path)),
    "link as parameters": ("run.json", place_link),
    "link as view": ("lattice-orbit/0001.npz", place_link),
    "link as config": ("lattice-orbit", place_link),
    "link as work folder": ("lattice-orbit.work", place_link),
}


@pytest.mark.parametrize("other_run", [False, True])
@pytest.mark.parametrize(("name", "place"), FOREIGN.values(), ids=FOREIGN)
def test_foreign_content_is_refused_and_kept(
    name: str,
    place: Callable[[Path, Path], None],
    other_run: bool,
    interrupted: Path,
    tiny_root: Path,
    tmp_path: Path,
) -> None:
    documents = tmp_path / "documents"
    documents.mkdir()
    (documents / "thesis.tex").write_text("text")
    if other_run:
        (interrupted / "run.json").write_text("{}")
    place(interrupted / name, documents)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError) as caught:
        predict_orbit(tiny_root, tmp_path)
    assert str(interrupted / name.split("/")[0]) in str(caught.value)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("kind", ["folder", "link", "link to nowhere", "file", "pipe", "views without parameters"])
def test_folder_of_another_kind_is_refused_and_kept(kind: str, tiny_root: Path, tmp_path: Path) -> None:
    path = tmp_path / ".x.zip.views"
    documents = path if kind == "folder" else tmp_path / "documents"
    documents.mkdir()
    (documents / "thesis.tex").write_text("text")
    if kind.startswith("link"):
        path.symlink_to(documents if kind == "link" else tmp_path / "nowhere")
    elif kind == "file":
        path.write_text("text")
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "views without parameters":
        (path / "scans").mkdir(parents=True)
        (path / "scans" / "0001.npz").write_text("text")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError, match=r"\.x\.zip\.views"):
        predict_orbit(tiny_root, tmp_path)
    assert sorted(tmp_path.rglob("*")) == before


def test_empty_folder_and_remains_of_a_killed_run_are_used(tiny_root: Path, tmp_path: Path) -> None:
    path = tmp_path / ".x.zip.views"
    path.mkdir()
    (path / ".run.json.abc.tmp").write_text("{")
    assert len(predict_orbit(tiny_root, tmp_path)) == 4
    assert [file.name for file in tmp_path.iterdir()] == ["x.zip"]


def test_links_in_work_folder_are_not_followed_when_it_is_deleted(
    interrupted: Path, tiny_root: Path, tmp_path: Path
) -> None:
    (tmp_path / "documents").mkdir()
    (tmp_path / "documents" / "thesis.tex").write_text("text")
    (interrupted / "lattice-orbit.work" / "pictures").symlink_to(tmp_path / "documents")
    predict_orbit(tiny_root, tmp_path)
    assert {path.name for path in tmp_path.rglob("*")} == {"x.zip", "documents", "thesis.tex"}


def test_report_is_read_as_it_was_written(tmp_path: Path) -> None:
    views = KeptViews.open(tmp_path / "views", {"columns": ("a", "b")})
    assert views.run.reports == {}
    for seconds in (None, 0.0, 1.5):
        kept_report = PreparationReport(notes={"text": "Größe", "list": [1, 2.5, None, True]}, seconds=seconds)
        views.put_report("a", kept_report)
        assert KeptViews.open(tmp_path / "views", {"columns": ["a", "b"]}).run.reports == {"a": kept_report}
