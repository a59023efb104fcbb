"""Many fuzz cases: ``python -m tests.fuzz [ENTRY ...] --cases N --seed S --log FILE``.

It prints a table of counts. ``python -m tests.fuzz ENTRY --seed S --case N`` runs one case again.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from itertools import islice
from pathlib import Path

from tests.fuzz.cases import ENTRY_POINTS, Outcome, number_of_cases
from tests.fuzz.worker import Worker


def main() -> int:
    """Run the cases; return 1 if a case failed, else 0."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description="Damage inputs and read them.")
    parser.add_argument("entries", nargs="*", metavar="ENTRY", help=f"default: all of {', '.join(ENTRY_POINTS)}")
    parser.add_argument("--cases", type=int, default=300, help="number of cases in all (default: %(default)s)")
    parser.add_argument("--case", type=int, help="run only the case of this number")
    parser.add_argument("--seed", type=int, default=0, help="seed of the damage (default: %(default)s)")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="default: %(default)s")
    parser.add_argument("--log", type=Path, metavar="FILE", help="write counts and failures as JSON lines")
    options = parser.parse_args()
    unknown = sorted(set(options.entries) - set(ENTRY_POINTS))
    if unknown:
        parser.error(f"no entry point {', '.join(unknown)}, expected some of {', '.join(ENTRY_POINTS)}")
    entries = options.entries or list(ENTRY_POINTS)
    if options.case is not None:
        with Worker() as worker:
            outcomes = [worker.run(entry, options.seed, options.case) for entry in entries]
        print(*outcomes, sep="\n")
    else:
        numbers = number_of_cases(options.cases, entries)
        outcomes = run_cases(numbers, options.seed, options.workers, _report)
        print(table(outcomes))
    if options.log:
        write_log(outcomes, options.log)
    return int(any(outcome.failures for outcome in outcomes))


def _report(outcome: Outcome) -> None:
    for failure in outcome.failures:
        print(f"{outcome.command}\n  {outcome.damage}: {failure}", file=sys.stderr, flush=True)


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


if __name__ == "__main__":
    sys.exit(main())
