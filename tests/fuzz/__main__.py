"""Command of the fuzz tests: ``python -m tests.fuzz [ENTRY ...] --cases N --seed S --log FILE``.

``python -m tests.fuzz ENTRY --seed S --case N`` runs one case again, in this process.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from tests.fuzz.campaign import run_cases, table, write_log
from tests.fuzz.cases import Outcome
from tests.fuzz.entry_points import ENTRY_POINTS, number_of_cases
from tests.fuzz.worker import Worker


def main() -> int:
    """Run the cases; return 1 if a case failed, else 0."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description="Damage inputs and read them.")
    parser.add_argument("entries", nargs="*", metavar="ENTRY", help=f"default: all of {', '.join(ENTRY_POINTS)}")
    parser.add_argument("--cases", type=int, default=200, help="number of cases in all (default: %(default)s)")
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


if __name__ == "__main__":
    sys.exit(main())
