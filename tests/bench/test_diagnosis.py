"""Diagnosis of submissions: every mistake is named, sound predictions are not, and results stay as they are."""

from __future__ import annotations

import io
import json
import math
import re
import zipfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy.stats import spearmanr

from rebar_depth_bench import SubmissionWriter, score
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.rows import iterate_rows
from rebar_depth_bench.diagnosis.corrections import (
    MAX_VIEWS,
    UNITS,
    DiagnosedView,
    KeptPredictions,
    Pixels,
    mean_error,
    positions_to_read,
    rank_correlation,
    shape_corrections,
)
from rebar_depth_bench.geometry.cameras import Camera, ideal_K
from rebar_depth_bench.methods import own_methods
from rebar_depth_bench.methods.run import predict
from rebar_depth_bench.scoring.evaluation import open_evaluation
from tests.commands import run_in_process
from tests.mistakes import SOUND, diagnosed, learned_like, mistakes, mistakes_named
from tests.synthetic_dataset import write_dataset

pytestmark = pytest.mark.slow

Rows = list[dict[str, np.ndarray]]
_COLUMNS = ("view_id", "left_depth", "left_mask", "left_K", "baseline_m")

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
    "factor",
    "disparity",
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
        assert diagnosed(evaluation) == []


@pytest.fixture(scope="module")
def stereo(tiny_root: Path, rows: Rows, tmp_path_factory: pytest.TempPathFactory) -> list[np.ndarray]:
    """Depth of SGBM, whose errors within the small pictures are above those of a plane at one depth."""
    archive = tmp_path_factory.mktemp("stereo") / "sgbm.zip"
    predict(own_methods()["sgbm-filled"], tiny_root, archive, configs=["lattice"])
    with open_evaluation(archive, tiny_root) as evaluation:
        return [np.array(evaluation.submission.read(str(row["view_id"]))) for row in rows]


@pytest.mark.parametrize("name", [*UNITS, "factor", "disparity", "inverse", "reversed", "mirrored"])
def test_mistake_in_stereo_depth_is_named(
    name: str, tiny_root: Path, tmp_path: Path, rows: Rows, stereo: list[np.ndarray]
) -> None:
    assert _named(tiny_root, tmp_path, rows, mistakes(rows)[name](stereo)) == [name]


@pytest.mark.parametrize("factor", [1e-3, 0.02, 1 / 20.5, 20.5, 60.0, 3000.0, 1e6])
def test_factor_that_no_method_has_is_named(factor: float, tiny_root: Path, tmp_path: Path, rows: Rows) -> None:
    archive = tmp_path / "factor.zip"
    _write(archive, rows, [factor * row["left_depth"] for row in rows])
    with open_evaluation(archive, tiny_root) as evaluation:
        [mistake] = diagnosed(evaluation)
    assert (mistake.name, f" {factor:.4g} times the depth" in mistake.text) == ("factor", True)


def test_factor_that_varies_over_the_views_is_no_mistake(tiny_root: Path, tmp_path: Path, rows: Rows) -> None:
    factors = 50 * np.exp(0.3 * (-1.0) ** np.arange(len(rows)))
    images = [factor * row["left_depth"] for factor, row in zip(factors, rows, strict=True)]
    assert _named(tiny_root, tmp_path, rows, images) == []


@pytest.mark.parametrize("depth_scale", [1.0, 1000.0])
def test_depth_scale_that_undoes_the_factor_is_named(
    depth_scale: float, tiny_root: Path, tmp_path: Path, rows: Rows
) -> None:
    archive = tmp_path / "png.zip"
    with zipfile.ZipFile(archive, "w") as target:
        target.writestr("submission.json", json.dumps({"method": "png", "depth_scale": depth_scale}))
        for row in rows:
            image = io.BytesIO()
            Image.fromarray(np.rint(1000 * row["left_depth"]).astype(np.uint16)).save(image, "png")
            target.writestr(f"{row['view_id']}.png", image.getvalue())
    with open_evaluation(archive, tiny_root) as evaluation:
        [mistake] = diagnosed(evaluation)
    assert mistake.name == ("millimetres" if depth_scale == 1 else "factor")
    assert float(mistake.text.rpartition(f"; depth_scale is {depth_scale:g}, try ")[2]) == pytest.approx(0.001)


def test_filled_holes_are_not_taken_for_other_pixels(tiny_root: Path, tmp_path: Path, rows: Rows) -> None:
    """A plane at the median depth has smaller errors than stereo depth, and lies wherever there is no steel."""
    random = np.random.default_rng(2)
    images = []
    for row in rows:
        seen = row["left_mask"] & (random.random(row["left_mask"].shape) < 0.5)
        depth_m = row["left_depth"] * np.exp(random.normal(0, 0.2, seen.shape))
        images.append(np.where(seen, depth_m, np.median(depth_m[seen])))
    assert _named(tiny_root, tmp_path, rows, images) == []


RANDOM = np.random.default_rng(1)


@pytest.mark.parametrize(
    "make",
    [
        *(partial(np.multiply, 1 / scale) for scale in (0.16, 0.3048, 0.5, 2.0, 5.0, 12.58)),
        *(lambda z, most=most: RANDOM.uniform(0.1, most, z.shape) for most in (1.0, 5.0, 32.0, 64.0, 128.0)),
        lambda z: (noise := RANDOM.uniform(0, 1, z.shape)) / noise.max(),
        lambda z: np.full(z.shape, 1000.0),
        lambda z: np.full(z.shape, np.median(z[z > 0]) / 0.3048),
        lambda z: 0.5 + 0.01 * np.indices(z.shape)[0] + RANDOM.uniform(0, 1e-6),
        lambda z: 1e38 * RANDOM.uniform(0.5, 1, z.shape),
    ],
    ids=[
        *(f"scaled {n}" for n in range(6)),
        *(f"noise {n}" for n in range(5)),
        *("normalised noise", "constant", "constant in feet", "plane", "huge"),
    ],
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
            "natural logarithms of depth in metres: the mean error after scaling is 100.0 %, and ",
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
    looked_at = min(MAX_VIEWS, len(rows))
    assert re.search(rf"\b{looked_at} (of|views looked at, of) {len(rows)}\b", checked.stderr)
    assert checked.stdout == f"{archive}: the archive is valid\n"


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
        views = KeptPredictions.of_archive(config, evaluation.submission).views()
    assert [view.position for view in views] == positions
    assert all((view.prediction == view.position).all() for view in views)


@given(st.floats(1e-3, 1e3), st.floats(0.0, 5.0))
def test_inverse_depth_with_any_scale_and_offset_is_fitted(a: float, b: float) -> None:
    z_m = np.linspace(0.5, 3.0, 300)
    pixels = Pixels(np.zeros(300, np.int64), np.arange(300), z_m)
    image = (a / z_m + b)[None]
    corrections = shape_corrections([_view(pixels, image)], 1)
    _, fitted = (one for one in corrections if one.name == "inverse")
    assert mean_error(fitted.corrected(_view(pixels, image)), z_m, 1.0) < 0.03
    assert np.isnan(fitted.corrected(_view(pixels, z_m[None]))).all(), "a line that falls"


@given(st.lists(st.integers(-4, 4), min_size=3, max_size=30), st.integers(0, 99))
def test_rank_correlation_is_that_of_spearman(values: list[int], seed: int) -> None:
    p = np.array(values, np.float64)
    z_m = np.random.default_rng(seed).integers(1, 6, len(p)).astype(np.float64)
    valid = p > 0
    if np.unique(p[valid]).size > 1 and np.unique(z_m[valid]).size > 1:
        expected = spearmanr(p[valid], z_m[valid]).statistic
        assert rank_correlation(p, z_m) == pytest.approx(expected, abs=1e-12)
    else:
        assert math.isnan(rank_correlation(p, z_m))


def _view(pixels: Pixels, image: np.ndarray) -> DiagnosedView:
    camera = Camera(ideal_K(*image.shape[::-1]), np.zeros(5), np.eye(4), *image.shape[::-1])
    return DiagnosedView(0, camera, 0.12, pixels, pixels, image, by_order={})


def _named(root: Path, folder: Path, rows: Rows, images: Sequence[np.ndarray]) -> list[str]:
    archive = folder / "submission.zip"
    _write(archive, rows, images)
    with open_evaluation(archive, root) as evaluation:
        return [mistake.name for mistake in diagnosed(evaluation)]


def _write(archive: Path, rows: Rows, images: Sequence[np.ndarray]) -> None:
    with SubmissionWriter(archive, method="made") as writer:
        for row, image in zip(rows, images, strict=True):
            writer.add(str(row["view_id"]), image.astype(np.float32))
