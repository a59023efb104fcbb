"""Tests of ``map_with_progress``: order of results, bounded look-ahead and exceptions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import pytest

from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.base.parallel import map_with_progress, silent


def mapped(work: Callable[[int], int], items: Iterable[int], workers: int | None) -> list[int]:
    return map_with_progress(work, items, workers, silent, "", 0)


@pytest.mark.parametrize("workers", [None, 1, 3])
def test_results_are_in_input_order(workers: int | None) -> None:
    assert mapped(lambda n: n * n, range(50), workers) == [n * n for n in range(50)]
    assert mapped(lambda n: n, [], workers) == []


def test_look_ahead_is_two_items_per_thread() -> None:
    taken = 0

    def items() -> Iterator[int]:
        nonlocal taken
        while taken < 100:
            taken += 1
            yield taken

    steps: list[tuple[str, int, int]] = []

    def progress(task: str, done: int, total: int) -> None:
        assert taken <= done + 3
        steps.append((task, done, total))

    map_with_progress(lambda n: n, items(), 2, progress, "t", 100)
    assert steps == [("t", done, 100) for done in range(1, 101)]


def test_exceptions_of_function_and_iterator_propagate() -> None:
    with pytest.raises(ZeroDivisionError):
        mapped(lambda n: 1 // n, [1, 0, 2], 2)

    def items() -> Iterator[int]:
        yield 1
        raise KeyError("from items")

    with pytest.raises(KeyError, match="from items"):
        mapped(lambda n: n, items(), 2)


def test_zero_workers_raises_input_error() -> None:
    with pytest.raises(InputError, match="workers is 0, expected 1 or more"):
        mapped(lambda n: n, [1], 0)
