"""Many fuzz cases on several workers, their table of counts and their log."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from itertools import islice
from pathlib import Path

from tests.fuzz.cases import Outcome
from tests.fuzz.worker import Worker

_BATCH = 25
"""Cases of one entry point that a worker runs in a row, because it prepares the sound inputs only once."""


def run_cases(
    numbers: Mapping[str, int], seed: int, workers: int, report: Callable[[Outcome], None] = lambda _: None
) -> list[Outcome]:
    """Run the first cases of each entry point, ``numbers`` of them by its name; in order."""
    batches = [
        (entry, range(first, min(first + _BATCH, number)))
        for entry, number in numbers.items()
        for first in range(0, number, _BATCH)
    ]

    def run(worker: Worker, share: Iterable[tuple[str, range]]) -> list[Outcome]:
        with worker:
            outcomes = []
            for entry, cases in share:
                for case in cases:
                    outcomes.append(worker.run(entry, seed, case))
                    report(outcomes[-1])
            return outcomes

    with ThreadPoolExecutor(workers) as pool:
        shares = [islice(batches, start, None, workers) for start in range(workers)]
        done = pool.map(run, [Worker() for _ in shares], shares)
    return sorted((outcome for outcomes in done for outcome in outcomes), key=lambda one: (one.entry, one.case))


def table(outcomes: Sequence[Outcome]) -> str:
    """Return the counts by entry point and outcome as text: accepted, refused by problem code, failed."""
    lines = [
        f"{'entry point':32} {'cases':>6} {'accepted':>9} {'refused':>8} {'failed':>7} {'s/case':>7}  problems"
    ]
    entries = dict.fromkeys(outcome.entry for outcome in outcomes)
    for name, part in [*((name, _of(outcomes, name)) for name in entries), ("all", list(outcomes))]:
        kinds = Counter(outcome.kind for outcome in part)
        seconds = sum(outcome.cpu_s for outcome in part) / len(part)
        counts = f"{len(part):6} {kinds['accepted']:9} {kinds['refused']:8} {kinds['failed']:7}"
        lines.append(f"{name:32} {counts} {seconds:7.3f}  {_codes(part)}")
    return "\n".join(lines)


def write_log(outcomes: Sequence[Outcome], path: Path) -> None:
    """Write one JSON line for each entry point, with its counts, and one for each failure."""
    entries = dict.fromkeys(outcome.entry for outcome in outcomes)
    counts = [
        {"entry": name, "cases": len(part), **Counter(outcome.kind for outcome in part), "codes": _codes(part)}
        for name, part in ((name, _of(outcomes, name)) for name in entries)
    ]
    failed = [asdict(outcome) for outcome in outcomes if outcome.failures]
    path.write_text("".join(json.dumps(line) + "\n" for line in (*counts, *failed)))


def _of(outcomes: Sequence[Outcome], entry: str) -> list[Outcome]:
    return [outcome for outcome in outcomes if outcome.entry == entry]


def _codes(outcomes: Sequence[Outcome]) -> str:
    """Return the first problem codes of refused cases with their counts, the most frequent first."""
    codes = Counter((*outcome.codes, "other")[0] for outcome in outcomes if outcome.kind == "refused")
    return ", ".join(f"{code} {count}" for code, count in codes.most_common())
