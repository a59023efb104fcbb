"""Damaged inputs of every entry point: accepted or refused with a message, within limits and without side effects.

``python -m tests.fuzz`` runs more of these cases, and one of them again.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.fuzz.entry_points import ENTRY_POINTS, number_of_cases
from tests.fuzz.worker import Worker

SEED = 0
NUMBERS = number_of_cases(200, list(ENTRY_POINTS))


@pytest.fixture(scope="module")
def worker() -> Iterator[Worker]:
    """Start the process that runs the cases."""
    with Worker() as process:
        yield process


@pytest.mark.slow
@pytest.mark.parametrize("entry", ENTRY_POINTS)
def test_damaged_input_is_accepted_or_refused(entry: str, worker: Worker) -> None:
    outcomes = [worker.run(entry, SEED, case) for case in range(NUMBERS[entry])]
    failed = [outcome for outcome in outcomes if outcome.failures]
    assert not failed, "\n".join(f"{outcome.command}: {outcome.damage}: {outcome.failures}" for outcome in failed)
