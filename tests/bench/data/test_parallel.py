"""Tests of ``ordered_map``: order of results, bounded look-ahead and exceptions."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from rebar_depth_bench.errors import InputError
from rebar_depth_bench.parallel import ordered_map


@pytest.mark.parametrize("workers", [None, 1, 3])
def test_results_are_in_input_order(workers: int | None) -> None:
    assert list(ordered_map(lambda n: n * n, range(50), workers)) == [n * n for n in range(50)]
    assert list(ordered_map(lambda n: n, [], workers)) == []


def test_look_ahead_is_two_items_per_thread() -> None:
    taken = 0

    def items() -> Iterator[int]:
        nonlocal taken
        while taken < 100:
            taken += 1
            yield taken

    for done, _ in enumerate(ordered_map(lambda n: n, items(), 2)):
        assert taken <= done + 4
    assert taken == 100


def test_exceptions_of_function_and_iterator_propagate() -> None:
    with pytest.raises(ZeroDivisionError):
        list(ordered_map(lambda n: 1 // n, [1, 0, 2], 2))

    def items() -> Iterator[int]:
        yield 1
        raise KeyError("from items")

    with pytest.raises(KeyError, match="from items"):
        list(ordered_map(lambda n: n, items(), 2))


def test_zero_workers_raises_input_error() -> None:
    with pytest.raises(InputError, match="workers is 0, expected 1 or more"):
        list(ordered_map(lambda n: n, [1], 0))
