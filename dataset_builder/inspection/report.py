"""Report of an inspection: tables in the terminal, and JSON."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from dataset_builder.inspection.summary import CONTACT, CONTACT_M, MAX_PAIRS, BarGroup, Inspection, form_distance_m
from dataset_builder.scene.assemblies.cage import CageBar
from rebar_depth_bench.reporting.tables import plain_text, print_unwrapped
from rebar_depth_bench.scoring.formatting import counted

_MAX_GROUPS = 40
_MAX_CLASHES = 10
_MAX_REASONS = 20
_AXIS_WORDS: Mapping[str | None, str] = {
    "exact": "from the file",
    "fitted": "fitted to a surface",
    None: "unknown (no tube fits the surface)",
}


def inspection_json(inspection: Inspection) -> str:
    """Return an inspection as JSON, as the contract defines it.

    Further keys are ``box_m`` (lower and upper corner of the steel, world), ``contacts`` and ``clashes`` (null if
    too many bars are close to each other), ``notes``, and ``problems``, the reasons
    for which a build refuses the cage.
    """
    cage = inspection.cage
    pairs = {"contacts": inspection.contacts, "clashes": inspection.clashes}
    values = {
        "bars": [_bar_values(bar) for bar in cage.bars],
        "left_out": [vars(record) for record in cage.left_out],
        "world_from_source": cage.world_from_source.tolist(),
        "box_m": inspection.box_m.tolist(),
        **{kind: None if found is None else [vars(pair) for pair in found] for kind, found in pairs.items()},
        "notes": [f"{note.source}: {note.text}" for note in cage.notes],
        "problems": [str(problem) for problem in cage.problems],
    }
    return json.dumps(values, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def _bar_values(bar: CageBar) -> dict[str, Any]:
    known = bar.bar.has_axis
    return {
        "bar_id": bar.bar.bar_id,
        "role": bar.bar.role,
        "diameter_m": bar.bar.diameter_m if known else None,
        "length_m": bar.bar.length_m if known else None,
        "axis": bar.axis_kind,
        "axis_m": [list(point_m) for point_m in bar.bar.axis_m] if known else None,
        "source": bar.source,
        "host": bar.host,
        "storey": bar.storey,
    }


def print_inspection(inspection: Inspection) -> None:
    """Print the groups of bars, then what else there is to know about the cage."""
    console = Console()
    print_unwrapped(console, _group_table(inspection.groups))
    more = inspection.groups[_MAX_GROUPS:]
    if more:
        bars = sum(group.bars for group in more)
        _print(
            console, f"and {counted(len(more), 'more group')} of {counted(bars, 'bar')} (--json lists all bars)"
        )
    console.print()
    kinds = (_axis_lines, _place_lines, _form_lines, _meeting_lines, _left_out_lines)
    for line in (line for lines in kinds for line in lines(inspection)):
        _print(console, line)


def _print(console: Console, line: str) -> None:
    console.print(plain_text(line), soft_wrap=True)


def _group_table(groups: Sequence[BarGroup]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0), show_edge=False)
    numbers = "bars\n", "length\nm", "mass\nkg", "spacing\nmm", "(range)\n", "above ground\nmm"
    for head in ("diameter\nmm", "role\n", "host\n", "storey\n", *numbers):
        is_text = head.strip() in ("role", "host", "storey")
        table.add_column(head, justify="left" if is_text else "right", no_wrap=True)
    for group in groups[:_MAX_GROUPS]:
        diameter = "unknown" if group.diameter_mm is None else f"{group.diameter_mm:g}"
        _add_row(table, [diameter, group.role, group.host or "", group.storey or ""], [group])
    if len(groups) > 1:
        table.add_section()
        _add_row(table, ["all", "", "", ""], groups)
    return table


def _add_row(table: Table, names: Sequence[str], groups: Sequence[BarGroup]) -> None:
    """Add a row of names, the sums of groups, and the spacing of a single one."""
    lengths_m = [group.length_m for group in groups if group.length_m is not None]
    masses_kg = [group.mass_kg for group in groups if group.mass_kg is not None]
    sums = f"{sum(lengths_m):.2f}" if lengths_m else "", f"{sum(masses_kg):.1f}" if masses_kg else ""
    spacing, spread = "", ""
    if len(groups) == 1 and groups[0].spacing_m is not None:
        median_mm, low_mm, high_mm = (f"{1000 * one_m:.1f}" for one_m in groups[0].spacing_m)
        spacing, spread = median_mm, "" if low_mm == high_mm else f"({low_mm} - {high_mm})"
    above_ground_mm = f"{1000 * min(group.above_ground_m for group in groups):.1f}"
    numbers = str(sum(group.bars for group in groups)), *sums, spacing, spread, above_ground_mm
    table.add_row(*map(plain_text, (*names, *numbers)))


def _axis_lines(inspection: Inspection) -> list[str]:
    kinds = Counter[str | None](bar.axis_kind for bar in inspection.cage.bars)
    found = [f"{kinds[kind]} {words}" for kind, words in _AXIS_WORDS.items() if kinds[kind]]
    return [f"axes: {', '.join(found)}"]


def _place_lines(inspection: Inspection) -> list[str]:
    """Return the box of the steel and the transform from the file's frame."""
    corners = zip("xyz", *inspection.box_m, strict=True)
    ranges = ", ".join(f"{axis} {low:.3f} to {high:.3f}" for axis, low, high in corners)
    matrix = inspection.cage.world_from_source
    rows = [f"  [{', '.join(f'{value:.12g}' for value in row)}]" for row in matrix[:3]]
    is_placed = not np.array_equal(matrix, np.eye(4))
    words = "world_from_source (coordinates of the file to metres of the world):"
    return [
        f"steel: {inspection.size_text} ({ranges})",
        *([words, *rows] if is_placed else ["coordinates: those of the file"]),
    ]


def _form_lines(inspection: Inspection) -> Iterator[str]:
    """Yield the least distance of the steel from each form, or a warning that a bar goes through it."""
    for form in inspection.cage.forms:
        distance_m = form_distance_m(form, [bar.bar for bar in inspection.cage.bars])
        found = "warning: a bar goes through it" if distance_m < 0 else f"steel {distance_m * 1000:.1f} mm from it"
        yield f"form {form.name}: " + ("no bar of known axis over it" if distance_m == np.inf else found)


def _meeting_lines(inspection: Inspection) -> list[str]:
    """Return the number of bars in contact, and the deepest clashes."""
    if inspection.contacts is None or inspection.clashes is None:
        return [f"clashes: not compared, more than {MAX_PAIRS} places where bars are close to each other"]
    limit = f"{CONTACT * 100:g} % of their mean diameter and {CONTACT_M * 1000:g} mm"
    worst = inspection.clashes[:_MAX_CLASHES]
    return [
        f"in contact: {counted(len(inspection.contacts), 'pair')} of bars (gap or overlap of at most {limit})",
        f"clashes: {counted(len(inspection.clashes), 'pair')} of bars (deeper overlap)",
        *(f"  bars {item.bar_a} and {item.bar_b}: {item.depth_m * 1000:.1f} mm" for item in worst),
        *_more(len(inspection.clashes) - len(worst)),
    ]


def _left_out_lines(inspection: Inspection) -> list[str]:
    left_out = inspection.cage.left_out
    if not left_out:
        return []
    reasons = Counter(record.reason for record in left_out).most_common()
    lines = [f"left out: {counted(len(left_out), 'object')}"]
    lines += [f"  {count} x {reason}" for reason, count in reasons[:_MAX_REASONS]]
    return lines + _more(len(reasons) - _MAX_REASONS)


def _more(count: int) -> list[str]:
    return [f"  and {count} more (--json lists all)"] if count > 0 else []
