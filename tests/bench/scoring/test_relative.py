"""Predictions that are not metric: fits against closed forms and minimisers."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from rebar_depth_bench.scoring import relative as scoring
from rebar_depth_bench.scoring.protocol import WITHIN_MM
from rebar_depth_bench.scoring.table import ViewScore

KINDS = ("scale", "affine-depth", "affine-disparity")
AFFINE = KINDS[1:]
Values = np.ndarray


# The definitions once more, from NumPy's own functions.


@dataclass
class Expected:
    """Aligned depth on V, and the numbers that follow from it."""

    p: Values
    z: Values
    scored_px: int

    def check(self, view: ViewScore, alignment: str) -> None:
        p, z = self.p, self.z
        errors = errors_of(view, alignment)
        e = np.where(p > 0, np.abs(p - z) / np.maximum(p, z), 1.0)
        assert errors["error"] == pytest.approx((e.sum() + self.scored_px - len(p)) / self.scored_px, rel=1e-9)
        assert errors["abs_rel"] == pytest.approx(np.mean(np.abs(p - z) / z), rel=1e-9)
        assert errors["rmse_cm"] == pytest.approx(100 * np.sqrt(np.mean((p - z) ** 2)), rel=1e-9)
        assert errors["mae_cm"] == pytest.approx(100 * np.mean(np.abs(p - z)), rel=1e-9)
        with np.errstate(divide="ignore"):
            inliers = (p > 0) & (np.maximum(p / z, z / p) < 1.25)
        assert errors["delta1"] == pytest.approx(inliers.mean())
        for tolerance_mm in WITHIN_MM:
            within = np.sum(np.abs(p - z) <= tolerance_mm / 1000) / self.scored_px
            assert errors[f"within_mm.{tolerance_mm}"] == pytest.approx(within)


def errors_of(view: ViewScore, alignment: str) -> dict[str, float]:
    """Return the numbers of an alignment by their places in it; empty for one that the kind does not have."""
    start = f"{alignment}."
    return {place.removeprefix(start): value for place, value in view.numbers.items() if place.startswith(start)}


def depth_of(line: Values, z: Values, kind: str) -> Values:
    """Aligned depth of the fitted target."""
    return 1 / np.maximum(line, 1 / z.max()) if kind == "affine-disparity" else line


def align_view(x: Values, z: Values, kind: str) -> ViewScore:
    numbers = scoring.aligned_numbers(x, z, kind)
    assert numbers["scored_px"] == len(z)
    return ViewScore("lattice/0000", numbers)


def check_view(x: Values, z: Values, kind: str) -> None:
    """Compare a view with the definitions, from ``numpy.linalg.lstsq`` and ``numpy.median``."""
    found = align_view(x, z, kind)
    x, z, scored_px = x.astype(float), z.astype(float), len(z)
    valid = np.isfinite(x) if kind in AFFINE else np.isfinite(x) & (x > 0)
    x, z = x[valid], z[valid]
    assert found["coverage"] == len(x) / scored_px
    if kind == "scale":
        Expected(x * np.median(z) / np.median(x), z, scored_px).check(found, "aligned")
        Expected(np.full(len(z), np.median(z)), z, scored_px).check(found, "constant")
        assert not errors_of(found, "aligned_robust")
        assert not found["is_flat"]
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
    Expected(depth_of(line, z, kind), z, scored_px).check(found, "aligned")
    Expected(depth_of(robust_line, z, kind), z, scored_px).check(found, "aligned_robust")
    Expected(depth_of(mean_line, z, kind), z, scored_px).check(found, "constant")
    assert found["is_flat"] == bool(is_constant or a <= 0)


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


@pytest.mark.parametrize("kind", KINDS)
def test_scale_and_shift_of_the_prediction_change_nothing(kind: str) -> None:
    z = true_depth(1)
    x = prediction(z, kind, 0.2).astype(float)
    shifts = [(2.0**40, 0.0), (0.37, 0.0), *([(1e3, 5e3), (4.0, -1e3)] if kind in AFFINE else [])]
    for factor, shift in shifts:
        found, expected = (align_view(values, z, kind) for values in (factor * x + shift, x))
        for place in ("error", "abs_rel", "rmse_cm", "mae_cm", "delta1"):
            assert found[f"aligned.{place}"] == pytest.approx(expected[f"aligned.{place}"], rel=1e-7)


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
    assert found["is_flat"]
    assert errors_of(found, "aligned") == errors_of(found, "constant")


@pytest.mark.parametrize("kind", KINDS)
def test_views_without_values(kind: str) -> None:
    x = np.array([np.nan, np.inf, -np.inf])
    for values in (x, *([np.array([0.0, -1.0, np.nan])] if kind == "scale" else [])):
        found = align_view(values, true_depth(0, 3), kind)
        assert found["coverage"] == 0
        assert found["is_flat"] == (kind in AFFINE)
        assert math.isnan(found["aligned_robust.error"]) == (kind == "scale")
        assert (found["aligned.error"], found["aligned.within_mm.20"]) == (1.0, 0.0)
        assert math.isnan(found["aligned.abs_rel"])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("unit", [1e-40, 1e-300, 1e30, 1e306])
def test_values_near_the_limits_of_floats(kind: str, unit: float) -> None:
    z = true_depth(4)
    x = prediction(z, kind, 0.1).astype(float)
    plain, huge = (align_view(values, z, kind) for values in (x, unit * x))
    for place in ("aligned.error", "aligned_robust.error"):
        assert huge[place] == pytest.approx(plain[place], rel=1e-9, nan_ok=kind == "scale")
    outlier = np.where(np.arange(len(x)) == 7, 1.7e308, x)
    assert 0 < align_view(outlier, z, kind)["aligned.error"] <= 1


@pytest.mark.parametrize("kind", AFFINE)
def test_constant_truth_has_no_slope(kind: str) -> None:
    for depth_m in np.linspace(0.3, 1.8, 16):  # The means of some are rounded, which leaves a slope above 0.
        found = align_view(np.linspace(0, 1, 7) ** 2, np.full(7, depth_m), kind)
        assert found["is_flat"]
        assert found["aligned.error"] == pytest.approx(0, abs=1e-15)


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
    assert align_view(x, z, "affine-depth")["aligned.error"] >= 1 / 9


@pytest.mark.parametrize("kind", KINDS)
def test_aligned_depth_of_a_view_has_the_errors_of_its_scored_pixels(kind: str) -> None:
    rng = np.random.default_rng(4)
    z = rng.uniform(0.4, 2.0, (7, 9)).astype(np.float32)
    x = np.where(rng.random(z.shape) < 0.2, np.nan, (3 / z if kind == "affine-disparity" else 3 * z) + 0.5)
    x = (1e30 * x * (1 + 0.05 * rng.standard_normal(z.shape))).astype(np.float32)
    scored = np.flatnonzero(rng.random(z.size) < 0.6)
    score = align_view(x.ravel()[scored], z.ravel()[scored], kind)
    p = scoring.aligned_depth(x, z, scored, kind)
    assert list(np.isfinite(p.ravel())) == list(np.isfinite(x.ravel())), "also of pixels that are not scored"
    error = np.abs(p - z).ravel()[scored] / z.ravel()[scored]
    assert np.nanmean(error) == pytest.approx(score["aligned.abs_rel"])
    assert np.isnan(scoring.aligned_depth(x * np.nan, z, scored, kind)).all()
