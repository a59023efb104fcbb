"""Progress of long tasks: rate, remaining time, and lines in a log file."""

from __future__ import annotations

import pytest

from rebar_depth_bench.base.terminal import MAX_SILENCE_S, ProgressBars, Rate, duration_text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0, "0 s"),
        (59.4, "59 s"),
        (59.6, "1 min 0 s"),
        (119.6, "2 min 0 s"),
        (599.4, "9 min 59 s"),
        (600, "10 min"),
        (3599, "1 h 0 min"),
        (3 * 3600 + 100, "3 h 2 min"),
        (90 * 3600, "90 h 0 min"),
    ],
)
def test_durations_have_two_units(seconds: float, text: str) -> None:
    assert duration_text(seconds) == text


def test_rate_counts_pictures_and_extrapolates() -> None:
    rate = Rate("pictures", 2)
    assert rate.text(steps=10, remaining=30, seconds=100) == "12 pictures/min, 5 min 0 s left"
    assert rate.text(steps=1, remaining=0, seconds=30) == "4 pictures/min, 0 s left"
    assert rate.text(steps=0, remaining=30, seconds=100) == ""
    assert rate.text(steps=1, remaining=30, seconds=0) == ""


class Clock:
    """Clock that a test sets."""

    def __init__(self) -> None:
        self.seconds = 1000.0

    def __call__(self) -> float:
        return self.seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr("rebar_depth_bench.base.terminal.time.monotonic", clock)
    return clock


def lines_of(clock: Clock, capsys: pytest.CaptureFixture[str], updates: list[tuple[float, int]]) -> list[str]:
    with ProgressBars(Rate("pictures", 2)) as bars:
        for seconds, done in updates:
            clock.seconds += seconds
            bars.update("pile", done, 504)
    return capsys.readouterr().err.splitlines()


def test_log_has_the_rate_since_the_build_was_resumed(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    lines = lines_of(clock, capsys, [(0, 250), (30, 251), (30, 252), (30, 253)])
    assert lines == ["pile: 250 of 504", "pile: 252 of 504, 4 pictures/min, 2 h 6 min left"]


def test_log_is_short_but_never_silent_for_long(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    fast = lines_of(clock, capsys, [(1, done) for done in range(505)])
    assert len(fast) == 11
    slow = lines_of(clock, capsys, [(100, done) for done in range(51)])
    assert len(slow) == 1 + 50 * 100 // MAX_SILENCE_S
