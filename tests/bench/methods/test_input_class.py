"""Input classes that the archives of the bundled methods declare."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rebar_depth_bench.methods import METHODS, MultiViewMethod, own_methods
from rebar_depth_bench.methods.base import input_class
from rebar_depth_bench.submission import INPUTS


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        *(("sgbm", "stereo"), ("foundation-stereo", "stereo"), ("constant", "rgb"), ("unidepth", "rgb")),
        *(("metric3d", "rgb+K"), ("sweep-aruco", "multi-view"), ("lidar-mobile", "lidar"), ("truth", None)),
    ],
)
def test_class_of_a_bundled_method(name: str, expected: str | None) -> None:
    assert input_class(own_methods()[name]) == expected


def test_every_method_that_reads_images_has_a_class() -> None:
    for method in own_methods().values():
        reads_images = isinstance(method, MultiViewMethod) or "left_rgb" in method.info.columns
        assert (input_class(method) in INPUTS) or not reads_images


def test_declared_class_replaces_the_derived_one() -> None:
    sgbm = METHODS["sgbm"]
    assert input_class(replace(sgbm, info=replace(sgbm.info, inputs="lidar"))) == "lidar"
