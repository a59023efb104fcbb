"""Seconds and memory that ``rebar-build inspect`` needs for IFC models with many bars.

python -m benchmarks.inspect [BARS]

The models are written as programs export them: one object per bar, swept along a composite curve of trimmed lines
and circles (Revit), and objects of 40 mapped items each (Tekla). The bars are stirrups with four bends, 0.2 m
apart in columns of 100. CPU seconds are those of the command and its reading process together, peak memory is that
of the larger of both.
"""

from __future__ import annotations

import math
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.timing import machine_description, print_markdown
from tests.builder.user_files.ifc_step_text import MILLIMETRES, Step

_LEVELS = 100
"""Stirrups of a column."""
_ITEMS = 40
"""Mapped items of an object."""
_COLUMNS_PER_ROW = 15
_REFUSED_BY_BUILD = 2
"""Exit status of ``inspect`` for models that a build refuses, here because of their number of triangles."""


def main(bars: str = "20000") -> None:
    """Print a row for each style of writing."""
    print(f"{machine_description()}\n")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name, text in (("one object per bar", _objects(int(bars))), ("mapped items", _mapped(int(bars)))):
            path = Path(folder) / f"{name.replace(' ', '-')}.ifc"
            path.write_text(text)
            rows.append((name, bars, f"{path.stat().st_size / 1e6:.0f}", *_measured(path)))
    print_markdown(["style", "bars", "MB", "seconds", "CPU seconds", "peak memory, GB"], rows)


def _measured(scene: Path) -> tuple[str, str, str]:
    """Return wall-clock seconds, CPU seconds and peak memory (GB) of ``inspect`` with JSON and picture."""
    outputs = ["--json", str(scene.with_suffix(".json")), "--picture", str(scene.with_suffix(".png"))]
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    command = [sys.executable, "-m", "dataset_builder", "inspect", str(scene), *outputs]
    ended = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=False)
    if ended.returncode not in (0, _REFUSED_BY_BUILD):
        raise SystemExit(ended.stderr)
    seconds, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return f"{seconds:.1f}", f"{cpu_s:.1f}", f"{after.ru_maxrss / 1e6:.2f}"


def _position(bar: int) -> tuple[float, float, float]:
    """Return the place of a stirrup, millimetres."""
    column, level = divmod(bar, _LEVELS)
    row, place = divmod(column, _COLUMNS_PER_ROW)
    return 600.0 * place, 600.0 * row, 200.0 * level


def _stirrup(step: Step) -> str:
    """Return the curve of a stirrup with four bends and two tails: lines and circles, trimmed by parameters."""
    r, side, tail = 30.0, 300.0, 100.0
    pieces = [step.line((0, r + tail, 0), (0, -1, 0), tail)]
    corners = [((r, r), 180, (r, 0), (1, 0)), ((r + side, r), 270, (2 * r + side, r), (0, 1))]
    corners += [((r + side, r + side), 0, (r + side, 2 * r + side), (-1, 0))]
    corners += [((r, r + side), 90, (0, r + side), (0, -1))]
    for (x, y), first_deg, start, along in corners:
        first = math.radians(first_deg)
        pieces.append(step.arc((x, y, 0), r, first, first + math.pi / 2))
        pieces.append(step.line((*start, 0), (*along, 0), tail if first_deg == 90 else side))
    return step.composite(*pieces)


_LENGTH_M = (3 * 300 + 2 * 100 + 4 * 30 * math.pi / 2) / 1000


def _objects(bars: int) -> str:
    step = Step(MILLIMETRES, "IFC2X3")
    for bar in range(bars):
        disc = step.disc(_stirrup(step), 5.0, "0.", 3 * 300 + 2 * 100 + 4 * 90.0)
        step.bar([disc], 0.010, _LENGTH_M, at=_position(bar))
    return step.text()


def _mapped(bars: int) -> str:
    step = Step(MILLIMETRES, "IFC2X3")
    for first in range(0, bars, _ITEMS):
        disc = step.disc(_stirrup(step), 5.0, "0.", 3 * 300 + 2 * 100 + 4 * 90.0)
        places = [_position(bar) for bar in range(first, min(first + _ITEMS, bars))]
        step.bar(step.mapped([disc], places), 0.010, _LENGTH_M)
    return step.text()


if __name__ == "__main__":
    main(*sys.argv[1:])
