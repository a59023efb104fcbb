"""What an audit found: one line a check, with the figure it rests on."""

from __future__ import annotations

from dataclasses import dataclass

from rich.console import Console
from rich.table import Table

from rebar_depth_bench.errors import problem_summary


@dataclass(frozen=True)
class Check:
    """One check: what was compared, the figure found, the bound it was held against, and what broke it."""

    name: str
    found: str
    bound: str
    problems: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        """Whether nothing broke the check."""
        return not self.problems


@dataclass(frozen=True)
class AuditReport:
    """All checks of one folder."""

    root: str
    checks: tuple[Check, ...]

    @property
    def failures(self) -> tuple[Check, ...]:
        """The checks that did not pass."""
        return tuple(check for check in self.checks if not check.passed)


def print_audit(report: AuditReport, console: Console | None = None) -> None:
    """Print a row per check, then the problems of those that failed."""
    console = console or Console()
    table = Table(title=f"Audit of {report.root}")
    for heading in ("check", "found", "bound", ""):
        table.add_column(heading, overflow="fold")
    for check in report.checks:
        table.add_row(check.name, check.found, check.bound, "ok" if check.passed else "FAILED")
    console.print(table)
    for check in report.failures:
        console.print(f"{check.name}: {problem_summary(check.problems)}", markup=False, highlight=False)
