"""Helpers of the benchmarks: median timing, machine description, Markdown tables."""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path


def median_seconds(work: Callable[[], object], repeats: int) -> float:
    """Return the median wall-clock seconds of ``repeats`` calls, after one warm-up call."""
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def machine_description() -> str:
    """Return one line with the processor model, the number of cores and the current load average."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    load = os.getloadavg()[0]
    return f"{models[0] if models else platform.processor()}, {os.cpu_count()} cores, load {load:.1f} at the start"


def print_markdown(
    headings: Sequence[str], rows: Sequence[Sequence[object]], write_line: Callable[[str], object] = print
) -> None:
    """Write a Markdown table line by line with ``write_line``."""
    write_line(f"| {' | '.join(headings)} |")
    write_line(f"|{'---|' * len(headings)}")
    for row in rows:
        write_line(f"| {' | '.join(str(cell) for cell in row)} |")
