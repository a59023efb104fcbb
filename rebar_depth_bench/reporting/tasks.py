"""Sheet of the working ranges of methods: sentences, charts and tables, as page, terminal text, JSON and CSV.

The page is self-contained HTML, without scripts or requests, and the same bytes for the same input. All text
passes through Jinja's escaping, and names of a submission or a dataset through ``errors.printable`` before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup
from rich.console import Console

from rebar_depth_bench import software_version
from rebar_depth_bench.base.errors import printable
from rebar_depth_bench.extended.measures import EXTENDED_PROTOCOL, NATIVE
from rebar_depth_bench.extended.tasks import LASER, TASKS, ConfigTasks
from rebar_depth_bench.extended.working_range import (
    EDGES_M,
    MAX_PLANE_SHARE,
    MET_LOW,
    MET_SHARE,
    MIN_EXACT_SHARE,
    MIN_SAMPLES,
    MIN_VIEWS,
    RangeBin,
    WorkingRange,
)
from rebar_depth_bench.reporting.charts import range_chart, series_classes
from rebar_depth_bench.reporting.extended_tables import FITS_NOTE
from rebar_depth_bench.reporting.html.assets import environment
from rebar_depth_bench.reporting.tables import make_grid, plain_text, print_line, print_unwrapped
from rebar_depth_bench.scoring import formatting
from rebar_depth_bench.scoring.columns import percent
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.spreadsheet import Sheet

ALIGNMENT_TITLES = {NATIVE: "native", LASER: "one laser reading"}

RULE_NOTE = (
    f"Bins by true distance. Met: {100 * MET_SHARE:g} % or more are within the limit, and the lower end of the "
    f"95 % interval (Wilson, Student's quantile, views as clusters) is {100 * MET_LOW:g} % or more; likely: only "
    "the share. What is "
    f"not found fails. A bin is tested with {MIN_SAMPLES} samples of {MIN_VIEWS} views if exact depth passes "
    f"{100 * MIN_EXACT_SHARE:g} % or more there, and the plane {100 * MAX_PLANE_SHARE:g} % or less: in each view "
    "one constant, the median true distance of what is judged, less the radius; with the laser, its reading."
)
LASER_NOTE = (
    "One laser reading: each picture is multiplied by one factor, the true depth of the centre pixel, with noise "
    "of 1 mm, over the predicted one."
)
NOTES = (RULE_NOTE, LASER_NOTE, FITS_NOTE, formatting.RANK_PURPOSE_NOTE)


@dataclass(frozen=True)
class ConfigSheet:
    """Sheet of one config: the working ranges of each method by its name, all of the same views.

    ``marks`` are the ``rank_mark`` of each method.
    """

    name: str
    views: int
    methods: dict[str, ConfigTasks]
    marks: dict[str, str]

    @property
    def sentences(self) -> list[tuple[str, str, list[tuple[str, bool]]]]:
        """Method, alignment and ``task_phrases`` of each sentence."""
        return [
            (f"{printable(method)} {self.marks[method]}".rstrip(), title, task_phrases(tasks, alignment))
            for method, tasks in self.methods.items()
            for alignment, title in ALIGNMENT_TITLES.items()
        ]

    @property
    def notes(self) -> list[str]:
        """Sentences on the views that have no laser reading, or no prediction where it is, and on the marks."""
        notes: list[str] = []
        for method, tasks in self.methods.items():
            unjudged, judged = tasks.views - tasks.laser_views, formatting.counted(tasks.laser_views, "view")
            if unjudged and not notes:
                shown = f"{unjudged} of {formatting.counted(tasks.views, 'view')} show nothing at the centre pixel"
                notes.append(f"{shown}, and are not judged with the laser.")
            if tasks.unread_views:
                unread = f"{printable(method)}: {tasks.unread_views} of {judged} have no prediction"
                notes.append(f"{unread} at the centre pixel, and fail with the laser.")
        marks = formatting.RANK_MARKS.items()
        return notes + [formatting.note_text(*mark, ()) for mark in marks if mark[0] in self.marks.values()]

    def chart(self, task: str) -> Markup | None:
        """Return the chart of a task, None if nothing is judged."""
        panels = {
            title: {method: tasks.ranges[task][alignment] for method, tasks in self.methods.items()}
            for alignment, title in ALIGNMENT_TITLES.items()
        }
        return range_chart(f"{TASKS[task]}, {self.name}", panels)

    def bins(self, task: str, alignment: str) -> list[tuple[RangeBin, ...]]:
        """Return the bins of one task and alignment, each of all methods, which have samples in the same bins."""
        return list(zip(*(tasks.ranges[task][alignment].bins for tasks in self.methods.values()), strict=True))


def config_sheets(results: Sequence[Result]) -> list[ConfigSheet]:
    """Return the sheets of all configs of extended results whose names differ; a config without bars has none."""
    sheets: dict[str, ConfigSheet] = {}
    for result in results:
        assert result.extended is not None
        for config, tasks in result.extended.tasks.items():
            title = formatting.config_title(config, result.tables[config].split)
            sheet = sheets.setdefault(config, ConfigSheet(title, tasks.views, {}, {}))
            sheet.methods[result.method] = tasks
            sheet.marks[result.method] = formatting.rank_mark(result.declared)
    return list(sheets.values())


def task_phrases(tasks: ConfigTasks, alignment: str) -> list[tuple[str, bool]]:
    """Return phrases on where tasks are met, or why not tested, and whether anywhere; alike tasks share one."""
    titles: dict[tuple[str, bool], list[str]] = {}
    for task, title in TASKS.items():
        found = tasks.ranges[task][alignment]
        is_met = any(run.state == "met" for run in found.runs)
        titles.setdefault((range_text(found), is_met), []).append(title)
    return [(f"{', '.join(alike)}: {text}", is_met) for (text, is_met), alike in titles.items()]


def range_text(found: WorkingRange) -> str:
    """Return the runs of a working range as text, or why no bin is tested; and how many samples are in no bin."""
    unbinned = ""
    if found.unbinned:
        everything = "" if found.bins else ", all of them"
        counted = f"{formatting.counted(found.unbinned, 'sample')}{everything}"
        unbinned = f"{counted} nearer than {EDGES_M[0]:g} m or from {EDGES_M[-1]:g} m on"
    if not found.runs:
        reasons = dict.fromkeys(reason for one in found.bins for reason in one.reasons.values())
        return f"not tested ({', '.join(filter(None, [*reasons, unbinned])) or 'nothing judged'})"
    stretches = {
        state: " and ".join(f"{run.from_m:g}-{run.to_m:g} m" for run in found.runs if run.state == state)
        for state in ("met", "likely", "not met")
    }
    text = ", ".join(f"{state} in {where}" for state, where in stretches.items() if where)
    if not stretches["met"] and not stretches["likely"]:
        text = f"nowhere met in {stretches['not met']}"
    return f"{text} (not judged: {unbinned})" if unbinned else text


def tasks_dict(results: Sequence[Result]) -> dict[str, Any]:
    """Return the JSON object of the working ranges of all methods, with their provenance."""
    methods: dict[str, Any] = {}
    laser: dict[str, Any] = {}
    split: dict[str, str | None] = {}
    for result in results:
        assert result.extended is not None
        configs = result.extended.tasks
        methods[result.method] = {config: tasks.to_dict() for config, tasks in configs.items()}
        laser[result.method] = {
            config: {
                "views": tasks.laser_views,
                "of_views": tasks.views,
                "views_without_prediction": tasks.unread_views,
            }
            for config, tasks in configs.items()
        }
        split |= {config: result.tables[config].split for config in configs}
    return {
        "protocol": EXTENDED_PROTOCOL,
        "dataset": {"digest": results[0].dataset.digest, "version": results[0].dataset.version},
        "submissions": [
            {
                "method": one.method,
                "sha256": one.submission.sha256,
                "uses_ground_truth": one.declared.uses_ground_truth,
            }
            for one in results
        ],
        "software": {"version": software_version()},
        "split": split,
        "methods": methods,
        "laser": laser,
    }


def tasks_sheet(results: Sequence[Result]) -> Sheet:
    """Return one row per method, config, task, alignment and bin, with provenance."""
    numbers = (
        *("from_m", "to_m", "samples", "views", "share", "low", "high", "bias_mm", "spread_mm", "exact", "plane"),
        "state",
    )
    rows = []
    for result in results:
        assert result.extended is not None
        for config, tasks in result.extended.tasks.items():
            for task, by_alignment in tasks.ranges.items():
                for alignment, found in by_alignment.items():
                    rows += [
                        (
                            *(EXTENDED_PROTOCOL, result.method, config, result.tables[config].split),
                            *(task, alignment),
                            *(getattr(one, name) for name in numbers),
                            "; ".join(one.reasons.values()),
                            *(result.dataset.digest, result.submission.sha256),
                            *(result.declared.uses_ground_truth, software_version()),
                        )
                        for one in found.bins
                    ]
    heads = ("protocol", "method", "config", "split", "task", "alignment", *numbers, "not_tested_why")
    provenance = ("dataset_digest", "submission_sha256", "uses_ground_truth", "software_version")
    return Sheet((*heads, *provenance), rows)


def print_tasks(results: Sequence[Result], console: Console) -> None:
    """Print the sentences of each config, and a table per alignment with a row per task and bin."""
    version, digest = printable(results[0].dataset.version), formatting.short_digest(results[0].dataset.digest)
    line = f"{EXTENDED_PROTOCOL}, dataset {version} ({digest}), software {software_version()}"
    print_line(console, line, style="dim")
    for sheet in config_sheets(results):
        console.print()
        print_line(console, f"{sheet.name}, {formatting.counted(sheet.views, 'view')}", style="bold")
        for method, title, phrases in sheet.sentences:
            print_line(console, f"{method}, {title}: {'; '.join(phrase for phrase, _ in phrases)}.")
        for note in sheet.notes:
            print_line(console, note, style="yellow")
        for alignment, title in ALIGNMENT_TITLES.items():
            judged = {task: sheet.bins(task, alignment) for task in TASKS if sheet.bins(task, alignment)}
            if not judged:
                continue
            console.print()
            print_line(console, f"Share within the limit, per cent: {title}", style="italic")
            heads = ("samples", "views", "exact", "plane", *map(printable, sheet.methods))
            grid = make_grid("task, m", [plain_text(head) for head in heads])
            for task, of_task in judged.items():
                grid.add_section()
                grid.add_row(plain_text(TASKS[task], style="italic"))
                for bins in of_task:
                    first = bins[0]
                    counts = (str(first.samples), str(first.views), percent(first.exact), percent(first.plane))
                    cells = (*counts, *(f"{percent(one.share)} {_MARKS[one.state]}" for one in bins))
                    grid.add_row(f"  {first.from_m:g}-{first.to_m:g}", *cells)
            print_unwrapped(console, grid)
    console.print()
    print_line(console, "+: met, ~: likely, -: not met, ( ): not tested.")
    for note in NOTES:
        print_line(console, note)


_MARKS = {"met": "+", "likely": "~", "not met": "-", "not tested": "( )"}


def tasks_context(results: Sequence[Result]) -> dict[str, object]:
    """Return the context of ``part_tasks.html.j2``."""
    return {
        "tasks": config_sheets(results),
        "task_titles": TASKS,
        "task_alignments": ALIGNMENT_TITLES,
        "task_notes": NOTES,
        "series_classes": series_classes,
    }


def render_tasks(results: Sequence[Result]) -> str:
    """Return the page of the working ranges; it follows the reader's light or dark mode and needs no network."""
    dataset = results[0].dataset
    archives = [
        f"{formatting.archive_text(one.submission.sha256)}; "
        f"ground truth: {formatting.ground_truth_text(one.declared)}"
        for one in results
    ]
    stamps = [
        ("Protocol", EXTENDED_PROTOCOL),
        ("Dataset", f"{printable(dataset.version)} ({printable(formatting.short_digest(dataset.digest))})"),
        *((printable(one.method), text) for one, text in zip(results, archives, strict=True)),
        ("Software", f"rebar-depth-bench {software_version()}"),
    ]
    template = environment().get_template("tasks.html.j2")
    return template.render(stamps=stamps, **tasks_context(results))
