"""Working ranges of tasks on a mat over a deck: what exact and useless depth meets, and the command's files."""

from __future__ import annotations

import csv
import io
import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from scipy.ndimage import gaussian_filter

import rebar_depth_bench as rdb
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.data.files import MANIFEST_FILE
from rebar_depth_bench.extended.frames import AlignedSamples, SteelSamples
from rebar_depth_bench.extended.measures import NATIVE
from rebar_depth_bench.extended.tasks import LASER, TASKS, ConfigTasks
from rebar_depth_bench.extended.working_range import RangeBin
from rebar_depth_bench.geometry.cameras import look_at
from rebar_depth_bench.reporting.tasks import print_tasks
from rebar_depth_bench.scorer import ScoredResult
from tests.commands import run_in_process
from tests.mat_dataset import CONFIG, write_mat_dataset

pytestmark = pytest.mark.slow

VIEWS_AT_DISTANCE = 21
HOSTILE = '=1+1<script>alert("x")</script>[red]&amp;'

Depths = dict[str, np.ndarray]


def poses() -> list[np.ndarray]:
    """Return oblique poses at two distances, and poses at a third one that look straight down on the mat."""
    found = []
    for distance_m in (0.29, 0.45):
        for index in range(VIEWS_AT_DISTANCE):
            aside, along = (-1) ** index * (0.5 + 0.005 * index), 0.3 * np.sin(index)
            eye_m = distance_m * np.array([np.sin(aside), np.sin(along), np.cos(aside) * np.cos(along)])
            found.append(look_at(eye_m, np.zeros(3)))
    for index in range(VIEWS_AT_DISTANCE):
        target_m = 0.02 * np.array([np.sin(index), np.cos(index), 0.0])
        found.append(look_at(target_m + np.array([0.0, 1e-3, 0.6]), target_m))
    return found


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("mat")


@pytest.fixture(scope="module")
def truth(root: Path) -> Depths:
    depths = write_mat_dataset(root, with_deck=True, at=poses())
    return {view_id: depth for view_id, depth in depths.items() if view_id.startswith(f"{CONFIG}/")}


@pytest.fixture(scope="module")
def exact(root: Path, truth: Depths) -> ScoredResult:
    return rdb.evaluate(truth, root, config=CONFIG, extended=True)


def tasks_of(result: rdb.Result) -> ConfigTasks:
    assert result.extended is not None
    return result.extended.tasks[CONFIG]


def bins(tasks: ConfigTasks, state: str, alignment: str = NATIVE) -> dict[str, list[RangeBin]]:
    """Return the bins of a state of each task that has any."""
    found = {task: [one for one in tasks.ranges[task][alignment].bins if one.state == state] for task in TASKS}
    return {task: of_task for task, of_task in found.items() if of_task}


def test_exact_depth_meets_every_tested_bin(exact: ScoredResult) -> None:
    tasks = tasks_of(exact)
    assert bins(tasks, "met").keys() == TASKS.keys(), "each task is tested at some distance"
    assert not bins(tasks, "likely")
    assert not bins(tasks, "not met")
    for by_alignment in tasks.ranges.values():
        assert all(one.share == one.exact for found in by_alignment.values() for one in found.bins)
    [down] = [one for one in bins(tasks, "not tested")["tie_5mm"] if one.from_m == 0.5]
    assert list(down.reasons) == ["plane"], "straight down, a constant at the standoff places ties"
    assert (tasks.views, tasks.laser_views, tasks.unread_views) == (63, 63, 0)


def constants(exact: ScoredResult, truth: Depths, *, known_spacing: bool) -> Depths:
    """Return the median true distance of the bars' fronts, or what makes the median spacing that of the truth."""
    assert exact.extended is not None
    frames = exact.extended.frames[CONFIG].native
    bars, spacings = frames.exact.bars, frames.plane.spacings
    flat = {}
    for view, (view_id, depth_m) in enumerate(truth.items()):
        of_view = bars.view == view
        constant_m = np.median((bars.distance_m - bars.true_diameter_mm / 2000)[of_view])
        ratios = (spacings.true_spacing_mm / spacings.spacing_mm)[spacings.view == view]
        if known_spacing and np.isfinite(ratios).any():
            constant_m *= np.nanmedian(ratios)
        flat[view_id] = np.full_like(depth_m, constant_m)
    return flat


@pytest.mark.parametrize("kind", ["constant", "at the standoff", "by a known spacing", "blurred"])
def test_useless_depth_meets_no_bin(kind: str, root: Path, truth: Depths, exact: ScoredResult) -> None:
    if kind == "constant":
        predictions = {view_id: np.full_like(depth_m, 0.45) for view_id, depth_m in truth.items()}
    elif kind == "blurred":
        predictions = {view_id: gaussian_filter(depth_m, 8.0) for view_id, depth_m in truth.items()}
    else:
        predictions = constants(exact, truth, known_spacing=kind == "by a known spacing")
    tasks = tasks_of(rdb.evaluate(predictions, root, config=CONFIG, extended=True))
    assert bins(tasks, "not met").keys() == TASKS.keys()
    for alignment in (NATIVE, LASER):
        assert not bins(tasks, "met", alignment)
        assert not bins(tasks, "likely", alignment)


def test_depth_that_is_8_mm_too_far_places_no_tie_until_a_laser_reads_it(root: Path, truth: Depths) -> None:
    farther = {view_id: depth_m + np.float32(0.008) for view_id, depth_m in truth.items()}
    half = sorted(truth)[::2]
    for view_id in half:
        farther[view_id][80, 120] = np.nan
    tasks = tasks_of(rdb.evaluate(farther, root, config=CONFIG, extended=True))
    assert not {"tie_5mm", "tie_2mm"} & bins(tasks, "met").keys()
    for one in tasks.ranges["tie_5mm"][NATIVE].bins:
        assert one.bias_mm == pytest.approx(8, abs=0.3)
    assert tasks.unread_views == len(half)
    for one in tasks.ranges["tie_5mm"][LASER].bins:
        assert one.share == pytest.approx(0.5, abs=0.1), "half of the views have no reading"
        assert abs(one.bias_mm) < 2.5, "a factor is right at one distance only"


@pytest.fixture(scope="module")
def files(root: Path, truth: Depths, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of what the command writes for two archives of one hostile name, and one that declares."""
    folder = tmp_path_factory.mktemp("sheet")
    farther = {view_id: depth_m + np.float32(0.004) for view_id, depth_m in truth.items()}
    archives: list[tuple[str, Mapping[str, np.ndarray]]] = [(HOSTILE, truth), (HOSTILE, farther), ("net", truth)]
    paths = [folder / f"{index}.zip" for index in range(len(archives))]
    for path, (method, predictions) in zip(paths, archives, strict=True):
        declared = True if method == "net" else None
        rdb.evaluate(predictions, root, config=CONFIG, method=method, uses_ground_truth=declared, archive=path)
    outputs = [word for kind in ("json", "csv", "html") for word in (f"--{kind}", folder / f"out.{kind}")]
    finished = run_in_process(main, "tasks", *paths, "--data", root, *outputs)
    assert finished.returncode == 0, finished.stderr
    (folder / "out.txt").write_text(finished.stdout)
    return folder


def test_files_of_the_command_have_the_same_numbers(files: Path, exact: ScoredResult) -> None:
    document = json.loads((files / "out.json").read_text())
    first, second, net = document["methods"]
    assert net == "net"
    assert {name.partition(" (")[0] for name in (first, second)} == {HOSTILE}, "told apart by their archives"
    assert document["methods"]["net"][CONFIG] == tasks_of(exact).to_dict()
    rows = list(csv.DictReader((files / "out.csv").read_text().splitlines()))
    for row in rows:
        method = next(name for name in document["methods"] if row["method"][-9:] == name[-9:])
        ranges = document["methods"][method][row["config"]][row["task"]][row["alignment"]]
        [one] = [one for one in ranges["bins"] if one["from_m"] == float(row["from_m"])]
        for name, value in one.items():
            assert row[name] == ("" if value is None else value if name == "state" else json.dumps(value))
        assert (row["not_tested_why"] == "") == (row["state"] != "not tested")
    assert len(rows) == sum(
        len(found["bins"])
        for by_config in document["methods"].values()
        for by_alignment in by_config[CONFIG].values()
        for found in by_alignment.values()
    )
    ties = document["methods"][second][CONFIG]["tie_5mm"]["native"]
    assert ties["runs"] == [{"from_m": 0.25, "to_m": 0.5, "state": "met"}]


def test_sheet_and_text_escape_names(files: Path) -> None:
    page, text = (files / "out.html").read_text(), (files / "out.txt").read_text()
    assert "<script" not in page
    assert "=1+1&lt;script&gt;alert(&#34;x&#34;)&lt;/script&gt;[red]&amp;amp; (" in page
    assert HOSTILE in " ".join(text.split())
    assert all(
        row["method"].startswith(("net", "'="))
        for row in csv.DictReader((files / "out.csv").read_text().splitlines())
    )
    assert page.count('<svg class="chart" role="img"') == len(TASKS)


def test_use_of_ground_truth_and_split_are_stated(files: Path) -> None:
    page, text = (files / "out.html").read_text(), " ".join((files / "out.txt").read_text().split())
    legends = "‡: Not ranked (declares the use of ground truth). ?: Use of ground truth not declared."
    assert "net ‡, native: " in text
    assert legends in text
    assert "<bdi>net ‡</bdi>" in page
    assert all(legend in page for legend in legends.split(". "))
    document = json.loads((files / "out.json").read_text())
    assert [one["uses_ground_truth"] for one in document["submissions"]] == [None, None, True]
    assert document["split"] == {CONFIG: None}
    assert document["laser"]["net"][CONFIG] == {"views": 63, "of_views": 63, "views_without_prediction": 0}
    rows = list(csv.DictReader((files / "out.csv").read_text().splitlines()))
    assert {(row["uses_ground_truth"], row["split"]) for row in rows if row["method"] == "net"} == {("true", "")}


def test_terminal_has_no_section_of_a_task_without_samples(root: Path, exact: ScoredResult) -> None:
    """The laser reads nothing in views without depth at their centre."""
    assert exact.extended is not None
    frames = exact.extended.frames[CONFIG]
    none = np.empty(0, np.int64)
    steel = frames.laser.exact
    empty = SteelSamples(steel.bars.of(none), steel.spacings.of(none), steel.crossings.of(none))
    frames = replace(frames, laser=AlignedSamples(empty, empty, empty), laser_views=0)
    unread = replace(exact, extended=replace(exact.extended, frames={CONFIG: frames}))
    stream = io.StringIO()
    print_tasks([unread], Console(file=stream, width=200))
    text = stream.getvalue()
    assert "per cent: native" in text
    assert "per cent: one laser reading" not in text


def test_report_of_a_score_begins_with_the_sheet(exact: ScoredResult, root: Path, tmp_path: Path) -> None:

    exact.to_html(tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert page.index("Working ranges: mat") < page.index("How to read this")


def test_archives_that_are_not_metric_are_refused(files: Path, root: Path, truth: Depths, tmp_path: Path) -> None:
    path = tmp_path / "relative.zip"
    rdb.evaluate(truth, root, config=CONFIG, kind="scale", archive=path)
    finished = run_in_process(main, "tasks", files / "2.zip", path, "--data", root)
    assert finished.returncode != 0
    assert "metres" in finished.stderr


def test_archives_of_configs_without_bar_ids_are_refused(files: Path, root: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(root, tmp_path / "imported")
    manifest = json.loads((folder / MANIFEST_FILE).read_text())
    entry = manifest["configs"][CONFIG]
    entry["imported"] = {"truth_sigma_m": 0.001, "absent_columns": ["left_bars"]}
    entry["scenes"][0] |= {"assembly": None, "protocol": None, "rig": None, "mesh": None}
    (folder / MANIFEST_FILE).write_text(json.dumps(manifest))
    finished = run_in_process(main, "tasks", files / "2.zip", "--data", folder)
    assert finished.returncode != 0
    assert f"no masks and bar ids in {CONFIG}, expected" in " ".join(finished.stderr.split())
