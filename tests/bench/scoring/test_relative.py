"""Predictions that are not metric: fits against closed forms and minimisers, results, and what refuses them."""

from __future__ import annotations

import csv
import io
import json
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.optimize import minimize

import rebar_depth_bench as rdb
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.scoring import relative as scoring
from rebar_depth_bench.scoring.columns import RELATIVE_INTERVALS
from rebar_depth_bench.scoring.result import Result, read_result
from rebar_depth_bench.scoring.table import AlignedErrors
from tests.bench.reporting.pages import Page

KINDS = ("scale", "affine-depth", "affine-disparity")
AFFINE = KINDS[1:]
Values = np.ndarray
Write = Callable[..., Path]


# The definitions once more, from NumPy's own functions.


@dataclass
class Expected:
    """Aligned depth on V, and the numbers that follow from it."""

    p: Values
    z: Values
    scored_px: int

    def check(self, errors: AlignedErrors) -> None:
        p, z = self.p, self.z
        e = np.where(p > 0, np.abs(p - z) / np.maximum(p, z), 1.0)
        assert errors.error == pytest.approx((e.sum() + self.scored_px - len(p)) / self.scored_px, rel=1e-9)
        assert errors.abs_rel == pytest.approx(np.mean(np.abs(p - z) / z), rel=1e-9)
        assert errors.rmse_cm == pytest.approx(100 * np.sqrt(np.mean((p - z) ** 2)), rel=1e-9)
        assert errors.mae_cm == pytest.approx(100 * np.mean(np.abs(p - z)), rel=1e-9)
        with np.errstate(divide="ignore"):
            inliers = (p > 0) & (np.maximum(p / z, z / p) < 1.25)
        assert errors.delta1 == pytest.approx(inliers.mean())
        for tolerance_mm, share in errors.within_mm.items():
            assert share == pytest.approx(np.sum(np.abs(p - z) <= tolerance_mm / 1000) / self.scored_px)


def depth_of(line: Values, z: Values, kind: str) -> Values:
    """Aligned depth of the fitted target."""
    return 1 / np.maximum(line, 1 / z.max()) if kind == "affine-disparity" else line


@dataclass
class Found:
    """Errors of a view as they were found, without None where every view has errors."""

    coverage: float
    aligned: AlignedErrors
    aligned_robust: AlignedErrors | None
    constant: AlignedErrors
    is_flat: bool | None


def align_view(x: Values, z: Values, kind: str) -> Found:
    view = scoring.align_view("lattice/0000", x, z, kind)
    assert view.aligned is not None
    assert view.constant is not None
    assert (view.scored_px, view.rank_error, view.native) == (len(z), None, None)
    return Found(view.coverage, view.aligned, view.aligned_robust, view.constant, view.is_flat)


def check_view(x: Values, z: Values, kind: str) -> None:
    """Compare a view with the definitions, from ``numpy.linalg.lstsq`` and ``numpy.median``."""
    found = align_view(x, z, kind)
    x, z, scored_px = x.astype(float), z.astype(float), len(z)
    valid = np.isfinite(x) if kind in AFFINE else np.isfinite(x) & (x > 0)
    x, z = x[valid], z[valid]
    assert found.coverage == len(x) / scored_px
    if kind == "scale":
        Expected(x * np.median(z) / np.median(x), z, scored_px).check(found.aligned)
        Expected(np.full(len(z), np.median(z)), z, scored_px).check(found.constant)
        assert found.aligned_robust is None
        assert not found.is_flat
        return
    y = 1 / z if kind == "affine-disparity" else z
    is_constant = len(x) < 2 or np.ptp(x) == 0
    mean_line = np.full(len(x), y.mean())
    robust_line = line = mean_line
    if not is_constant:
        (a, b), *_ = np.linalg.lstsq(np.stack([x, np.ones(len(x))], 1), y, rcond=None)
        line = a * x + b if a > 0 else mean_line
        x_off, y_off = x - np.median(x), y - np.median(y)
        robust_line = np.abs(y_off).mean() / np.abs(x_off).mean() * x_off + np.median(y)
    Expected(depth_of(line, z, kind), z, scored_px).check(found.aligned)
    assert found.aligned_robust is not None
    Expected(depth_of(robust_line, z, kind), z, scored_px).check(found.aligned_robust)
    Expected(depth_of(mean_line, z, kind), z, scored_px).check(found.constant)
    assert found.is_flat == bool(is_constant or a <= 0)


def true_depth(seed: int, count: int = 400) -> Values:
    return np.random.default_rng(seed).uniform(0.3, 1.2, count).astype(np.float32)


def prediction(z: Values, kind: str, noise: float, seed: int = 0) -> Values:
    """Values that ``kind`` brings to the truth but for noise."""
    rng = np.random.default_rng(seed)
    target: Values = {"scale": 0.01 * z, "affine-depth": 7 * z - 9, "affine-disparity": 20 / z - 90}[kind]
    return np.asarray(target + noise * float(target.std()) * rng.standard_normal(len(z)), np.float32)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("noise", [0.0, 0.05, 1.0, 20.0])
def test_errors_are_those_of_the_definitions(kind: str, noise: float) -> None:
    for seed in range(5):
        z = true_depth(seed)
        x = prediction(z, kind, noise, seed)
        check_view(x, z, kind)
        x[::3], x[1::7] = np.nan, np.inf
        check_view(x, z, kind)
        if kind in AFFINE:
            check_view(x[:3], z[:3], kind)


@pytest.mark.parametrize("kind", AFFINE)
def test_least_squares_are_the_minimum(kind: str) -> None:
    """Compare with a minimiser that knows neither derivatives nor the closed form."""
    z = true_depth(3, 60).astype(float)
    x = prediction(z, kind, 0.3).astype(float)
    y = 1 / z if kind == "affine-disparity" else z

    def squares(ab: Values) -> float:
        return float(np.sum((ab[0] * x + ab[1] - y) ** 2))

    options = {"xatol": 1e-13, "fatol": 1e-15, "maxiter": 5000, "maxfev": 5000}
    best = minimize(squares, [0.01, 1.0], method="Nelder-Mead", options=options)
    p = depth_of(best.x[0] * x + best.x[1], z, kind)
    assert align_view(x, z, kind).aligned.abs_rel == pytest.approx(np.mean(np.abs(p - z) / z), rel=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_scale_and_shift_of_the_prediction_change_nothing(kind: str) -> None:
    z = true_depth(1)
    x = prediction(z, kind, 0.2).astype(float)
    shifts = [(2.0**40, 0.0), (0.37, 0.0), *([(1e3, 5e3), (4.0, -1e3)] if kind in AFFINE else [])]
    for factor, shift in shifts:
        changed, found = (align_view(values, z, kind).aligned for values in (x, factor * x + shift))
        assert vars(found) | {"within_mm": 0} == pytest.approx(vars(changed) | {"within_mm": 0}, rel=1e-7)


@pytest.mark.parametrize("kind", AFFINE)
@pytest.mark.parametrize(
    "make",
    [
        lambda x: -x,
        lambda x: np.full_like(x, 4.0),
        lambda x: np.where(np.arange(len(x)) == 5, x, np.nan),
        lambda x: np.zeros_like(x),
    ],
    ids=["negative slope", "constant", "one pixel", "zero"],
)
def test_flat_fits_are_constants(kind: str, make: Callable[[Values], Values]) -> None:
    z = true_depth(2)
    x = make(prediction(z, kind, 0.1))
    check_view(x, z, kind)
    found = align_view(x, z, kind)
    assert found.is_flat
    assert found.aligned == found.constant


@pytest.mark.parametrize("kind", KINDS)
def test_views_without_values(kind: str) -> None:
    x = np.array([np.nan, np.inf, -np.inf])
    for values in (x, *([np.array([0.0, -1.0, np.nan])] if kind == "scale" else [])):
        found = align_view(values, true_depth(0, 3), kind)
        assert found.coverage == 0
        assert found.is_flat == (kind in AFFINE)
        assert (found.aligned_robust is None) == (kind == "scale")
        assert (found.aligned.error, found.aligned.abs_rel, found.aligned.within_mm[20]) == (1.0, None, 0.0)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("unit", [1e-40, 1e-300, 1e30, 1e306])
def test_values_near_the_limits_of_floats(kind: str, unit: float) -> None:
    z = true_depth(4)
    x = prediction(z, kind, 0.1).astype(float)
    plain, huge = (align_view(values, z, kind) for values in (x, unit * x))
    assert huge.aligned.error == pytest.approx(plain.aligned.error, rel=1e-9)
    assert huge.aligned_robust is None or plain.aligned_robust is not None
    if huge.aligned_robust is not None and plain.aligned_robust is not None:
        assert huge.aligned_robust.error == pytest.approx(plain.aligned_robust.error, rel=1e-9)
    outlier = np.where(np.arange(len(x)) == 7, 1.7e308, x)
    assert 0 < align_view(outlier, z, kind).aligned.error <= 1


@pytest.mark.parametrize("kind", AFFINE)
def test_constant_truth_has_no_slope(kind: str) -> None:
    for depth_m in np.linspace(0.3, 1.8, 16):  # The means of some are rounded, which leaves a slope above 0.
        found = align_view(np.linspace(0, 1, 7) ** 2, np.full(7, depth_m), kind)
        assert found.is_flat
        assert found.aligned.error == pytest.approx(0, abs=1e-15)


def test_disparity_is_bounded_by_the_farthest_truth() -> None:
    z = np.array([0.5, 0.6, 0.9, 1.0, 1.0])
    x = np.array([2.0, 1.6, 1.1, 1.0, -3.0])  # The last one is fitted to a negative disparity.
    check_view(x, z, "affine-disparity")
    (a, b), *_ = np.linalg.lstsq(np.stack([x, np.ones(5)], 1), 1 / z, rcond=None)
    assert a * x[-1] + b < 1 / z.max()


def test_depth_at_or_below_zero_is_an_error_of_one() -> None:
    z = np.array([0.3, *[0.4] * 4, *[3.1] * 4])
    x = np.array([0.0, *[2.0] * 4, *[3.0] * 4])
    check_view(x, z, "affine-depth")
    (_, b), *_ = np.linalg.lstsq(np.stack([x, np.ones(9)], 1), z, rcond=None)
    assert b < 0, "the depth of the first pixel"
    assert align_view(x, z, "affine-depth").aligned.error >= 1 / 9


# Results of archives.


def disparity(depth_m: Values) -> Values:
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(depth_m > 0, 30 / depth_m - 70, -99), np.float32)


@pytest.fixture
def write(tiny_truth: dict[str, np.ndarray], tmp_path: Path) -> Write:
    """Write an archive of a function of the true depth of the lattice."""

    def write_archive(name: str, kind: str | None, make: Callable[[Values], Values]) -> Path:
        path = tmp_path / f"{name}.zip"
        with rdb.SubmissionWriter(path, name, prediction=kind, inputs="rgb", uses_ground_truth=False) as writer:
            for number, (view_id, depth_m) in enumerate(tiny_truth.items()):
                rng = np.random.default_rng(number)
                writer.add(view_id, make(depth_m) * (1 + 0.01 * rng.standard_normal(depth_m.shape)))
        return path

    return write_archive


@pytest.fixture
def relative(write: Write, tiny_root: Path) -> Result:
    return rdb.score(write("net", "affine-disparity", disparity), tiny_root)


def numbers(document: Any) -> Any:
    """Return a JSON value with approximate numbers, for comparisons."""
    if isinstance(document, dict):
        return {key: numbers(value) for key, value in document.items()}
    return pytest.approx(document, rel=1e-5, abs=1e-9) if isinstance(document, float) else document


def test_result_of_another_kind(relative: Result) -> None:
    document = json.loads(relative.to_json())
    assert (document["protocol"], document["prediction"]) == ("rebar-relative-1", "affine-disparity")
    [table] = document["tables"].values()
    nulls = {table[key] for key in ("native", "scaled", "rank_error", "scale_median")}
    assert (nulls, table["ranked"], table["flat_views"]) == ({None}, False, 0)
    for view in document["views"]:
        assert {view[key] for key in ("native", "scaled", "rank_error", "scale")} == {None}
    for alignment in ("aligned", "aligned_robust", "constant"):
        views = [view[alignment] for view in document["views"]]
        assert list(views[0]) == ["error", "abs_rel", "rmse_cm", "mae_cm", "delta1", "within_mm"]
        mean = {key: np.mean([view[key] for view in views]) for key in views[0] if key != "within_mm"}
        within = {t: np.mean([view["within_mm"][t] for view in views]) for t in ("3", "5", "10", "20")}
        assert table[alignment] == numbers({**mean, "within_mm": within})
    assert table["aligned"]["error"] < table["constant"]["error"] / 3


def test_result_is_read_as_it_was_written(relative: Result, tiny_root: Path, write: Write) -> None:
    scaled = rdb.score(write("scaled", "scale", lambda z: 3 * z), tiny_root)
    empty = rdb.score(write("empty", "affine-depth", lambda z: z * np.nan), tiny_root)
    for one in (relative, scaled, empty):
        again = read_result(one.to_json(), "result.json")
        assert again.to_json() == one.to_json()
        assert (again.kind, again.columns) == (one.kind, one.columns)
        assert again.tables["lattice"].intervals.keys() == {column.path for column in RELATIVE_INTERVALS}
    assert json.loads(scaled.to_json())["tables"]["lattice"]["aligned_robust"] is None
    assert json.loads(empty.to_json())["tables"]["lattice"]["aligned"]["abs_rel"] is None
    mixed = relative.to_json().replace(b"rebar-relative-1", b"rebar-2")
    with pytest.raises(rdb.InputError, match="the protocol is rebar-2 and prediction is affine-disparity"):
        read_result(mixed, "result.json")


def test_intervals_are_those_of_the_view_numbers(relative: Result) -> None:
    """Nine sparse views are nine blocks: the interval of the mean contains it and is narrower than the views."""
    table = relative.tables["lattice"]
    for column in RELATIVE_INTERVALS[1:]:
        values = [column.view_value(view) or 0.0 for view in relative.views]
        low, high = table.intervals[column.path] or (np.nan, np.nan)
        assert min(values) <= low <= column.value(table) <= high <= max(values)


def test_scale_has_the_scaled_numbers_of_metric_results(write: Write, tiny_root: Path) -> None:
    holed = write("holed", None, lambda z: np.where(np.indices(z.shape)[1] % 3, 5 * z, 0))
    metric, aligned = rdb.score(holed, tiny_root), rdb.score(holed, tiny_root, align="scale")
    assert aligned.kind == "scale"
    for native, of_scale in zip(metric.views, aligned.views, strict=True):
        assert native.scaled is not None
        assert of_scale.aligned is not None
        assert of_scale.constant is not None
        assert vars(native.scaled).items() <= vars(of_scale.aligned).items()
        assert (of_scale.constant.abs_rel, of_scale.constant.rmse_cm) == pytest.approx(native.scaled_constant)
        assert of_scale.coverage == native.coverage < 1
        assert of_scale.aligned.error > 1 - of_scale.coverage


@pytest.mark.parametrize(("kind", "make"), [("affine-depth", lambda z: z), ("affine-disparity", lambda z: 1 / z)])
def test_metric_archives_are_aligned_as_weaker_kinds(
    kind: str, make: Callable[[Values], Values], tmp_path: Path, tiny_root: Path, tiny_truth: dict[str, np.ndarray]
) -> None:
    """Metric depth aligned as another kind has the errors of an archive of that kind."""
    rng = np.random.default_rng(0)
    with (
        rdb.SubmissionWriter(tmp_path / "metric.zip", "m") as metric,
        rdb.SubmissionWriter(tmp_path / "other.zip", "m", prediction=kind) as other,
    ):
        for view_id, depth_m in tiny_truth.items():
            noisy = np.where(rng.random(depth_m.shape) < 0.1, np.nan, depth_m) + 0.5
            metric.add(view_id, noisy)
            other.add(view_id, make(noisy))
    aligned = rdb.score(tmp_path / "metric.zip", tiny_root, align=kind)
    [first, second] = (one.to_pandas("views") for one in (rdb.score(tmp_path / "other.zip", tiny_root), aligned))
    assert list(first["view_id"]) == list(second["view_id"])
    for column in aligned.columns:  # The archives hold float32: some pixels are at a tolerance.
        tolerance = 2e-3 if "within" in column.path else 1e-6
        assert list(first[column.name]) == pytest.approx(list(second[column.name]), rel=1e-4, abs=tolerance)
    with pytest.raises(rdb.SubmissionError, match=f"of the kind {kind}, expected metric ones: .*scored as scale"):
        rdb.score(tmp_path / "other.zip", tiny_root, align="scale")
    for align in ("metric", "metres"):  # As the command.
        with pytest.raises(
            rdb.InputError, match=f"align is {align}, expected one of scale, affine-depth, affine-d"
        ):
            rdb.score(tmp_path / "metric.zip", tiny_root, align=align)


def test_zero_of_a_png_is_no_value(tiny_root: Path, tiny_truth: dict[str, np.ndarray], tmp_path: Path) -> None:
    paths = {}
    for with_holes in (False, True):
        paths[with_holes] = tmp_path / f"{with_holes}.zip"
        with zipfile.ZipFile(paths[with_holes], "w") as archive:
            metadata = {"method": "png", "prediction": "affine-disparity", "depth_scale": 0.5}
            archive.writestr("submission.json", json.dumps(metadata))
            for view_id, depth_m in tiny_truth.items():
                values = disparity(depth_m)
                values = np.clip(400 * (values - values.min()), 1, 65535).astype(np.uint16)
                values[::2] *= not with_holes
                image = io.BytesIO()
                Image.fromarray(values).save(image, "PNG")
                archive.writestr(f"{view_id}.png", image.getvalue())
    whole, holed = (rdb.score(path, tiny_root).tables["lattice"] for path in paths.values())
    assert whole.coverage == 1
    assert 0.3 < (holed.coverage or 0) < 0.7
    assert holed.aligned is not None
    assert holed.aligned.error == pytest.approx(1 - (holed.coverage or 0), abs=0.05)
    assert holed.flat_views == 0


def test_metric_json_has_no_keys_of_other_kinds(write: Write, tiny_root: Path) -> None:
    path = write("metric", "metric", lambda z: z)
    with zipfile.ZipFile(path) as archive:
        assert "prediction" not in json.loads(archive.read("submission.json"))
    document = json.loads(rdb.score(path, tiny_root).to_json())
    assert (document["protocol"], "prediction" in document) == ("rebar-2", False)
    table, view = document["tables"]["lattice"], document["views"][0]
    assert list(table) == [
        *("views", "views_scored", "coverage", "ranked", "rank_error", "native", "scaled", "scale_median"),
        *("within_mm", "reference", "published", "ci95"),
    ]
    assert list(table["ci95"]) == ["coverage", "rank_error", "native", "scaled", "scale_median", "within_mm"]
    shared = ("coverage", "rank_error", "scale", "native", "scaled", "within_mm")
    assert list(view) == ["view_id", "scored_px", *shared]


def test_unknown_kind_is_refused(tiny_root: Path, archive_of: Write, tiny_truth: dict[str, np.ndarray]) -> None:
    path = archive_of(tiny_truth)
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    entries["submission.json"] = b'{"method": "m", "prediction": "disparity"}'
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    with pytest.raises(rdb.SubmissionError, match="prediction: got 'disparity', expected"):
        rdb.score(path, tiny_root)


# Presentation.


def test_text_of_a_result(relative: Result, tiny_root: Path, write: Write) -> None:
    lines = str(relative).splitlines()
    assert lines[0].split("  ")[-6:] == [
        *("coverage", "aligned error", "AbsRel", "robust AbsRel", "constant", "within 5 mm")
    ]
    table = relative.tables["lattice"]
    assert table.aligned is not None
    assert table.aligned_robust is not None
    assert table.constant is not None
    errors = (table.aligned.error, table.aligned.abs_rel, table.aligned_robust.abs_rel, table.constant.abs_rel)
    within = f"{100 * (table.aligned.within_mm[5] or 0):.1f}"
    assert lines[1].split() == ["lattice", "100.0", "%", *(f"{value:.4f}" for value in errors), within, "%"]
    assert lines[2].startswith("affine-disparity: disparity up to scale and shift")
    assert len(lines) == 3
    assert f"aligned error {table.aligned.error:.4g}, constant {table.constant.error:.4g}" in repr(relative)
    assert "rebar-relative-1 (affine-disparity)" in relative._repr_html_()
    flat = str(rdb.score(write("flat", "affine-depth", lambda z: -z), tiny_root))
    assert "above 95 % of that of a constant" in flat
    assert "In 9 of 9 views the fit has no positive slope" in flat


def test_frames(relative: Result) -> None:
    frame, views = relative.to_pandas(), relative.to_pandas("views")
    table = json.loads(relative.to_json())["tables"]["lattice"]
    row = frame.iloc[0]
    assert (row["prediction"], row["ranked"], row["flat_views"]) == ("affine-disparity", False, 0)
    assert row["aligned_robust_within_5mm"] == table["aligned_robust"]["within_mm"]["5"]
    assert [row["constant_error_low"], row["constant_error_high"]] == table["ci95"]["constant"]["error"]
    assert "native_abs_rel" not in frame
    assert views["aligned_error"].mean() == pytest.approx(table["aligned"]["error"])
    assert not views["is_flat"].any()
    assert relative.to_pandas("groups").empty
    assert relative.metrics["lattice/aligned/within_mm/5"] == pytest.approx(row["aligned_within_5mm"])


def test_score_command(
    tiny_root: Path, tmp_path: Path, write: Write, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    metric = write("metric", None, lambda z: 1.1 * z)
    arguments = ["score", str(metric), "--data", str(tiny_root), "--align", "affine-disparity"]
    files = {name: tmp_path / f"result.{name}" for name in ("json", "csv", "html")}
    options = [text for name, path in files.items() for text in (f"--{name}", str(path))]
    assert main([*arguments, *options]) == 0
    output = capsys.readouterr()
    assert "mistake" not in output.err
    expected = rdb.score(metric, tiny_root, align="affine-disparity")
    assert files["json"].read_bytes() == expected.to_json()
    [row] = csv.DictReader(io.StringIO(files["csv"].read_text()))
    table = expected.tables["lattice"]
    assert table.aligned is not None
    assert table.constant is not None
    assert float(row["aligned_error"]) == pytest.approx(table.aligned.error)
    lines = [line.split() for line in output.out.splitlines()]
    [constant] = [line for line in lines if line[:1] == ["constant"]]
    assert constant[1:3] == [f"{value:.4f}" for value in (table.constant.error, table.constant.abs_rel)]
    text = Page(files["html"].read_text()).text
    for column in RELATIVE_INTERVALS[1:]:
        assert column.text(column.value(table)) in text
    assert all(view.view_id in text for view in expected.views)
    assert "affine-disparity: disparity up to scale and shift" in text
    assert "Rank error" not in text


def test_table_has_a_block_for_each_kind(tiny_root: Path, tmp_path: Path, write: Write, capsys: Any) -> None:
    worse = write("worse", "affine-depth", lambda z: z**-2)
    better = write("better", "affine-depth", lambda z: 5 * z - 3)
    metric = write("sound", None, lambda z: z)
    net = write("net", "affine-disparity", disparity)
    latex, frame = tmp_path / "table.tex", tmp_path / "table.csv"
    archives = [str(path) for path in (net, worse, metric, better)]
    arguments = ["table", *archives, "--data", str(tiny_root)]
    assert main([*arguments, "--latex", str(latex), "--csv", str(frame), "--no-published"]) == 0
    out = capsys.readouterr().out
    order = [out.index(f"\n{name} ") for name in ("sound", "better", "worse", "net")]
    assert order == sorted(order)
    assert "worse: The aligned error" in out
    rows = list(csv.DictReader(io.StringIO(frame.read_text())))
    assert [row["method"] for row in rows] == ["sound", "better", "worse", "net"]
    assert [row["prediction"] for row in rows] == ["", "affine-depth", "affine-depth", "affine-disparity"]
    assert [row["flat_views"] for row in rows] == ["", "0", "9", "0"]
    text = latex.read_text()
    assert text.count(r"\begin{table*}") == 3
    blocks = text.split(r"\begin{table*}")
    assert [r"\label{tab:rebar-depth-affine-depth}" in block for block in blocks] == [False, False, True, False]
    assert blocks[2].index("better &") < blocks[2].index("worse &")
    assert "textbf" not in blocks[2]
    assert "ddagger" not in blocks[2]
    figure = tmp_path / "figure.svg"
    assert main([*arguments, "--figure", str(figure)]) == 2
    assert "expected metric ones: the figure shows native errors" in capsys.readouterr().err
    assert not figure.exists()
    shared = ["table", str(metric), str(net), "--data", str(tiny_root), "--align", "affine-disparity"]
    assert main(shared) == 0
    assert "rank err" not in capsys.readouterr().out


def test_compare(tiny_root: Path, write: Write, capsys: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    net = write("net", "affine-disparity", disparity)
    blurred = write("blurred", "affine-disparity", lambda z: disparity(z) + 25 * np.indices(z.shape)[1] % 3)
    metric = write("metric", None, lambda z: z)
    assert main(["compare", str(net), str(metric), "--data", str(tiny_root)]) == 2
    words = "metric has predictions of the kind metric, expected affine-disparity as net"
    assert words in " ".join(capsys.readouterr().err.split())
    assert main(["compare", str(net), str(blurred), "--data", str(tiny_root), "--json", "-"]) == 0
    [document] = json.loads(capsys.readouterr().out)
    assert document["protocol"] == "rebar-relative-1"
    rows = {row["name"]: row for row in document["configs"]["lattice"]}
    results = [rdb.score(path, tiny_root).tables["lattice"].aligned for path in (net, blurred)]
    assert [rows["aligned.error"][key] for key in ("first", "other")] == [
        pytest.approx(one.error) for one in results if one is not None
    ]
    assert (rows["aligned.error"]["verdict"], rows["constant.error"]["verdict"]) == ("worse", "equal")
    assert "native.abs_rel" not in rows
    assert main(["compare", str(net), str(blurred), "--data", str(tiny_root)]) == 0
    assert "…" not in capsys.readouterr().out, "numbers are never truncated"


def test_extended_measures_and_paper_scripts_are_refused(tiny_root: Path, write: Write, capsys: Any) -> None:
    net = write("net", "affine-disparity", disparity)
    assert main(["score", str(net), "--data", str(tiny_root), "--extended"]) == 2
    assert "expected metric ones: extended measures are in metres" in capsys.readouterr().err
    metric = write("metric", None, lambda z: z)
    assert main(["score", str(metric), "--data", str(tiny_root), "--extended", "--align", "scale"]) == 2
    assert "--align and --extended are both given" in capsys.readouterr().err
    with pytest.raises(rdb.InputError, match="extended is true and kind is scale"):
        rdb.Evaluator(tiny_root, "lattice", extended=True, kind="scale")


def test_disparity_is_no_mistake(tiny_root: Path, write: Write, capsys: Any) -> None:
    def check(name: str, kind: str, make: Callable[[Values], Values]) -> str:
        assert main(["check", str(write(name, kind, make)), "--data", str(tiny_root)]) == 0
        return str(capsys.readouterr().err)

    with np.errstate(divide="ignore"):
        assert "mistake" in check("undeclared", "metric", lambda z: 1 / z)
    declared = check("declared", "affine-disparity", disparity)
    assert "mistake" not in declared
    assert "not ranked: " in declared
    assert "affine-disparity, expected metric ones: the leaderboard ranks depth in metres" in declared
    assert "not ranked" not in check("undeclared", "metric", lambda z: z)
    assert "mistake" not in check("millimetres", "scale", lambda z: 1000 * z)
    assert "mistake" not in check("negative", "affine-depth", lambda z: z - 90)
    assert "0.0 % are finite and above 0" in check("none", "scale", lambda z: z - 90)
    assert "0.0 % are finite\n" in check("infinite", "affine-depth", lambda z: z * np.inf)
    assert "the same at all pixels in 8 of 8 views" in check("zero", "affine-depth", lambda z: 0 * z)


def test_evaluation_of_another_kind(tiny_root: Path, tiny_truth: dict[str, np.ndarray], tmp_path: Path) -> None:
    predictions = {view_id: disparity(depth_m) for view_id, depth_m in tiny_truth.items()}
    result = rdb.evaluate(predictions, tiny_root, config="lattice", kind="affine-disparity", method="net")
    result.save_archive(tmp_path / "net.zip")
    assert result.to_json() == rdb.score(tmp_path / "net.zip", tiny_root).to_json()
    assert result.notes[0].startswith("affine-disparity: disparity up to scale and shift")
    assert len(result.notes) == 1
    result.to_html(tmp_path / "report.html")
    assert "affine-disparity" in Page((tmp_path / "report.html").read_text()).text
