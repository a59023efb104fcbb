"""Audit report: one line per check, with the measured value and its bound."""

from __future__ import annotations

from dataclasses import dataclass

from rich.console import Console
from rich.table import Table

from rebar_depth_bench.errors import problem_summary


@dataclass(frozen=True)
class Check:
    """Result of one check: its name, the measured value and its bound as text, and the problems found."""

    name: str
    measured: str
    bound: str
    problems: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        """Whether the check has no problems."""
        return not self.problems


@dataclass(frozen=True)
class AuditReport:
    """Results of all checks of one dataset folder."""

    root: str
    checks: tuple[Check, ...]

    @property
    def failures(self) -> tuple[Check, ...]:
        """Checks that did not pass."""
        return tuple(check for check in self.checks if not check.passed)


def print_audit(report: AuditReport, console: Console | None = None) -> None:
    """Print one table row per check, then the problems of each failed check.

    ``console`` defaults to a new console on standard output.
    """
    console = console or Console()
    table = Table(title=f"Audit of {report.root}")
    for heading in ("check", "found", "bound", ""):
        table.add_column(heading, overflow="fold")
    for check in report.checks:
        table.add_row(check.name, check.measured, check.bound, "ok" if check.passed else "FAILED")
    console.print(table)
    for check in report.failures:
        console.print(f"{check.name}: {problem_summary(check.problems)}", markup=False, highlight=False)
