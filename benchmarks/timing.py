"""What the benchmarks share: medians, the machine's description, tables."""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path


def median_seconds(work: Callable[[], object], repeats: int) -> float:
    """Return the median wall-clock time of ``repeats`` calls, after one that is not counted."""
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def machine() -> str:
    """Return one line about the processor, the cores and the load when asked."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    load = os.getloadavg()[0]
    return f"{models[0] if models else platform.processor()}, {os.cpu_count()} cores, load {load:.1f} at the start"


def print_markdown(
    headings: Sequence[str], rows: Sequence[Sequence[object]], say: Callable[[str], object] = print
) -> None:
    """Print a Markdown table."""
    say(f"| {' | '.join(headings)} |")
    say(f"|{'---|' * len(headings)}")
    for row in rows:
        say(f"| {' | '.join(str(cell) for cell in row)} |")
