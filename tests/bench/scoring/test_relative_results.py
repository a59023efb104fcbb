"""Results of predictions that are not metric: their numbers, and archives of several kinds."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import rebar_depth_bench as rdb
from rebar_depth_bench.scoring.columns import METRICS, interval_columns
from rebar_depth_bench.scoring.reading import read_result
from rebar_depth_bench.scoring.result import Result
from tests.bench.scoring.conftest import Values, Write, disparity


def numbers(document: Any) -> Any:
    """Return a JSON value with approximate numbers, for comparisons."""
    if isinstance(document, dict):
        return {key: numbers(value) for key, value in document.items()}
    return pytest.approx(document, rel=1e-5, abs=1e-9) if isinstance(document, float) else document


def test_result_of_another_kind(relative: Result) -> None:
    document = json.loads(relative.to_json())
    assert (document["protocol"], document["prediction"]) == ("rebar-relative-1", "affine-disparity")
    assert "declared_prediction" not in document
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
        assert again.tables["lattice"].intervals.keys() == {column.place for column in interval_columns(one.kind)}
    assert json.loads(scaled.to_json())["tables"]["lattice"]["aligned_robust"] is None
    assert json.loads(empty.to_json())["tables"]["lattice"]["aligned"]["abs_rel"] is None
    mixed = relative.to_json().replace(b"rebar-relative-1", b"rebar-2")
    with pytest.raises(rdb.InputError, match="the protocol is rebar-2 and prediction is affine-disparity"):
        read_result(mixed, "result.json")


def test_results_that_lack_the_numbers_of_their_kind_are_refused(
    relative: Result, write: Write, tiny_root: Path
) -> None:
    metric = rdb.score(write("metric", "metric", lambda z: z), tiny_root)

    def refuse(result: Result, change: Callable[[Any], object], words: str) -> None:
        document = json.loads(result.to_json())
        change(document)
        with pytest.raises(rdb.InputError, match=words):
            read_result(json.dumps(document).encode(), "result.json")

    refuse(relative, lambda top: top.update(prediction="metric"), "prediction: .*metric.*expected .*scale")
    refuse(metric, lambda top: top.update(declared_prediction="metric"), "declared_prediction without prediction")
    refuse(relative, lambda top: top.update(prediction="scale"), "aligned_robust, .*expected aligned, constant")
    aligned = json.loads(relative.to_json())["views"][0]["aligned"]
    places: list[Callable[[Any], Any]] = [lambda top: top["tables"]["lattice"], lambda top: top["views"][0]]
    for at in places:
        for name in ("constant", "aligned_robust"):
            words = "or view has aligned, [a-z_]+, expected aligned, aligned_robust, constant"
            refuse(relative, lambda top, at=at, name=name: at(top).update({name: None}), words)  # type: ignore[misc]
        words = "or view has rank_error, aligned, expected rank_error"
        refuse(metric, lambda top, at=at: at(top).update(aligned=aligned), words)  # type: ignore[misc]


def test_intervals_are_those_of_the_view_numbers(relative: Result) -> None:
    """Nine sparse views are nine blocks: the interval of the mean contains it and is narrower than the views."""
    table = relative.tables["lattice"]
    for column in interval_columns(relative.kind)[1:]:
        values = [view.number(column) for view in relative.views]
        low, high = table.intervals[column.place] or (np.nan, np.nan)
        assert min(values) <= low <= table.number(column) <= high <= max(values)


def test_scale_has_the_scaled_numbers_of_metric_results(write: Write, tiny_root: Path) -> None:
    holed = write("holed", None, lambda z: np.where(np.indices(z.shape)[1] % 3, 5 * z, 0))
    metric, aligned = rdb.score(holed, tiny_root), rdb.score(holed, tiny_root, align="scale")
    assert aligned.kind == "scale"
    for native, of_scale in zip(metric.views, aligned.views, strict=True):
        assert [of_scale[f"aligned.{name}"] for name in METRICS] == [native[f"scaled.{name}"] for name in METRICS]
        for name in ("abs_rel", "rmse_cm"):
            constant = native[f"reference.scaled_constant.{name}"]
            assert of_scale[f"constant.{name}"] == pytest.approx(constant)
        assert of_scale["coverage"] == native["coverage"] < 1
        assert of_scale["aligned.error"] > 1 - of_scale["coverage"]


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
        tolerance = 2e-3 if "within" in column.place else 1e-6
        assert list(first[column.name]) == pytest.approx(list(second[column.name]), rel=1e-4, abs=tolerance)
    with pytest.raises(rdb.SubmissionError, match=f"of the kind {kind}, expected metric ones: .*scored as scale"):
        rdb.score(tmp_path / "other.zip", tiny_root, align="scale")
    for align in ("metric", "metres"):  # As the command.
        words = f"align is {align}, expected one of scale, affine-depth, .*, or None, which scores metric .*"
        with pytest.raises(rdb.InputError, match=words):
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
    assert whole["coverage"] == 1
    assert 0.3 < holed["coverage"] < 0.7
    assert holed["aligned.error"] == pytest.approx(1 - holed["coverage"], abs=0.05)
    assert holed["flat_views"] == 0


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
