"""Evaluation of models in Python: all forms of predictions, some views, and equality with ``score``."""

from __future__ import annotations

import copy
import math
import os
import pickle
import re
import sys
import tempfile
from collections import UserDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from subprocess import run
from typing import Any

import numpy as np
import pytest

import rebar_depth_bench as rdb
from rebar_depth_bench.base.errors import RebarDepthError
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.scoring.reading import read_result
from rebar_depth_bench.scoring.result import Result
from tests.bench.reporting.pages import Page

Truth = dict[str, np.ndarray]
LATTICE = "lattice"


@pytest.fixture
def lattice(tiny_root: Path) -> Truth:
    return {row["view_id"]: row["left_depth"] for row in rdb.load(tiny_root, LATTICE)}


def test_archive_of_a_method_is_written_and_scored(tiny_root: Path, tmp_path: Path) -> None:
    pytest.importorskip("cv2")
    result = rdb.evaluate("sgbm", tiny_root, archive=tmp_path / "sgbm.zip")
    assert result.to_json() == rdb.score(tmp_path / "sgbm.zip", tiny_root).to_json()
    assert list(result.tables) == ["lattice", "lattice-orbit"]
    result.to_html(tmp_path / "report.html")
    assert b"sgbm" in (tmp_path / "report.html").read_bytes()


def without_archive(result: Result) -> dict[str, Any]:
    """Return the JSON of a result without the digest of its archive."""
    document = result.to_dict()
    document["submission"]["sha256"] = None
    return document


@pytest.mark.parametrize("kind", ["metric", "scale", "affine-disparity"])
@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_views_scored_as_they_arrive_have_the_numbers_of_an_archive(
    tiny_root: Path, lattice: Truth, tmp_path: Path, kind: str, dtype: type
) -> None:
    """In any order; some pixels and one view have no prediction, and one value overflows float32."""
    rng = np.random.default_rng(0)
    predictions = {view_id: (z * rng.normal(1, 0.1, z.shape)).astype(dtype) for view_id, z in lattice.items()}
    first, second, third, *_ = predictions
    predictions[first][::3] = np.nan
    predictions[second][:] = 0
    predictions[third][0] = np.inf if dtype == np.float16 else 1e38
    backwards = dict(reversed(predictions.items()))
    arguments: dict[str, Any] = {"config": LATTICE, "kind": kind, "extended": kind == "metric"}
    result = rdb.evaluate(backwards, tiny_root, **arguments)
    assert result.submission.sha256 is None
    written = rdb.evaluate(backwards, tiny_root, **arguments, archive=tmp_path / "a.zip")
    scored = rdb.score(tmp_path / "a.zip", tiny_root, extended=kind == "metric")
    assert written.to_json() == scored.to_json()
    assert result.to_dict() == without_archive(scored)
    assert result.notes == scored.notes


def test_without_an_archive_there_are_no_pictures(tiny_root: Path, lattice: Truth, tmp_path: Path) -> None:
    result = rdb.evaluate(lattice, tiny_root, config=LATTICE)
    assert "no archive" in result._repr_html_()
    result.to_html(tmp_path / "report.html")
    text = Page((tmp_path / "report.html").read_text()).text
    assert "No pictures of views" in text
    assert "archive=PATH" in text
    with pytest.raises(rdb.InputError, match="not kept, expected archive=PATH"):
        result.save_archive(tmp_path / "a.zip")
    assert read_result(result.to_json(), "x").to_json() == result.to_json()


def test_compute_may_be_repeated_until_reset(tiny_root: Path, lattice: Truth, tmp_path: Path) -> None:
    archive = tmp_path / "a.zip"
    evaluator = rdb.Evaluator(tiny_root, LATTICE, archive=archive)
    for factor in (1.0, 1.1):
        evaluator.update(list(lattice), [factor * z for z in lattice.values()])
        results = [evaluator.compute().to_json() for _ in range(2)]
        assert results[0] == results[1] == rdb.score(archive, tiny_root).to_json()
        evaluator.reset()
    evaluator.update(next(iter(lattice)), next(iter(lattice.values())))
    written = archive.read_bytes()
    evaluator.reset()
    assert archive.read_bytes() == written, "an incomplete archive replaces none"
    assert [path.name for path in tmp_path.iterdir()] == ["a.zip"]


def test_several_threads_may_add_views(tiny_root: Path, lattice: Truth) -> None:
    expected = rdb.evaluate(lattice, tiny_root, config=LATTICE).to_json()
    evaluator = rdb.Evaluator(tiny_root, LATTICE)
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(evaluator.update, lattice, lattice.values()))
        repeated = [pool.submit(evaluator.update, *item) for item in lattice.items()]
    assert all(isinstance(one.exception(), rdb.InputError) for one in repeated)
    assert evaluator.compute().to_json() == expected


def test_copy_is_independent(tiny_root: Path, lattice: Truth, tmp_path: Path) -> None:
    first, *others = lattice
    evaluator = rdb.Evaluator(tiny_root, LATTICE)
    evaluator.update(first, lattice[first])
    twin = copy.deepcopy(evaluator)
    for one, factor in ((evaluator, 1.0), (twin, 1.1)):
        one.update(others, [factor * lattice[view_id] for view_id in others])
    assert evaluator.compute().metrics["lattice/rank_error"] == 0 < twin.compute().metrics["lattice/rank_error"]
    writing = rdb.Evaluator(tiny_root, LATTICE, archive=tmp_path / "a.zip")
    for make in (copy.copy, copy.deepcopy):
        with pytest.raises(RebarDepthError, match=r"writes the archive .*a\.zip, expected one without archive="):
            make(writing)


def test_arrays_may_be_filled_again(tiny_root: Path, lattice: Truth) -> None:
    """The notes are those of the predictions when they were added."""
    expected = rdb.evaluate(lattice, tiny_root, config=LATTICE).notes
    same = np.empty((90, 160), np.float32)

    def fill(row: Any) -> np.ndarray:
        same[:] = lattice[row["view_id"]]
        return same

    assert rdb.evaluate(fill, tiny_root, config=LATTICE).notes == expected


def test_archive_that_cannot_be_written_is_discarded(tiny_root: Path, tmp_path: Path) -> None:
    """After a write beyond the limit of file sizes, all views are missing and no file is left."""
    code = f"""
import resource, signal
import numpy as np
import rebar_depth_bench as rdb
from rebar_depth_bench.base.errors import RebarDepthError
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
evaluator = rdb.Evaluator({str(tiny_root)!r}, "lattice", archive={str(tmp_path / "a.zip")!r})
ids, depth = evaluator.view_ids, np.ones((90, 160), np.float32)
evaluator.update(ids[0], depth)
limits = resource.getrlimit(resource.RLIMIT_FSIZE)
resource.setrlimit(resource.RLIMIT_FSIZE, (70_000, limits[1]))
try:
    evaluator.update(ids[1], depth)
except RebarDepthError as error:
    print(error)
resource.setrlimit(resource.RLIMIT_FSIZE, limits)
evaluator.update(ids, [depth] * len(ids))
written = evaluator.compute()
assert rdb.score({str(tmp_path / "a.zip")!r}, {str(tiny_root)!r}) == written
"""
    finished = run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (finished.returncode, finished.stderr) == (0, "")
    assert "a.zip: cannot be written" in finished.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["a.zip"]


def test_digest_is_that_of_the_archive_that_was_written(tiny_root: Path, lattice: Truth, tmp_path: Path) -> None:
    archive = tmp_path / "a.zip"
    evaluator = rdb.Evaluator(tiny_root, LATTICE, archive=archive)
    evaluator.update(list(lattice), list(lattice.values()))
    first = evaluator.compute()
    rdb.evaluate({view_id: 2 * z for view_id, z in lattice.items()}, tiny_root, config=LATTICE, archive=archive)
    assert evaluator.compute() == first
    with pytest.raises(rdb.InputError, match="of the archive that was scored; score it again"):
        first.save_archive(tmp_path / "b.zip")
    with pytest.raises(rdb.InputError, match="archive is /dev/null, a device or a pipe"):
        rdb.Evaluator(tiny_root, LATTICE, archive="/dev/null")


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_forked_process_changes_nothing_of_its_parent(tiny_root: Path, tmp_path: Path) -> None:
    """The child adds a view, is refused with an archive, and ends with all finalizers."""
    code = f"""
import os, sys
import numpy as np
import rebar_depth_bench as rdb
from rebar_depth_bench.base.errors import RebarDepthError
archive = {str(tmp_path / "a.zip")!r}
plain = rdb.Evaluator({str(tiny_root)!r}, "lattice")
writing = rdb.Evaluator({str(tiny_root)!r}, "lattice", archive=archive)
first, *others = plain.view_ids
depth = np.ones((90, 160), np.float32)
for one in (plain, writing):
    one.update(first, depth)
if not os.fork():
    plain.update(others[0], depth)
    try:
        writing.update(others[0], depth)
    except RebarDepthError:
        sys.exit(7)
    sys.exit(0)
assert os.waitstatus_to_exitcode(os.wait()[1]) == 7
for one in (plain, writing):
    one.update(others, [depth] * len(others))
if not os.fork():
    try:
        writing.compute()
    except RebarDepthError:
        sys.exit(7)
    sys.exit(0)
assert os.waitstatus_to_exitcode(os.wait()[1]) == 7
written = writing.compute()
assert rdb.score(archive, {str(tiny_root)!r}).to_json() == written.to_json()
assert written.metrics == plain.compute().metrics
"""
    finished = run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True)
    assert (finished.returncode, finished.stderr) == (0, "")


def test_every_form_of_model_gives_the_same_numbers(tiny_root: Path, lattice: Truth) -> None:
    predictions = {view_id: depth_m * 1.1 for view_id, depth_m in lattice.items()}
    of_mapping = rdb.evaluate(predictions, tiny_root, config=LATTICE)
    of_pairs = rdb.evaluate(iter(predictions.items()), tiny_root, config=LATTICE)
    of_function = rdb.evaluate(lambda row: predictions[row["view_id"]], tiny_root, config=LATTICE)
    assert of_mapping.to_json() == of_pairs.to_json() == of_function.to_json()
    assert of_mapping.metrics["lattice/native/abs_rel"] == pytest.approx(0.1)
    assert of_mapping.metrics["lattice/within_mm/5"] == of_mapping.tables[LATTICE]["within_mm.5"]


@pytest.mark.parametrize("inputs", ["stereo", "multi-view"])
def test_functions_see_no_ground_truth_that_is_not_declared(tiny_root: Path, inputs: str) -> None:
    rows: list[dict[str, Any]] = []

    def predict(row: Any) -> np.ndarray:
        rows.append(row)
        return np.ones(row["left_rgb"].shape[:2], np.float16)

    has_poses = inputs == "multi-view"
    if has_poses:
        for undeclared in (None, False):
            with pytest.raises(rdb.InputError, match=f"uses_ground_truth is {undeclared}, expected True, because"):
                rdb.evaluate(predict, tiny_root, inputs=inputs, uses_ground_truth=undeclared)
        assert not rows
    rdb.evaluate(predict, tiny_root, config=LATTICE, inputs=inputs, uses_ground_truth=has_poses)
    poses = {"left_cam_from_world", "right_cam_from_world"} if has_poses else set()
    eyes = {f"{eye}_{kind}" for eye in ("left", "right") for kind in ("rgb", "K", "distortion")}
    assert set(rows[0]) == {"view_id", "baseline_m", "right_from_left"} | eyes | poses
    assert np.allclose(rows[0]["right_from_left"][:3, 3], [-rows[0]["baseline_m"], 0, 0], atol=1e-9)


def test_some_views_are_not_ranked(tiny_root: Path, lattice: Truth, tmp_path: Path) -> None:
    some: dict[str, Any] = {"config": LATTICE, "views": 3, "method": "truth", "extended": True}
    result = rdb.evaluate(lattice, tiny_root, **some, archive=tmp_path / "truth.zip")
    assert [view.view_id for view in result.views] == [list(lattice)[k] for k in (0, 3, 6)]
    table = result.tables[LATTICE]
    assert not table.ranked
    assert result.notes[0] == "lattice: Not ranked: 3 of 9 views."
    constant = f"{table['reference.scaled_constant.abs_rel']:.4f}"
    lines = str(result).splitlines()
    assert [line.split() for line in lines[:2]] == [
        ["truth", "?", "coverage", "rank", "error", "AbsRel", "scaled", "constant", "margin", "<=", "5", "mm"],
        ["lattice", "100.0", "%", "0.0000", "0.0000", "0.0000", constant, "100.0", "%", "100.0", "%"],
    ]
    assert lines[2:] == ["protocol rebar-2; inputs: not declared; ground truth: use not declared", *result.notes]
    assert result.extended is not None
    with pytest.raises(rdb.InputError, match="3 of 9 views were evaluated, expected all views"):
        result.save_archive(tmp_path / "some.zip")
    chosen = list(lattice)[:2]
    by_id = rdb.evaluate(lattice, tiny_root, config=LATTICE, views=chosen)
    assert [view.view_id for view in by_id.views] == chosen


def half(depth_m: np.ndarray) -> np.ndarray:
    """Return depth in every other column, and no prediction in the others."""
    return np.where(np.arange(depth_m.shape[1]) % 2, depth_m, 0)


def test_every_display_has_the_same_summary(
    tiny_root: Path, lattice: Truth, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Depth in millimetres in every other column, of a method that declares the use of ground truth."""
    predictions = {view_id: 1000 * half(depth_m) for view_id, depth_m in lattice.items()}
    mine: dict[str, Any] = {"method": "mine", "uses_ground_truth": True, "archive": tmp_path / "a.zip"}
    evaluated = rdb.evaluate(predictions, tiny_root, config=LATTICE, **mine)
    scored = rdb.score(tmp_path / "a.zip", tiny_root)
    assert (str(scored), scored._repr_html_()) == (str(evaluated), evaluated._repr_html_())
    assert main(["score", str(tmp_path / "a.zip"), "--data", str(tiny_root)]) == 0
    streams = capsys.readouterr()
    displays = {
        "print": str(scored),
        "notebook": Page(scored._repr_html_()).text,
        "terminal": streams.out + streams.err,
    }
    table = scored.tables[LATTICE]
    constant = table["reference.scaled_constant.abs_rel"]
    coverage = math.floor(1000 * table["coverage"]) / 10
    margin = math.floor(1000 * (1 - table["scaled.abs_rel"] / constant)) / 10
    for display, text in displays.items():
        shown = " ".join(text.split())
        for words in (
            *(f"{coverage:.1f}", f"{table['rank_error']:.4f}", f"{constant:.4f}", f"{margin:.1f} %"),
            *("ground truth: used, as declared", f"coverage {coverage:.1f} % is below 95 %"),
            *("Not ranked: the submission declares", "possible mistake: ", "in millimetres"),
        ):
            assert words in shown, (display, words)
    assert "mine ‡" in displays["print"]
    assert "mine ‡" in displays["notebook"]
    assert "mine ‡" in displays["terminal"]


def test_score_has_report_and_archive_as_evaluate(tiny_root: Path, lattice: Truth, tmp_path: Path) -> None:
    evaluated = rdb.evaluate(lattice, tiny_root, config=LATTICE, archive=tmp_path / "a.zip")
    scored = rdb.score(tmp_path / "a.zip", tiny_root)
    scored.save_archive(tmp_path / "b.zip")
    assert (tmp_path / "b.zip").read_bytes() == (tmp_path / "a.zip").read_bytes()
    for name, result in (("evaluated", evaluated), ("scored", scored)):
        result.to_html(tmp_path / f"{name}.html")
    assert (tmp_path / "scored.html").read_bytes() == (tmp_path / "evaluated.html").read_bytes()


@pytest.mark.parametrize("change", [Path.unlink, lambda path: path.write_bytes(path.read_bytes() + b" ")])
def test_mistakes_are_looked_for_in_the_archive_that_was_scored(
    change: Callable[[Path], object],
    tiny_root: Path,
    lattice: Truth,
    archive_of: Callable[..., Path],
    tmp_path: Path,
) -> None:
    archive = archive_of({view_id: 1000 * depth_m for view_id, depth_m in lattice.items()})
    before, after, other = (rdb.score(archive, tiny_root) for _ in range(3))
    [mistake] = [note for note in before.notes if note.startswith("possible mistake: ")]
    read = read_result(before.to_json(), "json")
    assert (*read.notes, mistake) == before.notes, "a result that was read has no archive"
    copies = [pickle.loads(pickle.dumps(one)) for one in (before, after)]
    change(archive)
    assert before.notes[-1] == copies[0].notes[-1] == mistake
    for result in (after, copies[1], replace(other, submission=replace(other.submission, method="b"))):
        assert result.notes[:-1] == read.notes
        assert result.notes[-1].startswith("possible mistakes were not looked for: ")
        assert str(result).endswith(result.notes[-1])
        with pytest.raises(rdb.InputError, match=str(archive)):
            result.to_html(tmp_path / "report.html")
        with pytest.raises(rdb.InputError, match=str(archive)):
            result.save_archive(tmp_path / "copy.zip")


def test_mistakes_are_printed_and_among_the_notes(tiny_root: Path, lattice: Truth, tmp_path: Path) -> None:
    made: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "in millimetres": lambda z: z * 1000,
        'if the network is relative, declare kind="affine-disparity"': lambda z: 1 / np.where(z > 0, z, np.nan),
    }
    for words, make in made.items():
        result = rdb.evaluate({view_id: make(z) for view_id, z in lattice.items()}, tiny_root, config=LATTICE)
        [mistake] = [note for note in result.notes if note.startswith("possible mistake: ")]
        assert words in mistake
        assert str(result).splitlines()[-1] == mistake
        result.to_html(tmp_path / "report.html")
        assert mistake.removeprefix("possible mistake: ") in Page((tmp_path / "report.html").read_text()).text


def test_predictions_that_say_nothing_are_told_apart(tiny_root: Path, lattice: Truth) -> None:
    def notes(make: Callable[[np.ndarray], np.ndarray]) -> list[str]:
        predictions = {view_id: make(z) for view_id, z in lattice.items()}
        return list(rdb.evaluate(predictions, tiny_root, config=LATTICE, kind="affine-disparity").notes[1:])

    words = "say nothing about depth, or run the other way (depth declared as disparity, or disparity as depth)."
    assert notes(lambda z: z)[1].endswith(words)
    none = notes(lambda z: np.full_like(z, np.nan))
    assert none[0].endswith(
        f"{len(lattice)} of {len(lattice)} views without any prediction; coverage 0.0 % is below 95 %."
    )
    assert not any("fit " in note for note in none)


def test_unfinished_evaluator_is_silent_at_exit(tiny_root: Path, tmp_path: Path) -> None:
    code = f"""
import numpy as np
import rebar_depth_bench as rdb
evaluator = rdb.Evaluator({str(tiny_root)!r}, "lattice")
evaluator.update(evaluator.view_ids[0], np.ones((90, 160)))
evaluator.itself = evaluator
"""
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    for last in ("", "import gc\ndel evaluator\ngc.collect()\n"):
        finished = run([sys.executable, "-c", code + last], env=environment, capture_output=True, text=True)
        assert (finished.returncode, finished.stderr) == (0, "")
        assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("config", [None, LATTICE])
def test_split_of_another_type_is_refused(tiny_root: Path, config: str | None) -> None:
    with pytest.raises(rdb.DatasetError, match=r"the split 3$|no split 3, expected test"):
        rdb.Evaluator(tiny_root, config, split=3)  # type: ignore[arg-type]


def test_a_method_declares_itself(tiny_root: Path) -> None:
    with pytest.raises(rdb.InputError, match=r"^kind and uses_ground_truth are given, .* sgbm .*, align=KIND"):
        rdb.evaluate("sgbm", tiny_root, kind="affine-disparity", uses_ground_truth=False)
    with pytest.raises(rdb.InputError, match=r"^method is given, but the method sgbm declares its own$"):
        rdb.evaluate("sgbm", tiny_root, method="mine")
    with pytest.raises(rdb.MethodError, match="mine"):
        rdb.evaluate("mine", tiny_root, method="mine")


def test_batches_of_tensors(tiny_root: Path) -> None:
    torch = pytest.importorskip("torch")
    evaluator = rdb.Evaluator(tiny_root, LATTICE, views=4)
    loader = rdb.torch_loader(evaluator.dataset, batch_size=2)
    forms: list[Callable[[Any], Any]] = [
        lambda depth: depth,
        lambda depth: depth[:, 0].double().requires_grad_(),
        lambda depth: list(depth.to(torch.bfloat16)),
    ]
    errors = []
    for form in forms:
        evaluator.reset()
        for batch in loader:
            evaluator.update(batch["view_id"], form(batch["depth"]))
        errors.append(evaluator.compute().metrics["lattice/rank_error"])
    assert errors[:2] == [0.0, 0.0]
    assert 0 < errors[2] < 2**-8  # bfloat16 has 8 significant bits.


def test_tensors_are_taken_wherever_depth_is(tiny_root: Path, tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    path = tmp_path / "own.py"
    path.write_text("""
import torch
from rebar_depth_bench.methods import Method, MethodInfo

def run(row):
    network = torch.nn.Parameter(torch.full((1, 1, *row["left_rgb"].shape[:2]), 0.3, dtype=torch.bfloat16))
    return network * 1

METHOD = Method(MethodInfo("own", "a test", ("left_rgb",), False, "here", "MIT"), lambda: run)
""")
    by_name = rdb.evaluate(f"{path}:METHOD", tiny_root, config=LATTICE)
    depth = torch.full((1, 1, 90, 160), 0.3, dtype=torch.bfloat16, requires_grad=True)
    of_function = rdb.evaluate(lambda _: depth, tiny_root, config=LATTICE)
    with rdb.SubmissionWriter(tmp_path / "written.zip", "own") as writer:
        for view_id in rdb.Evaluator(tiny_root, LATTICE).view_ids:
            writer.add(view_id, depth)
    written = rdb.score(tmp_path / "written.zip", tiny_root)
    assert by_name.metrics == of_function.metrics == written.metrics


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        ((90, 160), None),
        ((1, 90, 160), None),
        ((1, 1, 90, 160), None),
        ((90, 161), r"shape \(90, 161\), expected .* of shape \(90, 160\)"),
        ((2, 90, 160), "shape"),
    ],
)
def test_shapes_of_one_view(tiny_root: Path, shape: tuple[int, ...], words: str | None) -> None:
    evaluator = rdb.Evaluator(tiny_root, LATTICE, views=1)
    [view_id] = evaluator.view_ids
    if words is None:
        evaluator.update(view_id, np.ones(shape))
        assert evaluator.compute().tables[LATTICE]["coverage"] == 1
    else:
        with pytest.raises(rdb.InputError, match=f"{view_id}: .*{words}"):
            evaluator.update(view_id, np.ones(shape))


@pytest.mark.parametrize(
    ("depth", "words"),
    [
        ({"depth": 1, "mask": 2}, "an object of type dict with the keys depth, mask, expected an array of floats"),
        (UserDict(depth=1), "an object of type UserDict with the keys depth, expected"),
        ("ab", "an object of type str, expected"),
        (None, "None, expected"),
        (np.float32(1), r"float32 of shape \(\), expected"),
    ],
)
@pytest.mark.parametrize("count", [1, 2])
def test_what_is_no_batch_is_named(tiny_root: Path, depth: Any, words: str, count: int) -> None:
    evaluator = rdb.Evaluator(tiny_root, LATTICE)
    ids = evaluator.view_ids[:count]
    with pytest.raises(rdb.InputError, match=f"^{ids[0]}: depth is {words}"):
        evaluator.update(ids, depth)


@pytest.mark.parametrize("view_ids", [None, 3, {"view_id": ["lattice/0028"]}, np.array("lattice/0028")])
def test_what_are_no_view_ids_is_named(tiny_root: Path, view_ids: Any) -> None:
    found = f"view_ids is an object of type {type(view_ids).__name__}, expected a view id or a list"
    with pytest.raises(rdb.InputError, match=found):
        rdb.Evaluator(tiny_root, LATTICE).update(view_ids, np.ones((1, 90, 160)))


def test_numbers_of_ids_and_maps_differ(tiny_root: Path, lattice: Truth) -> None:
    [first, second, *_], height_width = lattice, next(iter(lattice.values())).shape
    evaluator = rdb.Evaluator(tiny_root, LATTICE)
    with pytest.raises(
        rdb.InputError, match=rf"2 view ids and {height_width[0]} depth maps \(ndarray of shape \("
    ):
        evaluator.update([first, second], lattice[first])
    with pytest.raises(rdb.InputError, match=r"1 view ids and 2 depth maps \(tuple\)"):
        evaluator.update([first], (lattice[first], lattice[first]))


def test_squeezed_batch_of_one_is_taken(tiny_root: Path, lattice: Truth) -> None:
    first = next(iter(lattice))
    evaluator = rdb.Evaluator(tiny_root, LATTICE, views=[first])
    evaluator.update([first], lattice[first].squeeze())
    assert evaluator.compute().metrics["lattice/rank_error"] == 0


def test_remedies_for_a_part_of_the_views_are_named_and_work(tiny_root: Path, lattice: Truth) -> None:
    first, *others = lattice
    evaluator = rdb.Evaluator(tiny_root, LATTICE)
    evaluator.update(first, lattice[first])
    with pytest.raises(rdb.InputError, match=f"{len(others)} of {len(lattice)} views are missing") as caught:
        evaluator.compute()
    for remedy in ("views=", "reset()", "num_sanity_val_steps=0"):
        assert remedy in str(caught.value)
    evaluator.reset()
    evaluator.update(list(lattice), list(lattice.values()))
    selected = rdb.Evaluator(tiny_root, LATTICE, views=[first])
    selected.update(first, lattice[first])
    for complete, views in ((evaluator, len(lattice)), (selected, 1)):
        assert complete.compute().tables[LATTICE].views == views


def test_wrong_views_are_named(tiny_root: Path, lattice: Truth) -> None:
    first, second, *_ = lattice
    evaluator = rdb.Evaluator(tiny_root, LATTICE)
    evaluator.update(first, lattice[first])
    with pytest.raises(rdb.InputError, match=f"{first}: was added before.*sampler"):
        evaluator.update(first, lattice[first])
    with pytest.raises(rdb.InputError, match="lattice/9999: is not among the 9 views"):
        evaluator.update("lattice/9999", lattice[first])
    with pytest.raises(rdb.InputError, match=f"8 of 9 views are missing, such as {second}, expected"):
        evaluator.compute()
    with pytest.raises(rdb.InputError, match="2 view ids and 1 depth maps"):
        evaluator.update([first, second], lattice[first][None])


def test_the_argument_that_selects_what_is_predicted_is_named(tiny_root: Path, lattice: Truth) -> None:
    orbit = rdb.Evaluator(tiny_root, "lattice-orbit").view_ids
    words = (
        f"{len(orbit)} of {len(orbit) + len(lattice)} views are missing, .* is of lattice-orbit: config='lattice'"
    )
    with pytest.raises(rdb.InputError, match=words):
        rdb.evaluate(lattice, tiny_root)
    assert rdb.evaluate(lattice, tiny_root, config="lattice").tables[LATTICE]["coverage"] == 1
    with pytest.raises(rdb.InputError, match=f"{min(lattice)}: is not among .*; config=, split= and views="):
        rdb.evaluate(lattice, tiny_root, config="lattice-orbit")


def test_an_exception_of_a_model_names_the_view(tiny_root: Path) -> None:
    second = rdb.Evaluator(tiny_root, LATTICE).view_ids[1]

    def model(row: Any) -> np.ndarray:
        if row["view_id"] == second:
            raise KeyError("depth")
        return np.ones(row["left_rgb"].shape[:2])

    with pytest.raises(
        rdb.InputError, match=f"^{second}: the model: raised KeyError: 'depth' .*{Path(__file__).name}:"
    ) as e:
        rdb.evaluate(model, tiny_root, config=LATTICE)
    assert isinstance(e.value.__cause__, KeyError)


def test_a_network_that_is_given_a_row_is_told_of_a_function(tiny_root: Path) -> None:
    torch = pytest.importorskip("torch")
    net = torch.nn.Conv2d(3, 1, 3, padding=1)
    with pytest.raises(rdb.InputError, match="a Conv2d that is given a row; wrap it") as e:
        rdb.evaluate(net, tiny_root, config=LATTICE)
    function = eval(re.search("lambda row: .* / 255[)]", str(e.value))[0], {"net": net, "torch": torch})  # type: ignore[index]
    assert list(rdb.evaluate(function, tiny_root, config=LATTICE).tables) == [LATTICE]


def test_smaller_maps_are_resized_as_the_message_says(
    tiny_root: Path, lattice: Truth, archive_of: Callable[..., Path]
) -> None:
    cv2 = pytest.importorskip("cv2")
    small = {view_id: depth_m[::2, ::2] for view_id, depth_m in lattice.items()}
    height, width = next(iter(lattice.values())).shape
    sizes = rf"{height // 2}\D+{width // 2}\b.*expected.*{height}\D+{width}\b.*; resize it by (.*)"
    ways: list[Callable[[], object]] = [
        lambda: rdb.evaluate(small, tiny_root, config=LATTICE),
        lambda: rdb.score(archive_of(small), tiny_root),
    ]
    for evaluate in ways:
        with pytest.raises(rdb.InputError) as e:
            evaluate()
        how = re.findall(sizes, str(e.value))[0]
        resized = {view_id: eval(how, {"depth": depth, "cv2": cv2}) for view_id, depth in small.items()}
        assert rdb.evaluate(resized, tiny_root, config=LATTICE).tables[LATTICE].views == len(lattice)


def test_turned_and_flat_maps_are_not_to_be_resized(
    tiny_root: Path, lattice: Truth, archive_of: Callable[..., Path]
) -> None:
    turned = {view_id: np.ascontiguousarray(depth_m.T) for view_id, depth_m in lattice.items()}
    flat = {view_id: depth_m.reshape(1, -1) for view_id, depth_m in lattice.items()}
    for wrong in (turned, flat):
        with pytest.raises(rdb.InputError) as by_evaluate:
            rdb.evaluate(wrong, tiny_root, config=LATTICE)
        with pytest.raises(rdb.InputError) as by_score:
            rdb.score(archive_of(wrong), tiny_root)
        assert "resize" not in f"{by_evaluate.value} {by_score.value}"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"views": 0}, "views is 0"),
        ({"views": ["lattice/9999"]}, "views has lattice/9999"),
        ({"views": "lattice/9999"}, "views has lattice/9999"),
        ({"views": []}, "views has no id"),
        ({"views": 2.5}, "views is 2.5, expected a whole number from 1 or view ids"),
        ({"views": np.array(3)}, r"views is array\(3\), expected a whole number from 1"),
        ({"views": True}, "views is True, expected a whole number from 1"),
        ({"kind": "depth"}, '^arguments: .*\n  - kind: .*"metric", "scale", "affine-depth" or'),
        ({"inputs": "sonar"}, "inputs"),
        ({"split": "train"}, "train"),
        ({"config": "none"}, "no config 'none'"),
        ({"config": ["lattice"]}, "expected the name of one"),
    ],
)
def test_arguments_are_checked_before_any_prediction(tiny_root: Path, arguments: Any, words: str) -> None:
    with pytest.raises(rdb.InputError, match=words):
        rdb.Evaluator(tiny_root, **arguments)


@pytest.mark.parametrize("model", [None, 3, np.ones((9, 90, 160)), [np.ones((90, 160))], {1: np.ones((90, 160))}])
def test_models_of_other_types_are_refused(tiny_root: Path, model: Any) -> None:
    with pytest.raises(rdb.InputError, match=f"of type {type(model).__name__}, expected the name of a method"):
        rdb.evaluate(model, tiny_root, config=LATTICE)


@pytest.mark.parametrize(
    ("depth", "words"),
    [
        (None, r"the model returned None, expected an array of floats of shape \(90, 160\)"),
        ("depth", "the model returned an object of type str, expected an array"),
        (
            {"depth": np.ones((90, 160)), "valid": 1},
            "the model returned an object of type dict with the keys depth, valid, expected an array",
        ),
        (np.ones((90, 160), int), r"int64 of shape \(90, 160\), expected an array of floats"),
        (np.ma.MaskedArray(np.ones((90, 160)), mask=True), "masked array"),  # type: ignore[no-untyped-call]
        ([[1.0] * 160] * 90, None),
    ],
)
def test_what_is_no_depth_is_refused(tiny_root: Path, depth: Any, words: str | None) -> None:
    if words is None:
        assert rdb.evaluate(lambda _: depth, tiny_root, config=LATTICE, views=1).tables[LATTICE]["coverage"] == 1
    else:
        with pytest.raises(rdb.InputError, match=f"lattice/.*{words}"):
            rdb.evaluate(lambda _: depth, tiny_root, config=LATTICE)


def test_archive_of_a_method_is_temporary(
    tiny_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    result = rdb.evaluate("constant", tiny_root, config=LATTICE)
    assert (result.method, result.submission.inputs, result.submission.sha256) == ("constant", "rgb", None)
    assert not list(tmp_path.iterdir())
