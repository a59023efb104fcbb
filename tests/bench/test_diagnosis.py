"""Diagnosis of submissions: every mistake is named, sound predictions are not, and results stay as they are."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rebar_depth_bench import SubmissionWriter, score
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.rows import iterate_rows
from rebar_depth_bench.diagnosis.corrections import (
    COLUMNS,
    MAX_VIEWS,
    UNITS,
    DiagnosedView,
    Pixels,
    best_shift,
    diagnosed_view,
    line_error,
    mean_error,
    median_ratio,
    positions_to_read,
    resistant_line,
)
from rebar_depth_bench.diagnosis.diagnose import diagnose
from rebar_depth_bench.methods import own_methods
from rebar_depth_bench.methods.run import predict
from rebar_depth_bench.scoring.evaluation import open_evaluation
from tests.commands import run_in_process
from tests.mistakes import SOUND, learned_like, mistakes, mistakes_named
from tests.synthetic_dataset import write_dataset

pytestmark = pytest.mark.slow

Rows = list[dict[str, np.ndarray]]
_COLUMNS = ("view_id", "left_depth", "left_K", "baseline_m")

ORDERS = ("reversed", "one-early", "one-late", "as-text", "from-text")
ORDERS_OF_TEXT = ("as-text", "from-text")
"""Orders that differ from the right one with more than ten views only."""


@pytest.fixture(scope="module")
def rows(tiny_root: Path) -> Rows:
    config = open_folder(tiny_root).config("lattice")
    return list(iterate_rows(config, _COLUMNS))


@pytest.fixture(scope="module")
def named_for_truth(tiny_root: Path, rows: Rows) -> dict[str, str]:
    return mistakes_named(tiny_root, rows, [row["left_depth"] for row in rows])


MADE = (
    "inverse",
    "range",
    "mirrored",
    "upside-down",
    "rotated",
    "shift",
    "right-eye",
    "same-map",
    *("log", "log10", "normalised", "negative", "infinite", "nan"),
    *UNITS,
    *ORDERS,
)


@pytest.mark.parametrize("name", [name for name in MADE if name not in ORDERS_OF_TEXT])
def test_mistake_in_exact_depth_is_named(named_for_truth: dict[str, str], name: str) -> None:
    assert named_for_truth[name] == "yes"
    assert named_for_truth[SOUND] == "-"
    assert set(named_for_truth) == {SOUND, *MADE}, "every correction has a mistake"


def test_mistakes_in_learned_predictions_are_named_or_nothing_is(tiny_root: Path, rows: Rows) -> None:
    named = mistakes_named(tiny_root, rows, learned_like([row["left_depth"] for row in rows]))
    assert named[SOUND] == "-"
    # Depth that is too far has the wrong disparity, so that seen from the right it looks shifted.
    assert {cell for name, cell in named.items() if name != "right-eye"} == {"yes", "-"}
    assert {name for name, cell in named.items() if cell == "yes"} >= {"millimetres", "inverse", "mirrored"}


@pytest.mark.parametrize("method", ["sgbm", "sgbm-filled", "board-plane", "constant", "noisy-truth"])
def test_sound_predictions_of_own_methods_are_not_mistaken(method: str, tiny_root: Path, tmp_path: Path) -> None:
    archive = tmp_path / "submission.zip"
    predict(own_methods()[method], tiny_root, archive, configs=["lattice"])
    with open_evaluation(archive, tiny_root) as evaluation:
        assert diagnose(evaluation) == []


@pytest.mark.parametrize("unit", UNITS)
def test_unit_of_stereo_depth_is_named(unit: str, tiny_root: Path, tmp_path: Path, rows: Rows) -> None:
    archive = tmp_path / "sgbm.zip"
    predict(own_methods()["sgbm-filled"], tiny_root, archive, configs=["lattice"])
    with open_evaluation(archive, tiny_root) as evaluation:
        images = [np.array(evaluation.submission.read(str(row["view_id"]))) for row in rows]
    assert _named(tiny_root, tmp_path, rows, mistakes(rows)[unit](images)) == [unit]


RANDOM = np.random.default_rng(1)


@pytest.mark.parametrize(
    "make",
    [
        *(partial(np.multiply, scale) for scale in (0.2, 0.35, 1 / 3, 0.5, 2.0, 3.0, 50.0)),
        lambda z: RANDOM.uniform(0.1, 5.0, z.shape),
        lambda z: np.full(z.shape, 1000.0),
        lambda z: np.full(z.shape, np.median(z[z > 0]) / 0.3048),
        lambda z: 0.5 + 0.01 * np.indices(z.shape)[0] + RANDOM.uniform(0, 1e-6),
        lambda z: 1e38 * RANDOM.uniform(0.5, 1, z.shape),
    ],
    ids=[*(f"scaled {n}" for n in range(7)), "noise", "constant", "constant in feet", "plane", "huge"],
)
def test_wrong_scale_and_prediction_without_structure_are_no_mistake(
    make: Callable[[np.ndarray], np.ndarray], tiny_root: Path, tmp_path: Path, rows: Rows
) -> None:
    assert _named(tiny_root, tmp_path, rows, [make(row["left_depth"]) for row in rows]) == []


def test_too_few_views_give_no_diagnosis(tiny_root: Path, tmp_path: Path) -> None:
    orbit = list(iterate_rows(open_folder(tiny_root).config("lattice-orbit"), ("view_id", "left_depth")))
    assert len(orbit) == 2
    assert _named(tiny_root, tmp_path, orbit, [1000 * row["left_depth"] for row in orbit]) == []


@pytest.mark.parametrize("order", ORDERS_OF_TEXT)
def test_order_of_numbers_as_text_is_named(order: str, tmp_path: Path) -> None:
    root = tmp_path / "dataset"
    write_dataset(root, ["lattice"], 24)
    rows = list(iterate_rows(open_folder(root).config("lattice"), _COLUMNS))
    images = mistakes(rows)[order]([row["left_depth"] for row in rows])
    assert _named(root, tmp_path, rows, images) == [order]


def test_commands_print_notes_and_leave_the_result_alone(tiny_root: Path, tmp_path: Path, rows: Rows) -> None:
    """A sound submission has no notes."""
    archive, result, page = (tmp_path / name for name in ("mm.zip", "result.json", "report.html"))
    _write(archive, rows, [1000 * row["left_depth"] for row in rows])
    options = ("--data", tiny_root, "--json", result, "--html", page, "--html-views", "0")
    scored = run_in_process(main, "score", archive, *options)
    checked = run_in_process(main, "check", archive, "--data", tiny_root)
    for finished in (scored, checked):
        assert finished.returncode == 0
        assert finished.stderr.count("possible mistake: ") == 1
        assert "in millimetres" in finished.stderr
        assert "mistake" not in finished.stdout
    assert "Possible mistake: " in page.read_text()
    assert result.read_bytes() == score(archive, tiny_root).to_json()
    _write(archive, rows, [row["left_depth"] for row in rows])
    only_page = ("--data", tiny_root, "--html", page, "--html-views", "0")
    assert "mistake" not in run_in_process(main, "score", archive, *only_page).stderr
    assert "mistake" not in page.read_text()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda z: np.full_like(z, math.nan), "0.0 % are infinite, 100.0 % are NaN, 0.0 % are zero and 0.0 % are"),
        (lambda z: np.full_like(z, -math.inf), "0.0 % are negative, 100.0 % are infinite, 0.0 % are NaN, "),
        (np.negative, "100.0 % are negative, 0.0 % are infinite, 0.0 % are NaN, 0.0 % are zero"),
        (np.zeros_like, "0.0 % are NaN, 100.0 % are zero and 0.0 % are finite and above 0"),
        (
            lambda z: np.log(z + (z == 0)),
            "natural logarithms of depth in metres: the mean error after scaling, 10",
        ),
        (lambda z: z / z.max(), "depth divided by the largest value of each picture: the mean error is "),
    ],
    ids=["NaN", "infinite", "negative", "zero", "logarithm", "normalised"],
)
def test_check_names_values_that_are_no_depth(
    make: Callable[[np.ndarray], np.ndarray], words: str, tiny_root: Path, tmp_path: Path, rows: Rows
) -> None:
    archive = tmp_path / "made.zip"
    _write(archive, rows, [make(row["left_depth"]) for row in rows])
    checked = run_in_process(main, "check", archive, "--data", tiny_root)
    assert checked.returncode == 0
    assert words in checked.stderr
    assert "one picture" not in checked.stderr


def test_at_most_eight_evenly_spaced_views_with_steel_are_read(
    tmp_path: Path, archive_of: Callable[..., Path]
) -> None:
    root = tmp_path / "dataset"
    write_dataset(root, ["lattice"], 30)
    config = open_folder(root).config("lattice")
    positions = positions_to_read(config)
    assert len(positions) == MAX_VIEWS
    assert set(np.diff(positions)) <= {3, 4}

    archive = archive_of({view_id: np.full((90, 160), float(view_id[-4:])) for view_id in config.view_ids})
    with open_evaluation(archive, root) as evaluation:
        views = [diagnosed_view(view) for view in evaluation.views(config, COLUMNS, positions)]
    assert [view.position for view in views] == positions
    assert all((view.prediction == view.position).all() for view in views)


@settings(max_examples=25)
@given(st.integers(-6, 6), st.integers(-6, 6), st.floats(0.1, 10))
def test_best_shift_is_the_made_shift(dv: int, du: int, scale: float) -> None:
    random = np.random.default_rng(3)
    depth_m = random.uniform(1.0, 2.0, (40, 50))
    v, u = (index.ravel() for index in np.mgrid[10:30, 10:40])
    pixels = Pixels(v, u, depth_m[v, u])
    view = DiagnosedView(0, None, pixels, pixels, scale * np.roll(depth_m, (dv, du), (0, 1)))  # type: ignore[arg-type]
    assert best_shift([view]) == (dv, du)


@given(st.floats(0.01, 100), st.floats(-5, 5), st.integers(0, 20))
def test_resistant_line_ignores_outliers(slope: float, intercept: float, outliers: int) -> None:
    x = np.linspace(1.0, 3.0, 99)
    y = slope * x + intercept
    y[:: max(99 // max(outliers, 1), 5)] += 1e6  # At most one in five.
    if outliers == 0:
        y = slope * x + intercept
        assert resistant_line(x, y) == pytest.approx((slope, intercept), abs=1e-6 * (1 + slope))
    found_slope, _ = resistant_line(x, y)
    assert found_slope == pytest.approx(slope, rel=0.7)


@given(st.floats(1e-3, 1e3), st.floats(0.0, 5.0))
def test_inverse_depth_with_any_scale_and_offset_is_fitted(a: float, b: float) -> None:
    z_m = np.linspace(0.5, 3.0, 300)
    p = a / z_m + b
    assert line_error(p, z_m, np.reciprocal) < 0.02
    assert math.isnan(line_error(p, z_m, np.positive))


@given(st.floats(1e-6, 1e6))
def test_mean_error_does_not_depend_on_the_scale(scale: float) -> None:
    random = np.random.default_rng(5)
    z_m, p = random.uniform(0.2, 17, 200), random.uniform(0.2, 17, 200)
    assert mean_error(scale * p, z_m) == pytest.approx(mean_error(p, z_m), rel=1e-9)
    assert median_ratio(scale * p, z_m) * scale == pytest.approx(median_ratio(p, z_m), rel=1e-9)


def _named(root: Path, folder: Path, rows: Rows, images: Sequence[np.ndarray]) -> list[str]:
    archive = folder / "submission.zip"
    _write(archive, rows, images)
    with open_evaluation(archive, root) as evaluation:
        return [mistake.name for mistake in diagnose(evaluation)]


def _write(archive: Path, rows: Rows, images: Sequence[np.ndarray]) -> None:
    with SubmissionWriter(archive, method="made") as writer:
        for row, image in zip(rows, images, strict=True):
            writer.add(str(row["view_id"]), image.astype(np.float32))
