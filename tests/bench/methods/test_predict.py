"""Prediction runs: lookup of methods, archives, errors and interruption."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rebar_depth_bench import evaluate, score
from rebar_depth_bench.base.errors import InputError, MethodError
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.methods import (
    METHODS,
    Method,
    MethodInfo,
    MultiViewMethod,
    Prepared,
    Views,
    all_methods,
    find_method,
    own_methods,
)
from rebar_depth_bench.methods.base import input_class
from rebar_depth_bench.methods.run import predict
from rebar_depth_bench.submission import INPUTS
from tests.bench.methods.predictors import counting_method, metadata_of, orbit_view_ids, stop_after
from tests.damage import change_manifest, copy_dataset

USER_METHOD = """
import numpy as np
from rebar_depth_bench.methods import Method, MethodInfo

def load():
    def run(row):
        assert set(row) == {"view_id", "left_rgb", "left_K"}
        with open(LOG, "a") as log:
            print(row["view_id"], file=log)
        return np.full(row["left_rgb"].shape[:2], row["left_K"][0, 0] / 200, np.float32)
    return run

METHOD = Method(MethodInfo("own", "a test", ("left_rgb", "left_K"), True, "here", "MIT"), load)
NOTHING = "no method"
"""


@pytest.fixture
def user_file(tmp_path: Path) -> Path:
    """Write a user's file with a method that logs the id of every view it predicts."""
    path = tmp_path / "own.py"
    path.write_text(USER_METHOD.replace("LOG", repr(str(tmp_path / "log"))))
    return path


def test_user_file_is_usable_as_method(user_file: Path, tiny_root: Path, tmp_path: Path) -> None:
    archive = tmp_path / "own.zip"
    command = ["predict", f"{user_file}:METHOD", "--data", str(tiny_root), "--out", str(archive)]
    assert main([*command, "--config", "lattice"]) == 0
    result = score(archive, tiny_root)
    assert result.method == "own"
    assert result.tables["lattice"].ranked
    seconds = metadata_of(archive)["runtime"]["seconds"]
    assert list(seconds) == (tmp_path / "log").read_text().split()
    assert all(0 <= value < 60 for value in seconds.values())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["log", "own.py", "own.zip"]


def test_method_of_another_kind_declares_it(tiny_root: Path, tmp_path: Path) -> None:
    code = USER_METHOD.replace("LOG", repr(str(tmp_path / "log"))).replace('"MIT"', '"MIT", prediction="KIND"')
    code = code.replace('row["left_K"][0, 0] / 200, np.float32', "-row['left_rgb'][..., 0] / 9 - 2.0")
    path, archive = tmp_path / "own.py", tmp_path / "own.zip"
    path.write_text(code.replace("KIND", "affine-depth"))
    predict(find_method(f"{path}:METHOD"), tiny_root, archive, configs=["lattice"])
    assert metadata_of(archive)["prediction"] == "affine-depth"
    result = score(archive, tiny_root)
    assert (result.kind, result.tables["lattice"]["coverage"]) == ("affine-depth", 1.0), "values <= 0 are kept"
    evaluated = evaluate(f"{path}:METHOD", tiny_root, config="lattice")
    assert evaluated.to_dict()["tables"] == result.to_dict()["tables"]
    path.write_text(code.replace("KIND", "depth"))
    words = f"^{path}: own: prediction is 'depth', expected one of metric, scale, affine-depth"
    with pytest.raises(MethodError, match=words):
        find_method(f"{path}:METHOD")


def test_method_that_reads_ground_truth_declares_it(user_file: Path, tiny_root: Path, tmp_path: Path) -> None:
    code = user_file.read_text()
    for columns, read in {
        '"left_rgb", "left_depth", "right_bars"': "left_depth, right_bars",
        '"left_rgb", "left_preview"': "left_preview",
        '"left_rgb", "left_cam_from_world"': "left_cam_from_world",
        '"right_rgb", "left_cam_from_world"': "left_cam_from_world",
    }.items():
        user_file.write_text(code.replace('"left_rgb", "left_K"', columns))
        words = f"{user_file}: own: reads {read}, expected MethodInfo(..., uses_ground_truth=True)"
        with pytest.raises(MethodError, match=f"^{re.escape(words)}$"):
            find_method(f"{user_file}:METHOD")
        user_file.write_text(user_file.read_text().replace('"MIT"', '"MIT", uses_ground_truth=True'))
        assert find_method(f"{user_file}:METHOD").info.uses_ground_truth
    assert {name for name, method in own_methods().items() if method.info.uses_ground_truth} == {
        *("truth", "noisy-truth", "colmap-anchored", "sweep-anchored", "lidar-survey", "lidar-mobile")
    }


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("magic", "unknown method 'magic', expected one of sgbm, sgbm-filled, "),
        ("nowhere.py:METHOD", "nowhere.py: no such file"),
        ("my_stereo.py", "my_stereo.py: names no method in the file, expected my_stereo.py:METHOD"),
        ("OWN:NOTHING", "is str, expected a rebar_depth_bench.methods.Method"),
        ("OWN:ABSENT", "own.py: has no ABSENT, expected the name of a method in it"),
        ("BROKEN:METHOD", "cannot be imported: ZeroDivisionError: division by zero"),
    ],
)
def test_unknown_method_raises_with_reason(name: str, words: str, user_file: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.py"
    broken.write_text("1 / 0")
    with pytest.raises(MethodError, match=re.escape(words)):
        find_method(name.replace("OWN", str(user_file)).replace("BROKEN", str(broken)))


@pytest.mark.parametrize("returned", ["np.ones((3, 4))", "np.ones((90, 160), int)", "None"])
def test_invalid_prediction_stops_run(returned: str, user_file: Path, tiny_root: Path, tmp_path: Path) -> None:
    text = user_file.read_text()
    user_file.write_text(re.sub(r"return np\.full.*", f"return {returned}", text))
    with pytest.raises(MethodError, match=r"own: lattice.* returned .*, expected an array of floats of"):
        predict(find_method(f"{user_file}:METHOD"), tiny_root, tmp_path / "x.zip", configs=["lattice-orbit"])
    assert len((tmp_path / "log").read_text().split()) == 1
    assert not (tmp_path / "x.zip").exists()


def test_entry_point_methods_are_listed_as_plain_text(
    user_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    info = tmp_path / "site" / "stranger-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: stranger\nVersion: 1.0\n")
    entries = {"theirs": "own_copy:METHOD", "bad": "own_copy:NOTHING", "gone": "nowhere:X", "wrong": "bad_code:X"}
    lines = [f"{name} = {value}" for name, value in entries.items()]
    (info / "entry_points.txt").write_text("\n".join(["[rebar_depth_bench.methods]", *lines]))
    code = user_file.read_text().replace('"a test"', r'"[red]a\x1b[2J[/]"').replace('"here"', '"[/nothing]"')
    code = code.replace('"MIT"', '"MIT", prediction="affine-disparity"')
    (tmp_path / "site" / "own_copy.py").write_text(code)
    (tmp_path / "site" / "bad_code.py").write_text("raise ImportError('pip install x[onnx] [/end]')")
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    monkeypatch.setenv("COLUMNS", "300")
    assert find_method("theirs").info.licence == "MIT"
    methods = all_methods()
    assert list(methods)[: len(METHODS)] == list(METHODS)
    assert isinstance(methods["bad"], MethodError)
    assert "cannot be imported: ModuleNotFoundError" in str(methods["gone"])
    assert main(["methods"]) == 0
    listed = capsys.readouterr().out
    assert all(words in listed for words in ("theirs", r"[red]a\x1b[2J[/]", "cannot be used"))
    assert main(["methods", "theirs"]) == 0
    shown = capsys.readouterr().out
    for words in ("theirs", "predictions of the kind affine-disparity", r"[red]a\x1b[2J[/]", "[/nothing]"):
        assert words in shown
    assert "\x1b" not in listed + shown
    assert main(["methods", "sgbm"]) == 0
    assert "of the kind" not in capsys.readouterr().out, "metric methods do not say so"
    assert main(["methods", "wrong"]) == 2
    assert "pip install x[onnx] [/end]" in capsys.readouterr().err


def test_ground_truth_controls_score_as_expected(tiny_root: Path, tmp_path: Path) -> None:
    tables = {}
    for name in ("truth", "noisy-truth"):
        predict(find_method(name), tiny_root, tmp_path / f"{name}.zip", configs=["lattice"])
        tables[name] = score(tmp_path / f"{name}.zip", tiny_root).tables["lattice"]
    assert tables["truth"]["native.abs_rel"] == 0
    noisy = tables["noisy-truth"]
    assert noisy["scale_median"] == pytest.approx(0.8, rel=2e-3)
    assert noisy["native.abs_rel"] == pytest.approx(0.25, rel=0.01)
    mean_of_gaussian = 0.01 * (2 / np.pi) ** 0.5
    assert noisy["scaled.abs_rel"] == pytest.approx(mean_of_gaussian, rel=0.05)


def test_user_file_is_a_module_that_imports_files_beside_it(
    tiny_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    for name, value in (("when_loaded", "0.5"), ("when_run", "1.0")):
        (tmp_path / f"own_{name}.py").write_text(f"VALUE = {value}\n")
    path = tmp_path / "own_module.py"
    path.write_text("""
from __future__ import annotations
import pickle
from dataclasses import dataclass, field
from typing import ClassVar
import numpy as np
from rebar_depth_bench.methods import Method, MethodInfo

@dataclass
class Settings:
    unused: ClassVar[int] = 0
    values: list[float] = field(default_factory=list)

def load():
    import own_when_loaded
    def run(row):
        import own_when_run
        settings = pickle.loads(pickle.dumps(Settings([own_when_loaded.VALUE, own_when_run.VALUE])))
        return np.full(row["left_rgb"].shape[:2], sum(settings.values), np.float32)
    return run

METHOD = Method(MethodInfo("own", "a test", ("left_rgb",), False, "here", "MIT"), load)
""")
    predict(find_method(f"{path}:METHOD"), tiny_root, tmp_path / "own.zip", configs=["lattice-orbit"])
    assert not (tmp_path / "__pycache__").exists()
    path = path.rename(tmp_path / "json.py")  # The name of another module, which stays what it is.
    assert find_method(f"{path}:METHOD").info.name == "own"
    assert sys.modules["json"] is json


def test_interrupted_run_is_resumed_with_the_same_method_and_images_only(
    user_file: Path, tiny_root: Path, tmp_path: Path
) -> None:
    """Other lights or sample counts leave the ground truth unchanged, but not the images."""
    archive, (first, second) = tmp_path / "out.zip", orbit_view_ids(tiny_root)
    run = partial(predict, archive=archive, configs=["lattice-orbit"])
    method = find_method(f"{user_file}:METHOD")
    user_file.write_text(user_file.read_text() + "# changed\n")
    changed = find_method(f"{user_file}:METHOD")
    again = [first, first, second]
    other = copy_dataset(tiny_root, tmp_path / "other")
    change_manifest(other, lambda manifest, _: manifest["configs"]["lattice-orbit"]["scenes"][0].update(key="x"))
    for resumed, root, predicted in (
        (method, tiny_root, [first, second]),
        (method, other, again),
        (changed, tiny_root, again),
    ):
        (tmp_path / "log").unlink(missing_ok=True)
        with pytest.raises(KeyboardInterrupt):
            run(method, tiny_root, progress=stop_after(1))
        assert not archive.exists()
        run(resumed, root)
        assert (tmp_path / "log").read_text().split() == predicted
        assert len(metadata_of(archive)["runtime"]["seconds"]) == 2
        assert not list(tmp_path.glob(".*"))
        archive.unlink()


@pytest.mark.parametrize(
    ("words", "code"),
    [
        ("load returned NoneType, expected a function of a row", "pass"),
        ("load: raised FileNotFoundError: weights.pth", "raise FileNotFoundError('weights.pth')"),
        (
            "lattice-orbit/0025: the predictor, given view_id, left_rgb: raised KeyError: 'left_depth'",
            "return lambda row: row['left_depth']",
        ),
    ],
)
def test_error_in_user_code_names_its_location(
    words: str, code: str, tiny_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "wrong.py"
    info = "MethodInfo('wrong', 'a test', ('left_rgb',), False, 'here', 'MIT')"
    path.write_text(
        f"from rebar_depth_bench.methods import *\ndef load():\n    {code}\nMETHOD = Method({info}, load)\n"
    )
    command = ["predict", f"{path}:METHOD", "--data", str(tiny_root), "--out", str(tmp_path / "out.zip")]
    assert main([*command, "--config", "lattice-orbit"]) == 2
    stderr = capsys.readouterr().err
    assert f"error: wrong: {words}" in stderr
    assert "Traceback" not in stderr
    assert "raised" not in words or f"({path}:" in stderr


@pytest.mark.parametrize(
    ("notes", "words"),
    [
        (lambda row: {"bad": row["left_K"]}, "lattice: the note 'bad' is not a plain JSON value"),
        (lambda _: None, "lattice: notes: raised AttributeError"),
        (lambda row: {"fx": row["right_K"]}, "lattice: notes: raised KeyError: 'right_K'"),
    ],
)
def test_notes_of_single_view_method_are_checked_first(
    notes: Any, words: str, tiny_root: Path, tmp_path: Path
) -> None:
    """The notes function receives the method's columns; nothing is predicted or written if it fails."""
    info = MethodInfo("one", "a test", ("left_K",), True, "here", "MIT")
    method = Method(info, load=lambda: lambda _: pytest.fail("predicted"), notes=notes)
    with pytest.raises(MethodError, match=f"one: {re.escape(words)}"):
        predict(method, tiny_root, tmp_path / "one.zip")
    assert not list(tmp_path.iterdir())


def test_check_and_notes_of_multi_view_method_stop_the_run(tiny_root: Path, tmp_path: Path) -> None:
    log: list[str] = []
    method = counting_method(log)

    def check(views: Views) -> None:
        method.check(views)
        assert views.config == "lattice", "does not fit"

    def prepare(*arguments: Any) -> Prepared:
        return replace(method.prepare(*arguments), notes={"bad": float("nan")})

    with pytest.raises(MethodError, match="whole: lattice-orbit: check: raised AssertionError: does not fit"):
        predict(replace(method, check=check), tiny_root, tmp_path / "whole.zip")
    assert log == ["check lattice", "check lattice-orbit"]
    assert not list(tmp_path.iterdir())
    with pytest.raises(MethodError, match="whole: lattice: the note 'bad' is not a plain JSON value"):
        predict(replace(method, prepare=prepare), tiny_root, tmp_path / "whole.zip")
    assert log[-1].startswith("prepare")


@pytest.mark.parametrize("read", ["left_depth", "mesh"])
def test_multi_view_method_declares_the_ground_truth_that_it_reads(
    tiny_root: Path, tmp_path: Path, read: str
) -> None:
    def prepare(views: Views, *_: Any) -> Prepared:
        [views] = views.by_scene()
        if read == "mesh":
            assert views.mesh.is_file()
            return Prepared(lambda _: np.ones(views.grid, np.float32))
        depth_m = {row["view_id"]: row["left_depth"] for row in views.rows("left_depth")}
        return Prepared(lambda row: depth_m[row["view_id"]])

    method = replace(counting_method([]), prepare=prepare)
    words = f"^whole: reads {read}, expected MethodInfo(..., uses_ground_truth=True)$"
    with pytest.raises(MethodError, match=words.replace("(", r"\(").replace(")", r"\)")):
        predict(method, tiny_root, tmp_path / "whole.zip", configs=["lattice"])
    assert not (tmp_path / "whole.zip").exists()
    method = replace(method, info=replace(method.info, uses_ground_truth=True))
    predict(method, tiny_root, tmp_path / "whole.zip", configs=["lattice"])
    assert not score(tmp_path / "whole.zip", tiny_root).tables["lattice"].ranked


def test_columns_given_as_string_raise_an_error() -> None:
    with pytest.raises(MethodError, match="mine: columns is the text 'left_rgb', expected a tuple of names"):
        MethodInfo("mine", "a test", "left_rgb", False, "here", "MIT")  # type: ignore[arg-type]


def test_folder_as_archive_is_rejected_before_prediction(tiny_root: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is a folder, expected the name of the archive"):
        predict(find_method("truth"), tiny_root, tmp_path, configs=["lattice-orbit"])
    assert list(tmp_path.iterdir()) == []


def test_input_classes_of_bundled_methods() -> None:
    methods = own_methods()
    expected = {
        **dict.fromkeys(("sgbm", "foundation-stereo"), "stereo"),
        **dict.fromkeys(("constant", "unidepth"), "rgb"),
        "metric3d": "rgb+K",
        "sweep-aruco": "multi-view",
        "lidar-mobile": "lidar",
        "truth": None,
    }
    assert {name: input_class(methods[name]) for name in expected} == expected
    for method in methods.values():
        reads_images = isinstance(method, MultiViewMethod) or "left_rgb" in method.info.columns
        assert (input_class(method) in INPUTS) or not reads_images
        assert input_class(replace(method, info=replace(method.info, inputs="lidar"))) == "lidar"
