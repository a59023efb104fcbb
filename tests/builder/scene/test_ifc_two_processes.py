"""Reading of large IFC models in two processes, compared with one."""

from __future__ import annotations

import io
import os
import re
import signal
import sys
from collections.abc import Callable
from itertools import groupby

import pytest

from dataset_builder.scene.ifc_reader import ahead
from dataset_builder.scene.ifc_reader.__main__ import SECONDS_PER_SHAPE, _limited_time
from dataset_builder.scene.ifc_reader.ahead import MIN_OBJECTS, read_in_order
from dataset_builder.scene.ifc_reader.answer import write_answer
from tests.builder.scene.ifc_step_text import MILLIMETRES, Step

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="one process elsewhere")

BARS = 8


def answer(content: str, *, two_processes: bool) -> bytes:
    stream = io.BytesIO()
    write_answer(content.encode(), stream, two_processes=two_processes)
    return stream.getvalue()


FIRST = os.getpid()


def place_of(item: int) -> tuple[int, bool]:
    """Return the item, and whether it is read in the first process."""
    return item, os.getpid() == FIRST


def ended(item: int) -> tuple[int, bool]:
    if item == MIN_OBJECTS - 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return place_of(item)


def refused(item: int) -> tuple[int, bool]:
    if item == MIN_OBJECTS - 2:
        raise ValueError
    return place_of(item)


@pytest.mark.parametrize(
    ("read_ahead", "ahead_of"), [(place_of, MIN_OBJECTS), (refused, MIN_OBJECTS - 2), (ended, 0)]
)
def test_first_process_reads_what_the_second_does_not(
    read_ahead: Callable[[int], tuple[int, bool]], ahead_of: int
) -> None:
    objects = range(MIN_OBJECTS)
    results = list(read_in_order(place_of, objects, read_ahead))
    assert [item for item, _ in results] == list(objects)
    assert [item for item, in_first in results if not in_first] == list(range(MIN_OBJECTS // 2, ahead_of))


def test_few_objects_are_read_in_one_process() -> None:
    assert all(in_first for _, in_first in read_in_order(place_of, range(MIN_OBJECTS - 1), place_of))


def model(*, start: str = "$", block: bool = False, at: int = BARS - 2) -> str:
    """Return a model of straight bars, of which ``at`` is swept from ``start``, or is a block."""
    step = Step(MILLIMETRES, "IFC4")
    frame = step.placement((0, 0, 0))
    for bar in range(BARS):
        curve = step.polyline((0, 0, 0), (0, 0, 1000 + bar))
        solid = step.disc(curve, 5.0, start if bar == at else "$", "$")
        if block and bar == at:
            solid = step.add(f"IFCBLOCK({frame},10.,10.,900.)")
        step.bar([solid], 0.010, 1.0 + bar / 1000, at=(100 * bar, 0, 0))
    return step.text()


@pytest.mark.parametrize(
    ("content", "kinds"),
    [
        (model(), [b"bar", b"end"]),
        (model(start="-3."), [b"bar", b"failure"]),
        (model(start="-3.", at=1), [b"bar", b"failure"]),
        (model(block=True), [b"bar", b"step", b"surface", b"bar", b"end"]),
    ],
)
def test_answers_are_equal(monkeypatch: pytest.MonkeyPatch, content: str, kinds: list[bytes]) -> None:
    monkeypatch.setattr(ahead, "MIN_OBJECTS", BARS)
    found = answer(content, two_processes=True)
    assert found == answer(content, two_processes=False)
    assert [kind for kind, _ in groupby(re.findall(rb'"kind": "(\w+)"', found))] == [b"project", *kinds]


def test_time_limit_ends_with_the_use_of_the_kernel() -> None:
    with _limited_time():
        assert 0 < signal.getitimer(signal.ITIMER_REAL)[0] <= SECONDS_PER_SHAPE
    assert signal.getitimer(signal.ITIMER_REAL)[0] == 0
