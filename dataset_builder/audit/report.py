"""Audit report: one line per check, with the measured value and its bound."""

from __future__ import annotations

from dataclasses import dataclass

from rich.console import Console
from rich.table import Table

from rebar_depth_bench.errors import problem_summary


@dataclass(frozen=True)
class Check:
    """Result of one check: its name, the measured value and its bound as text, and the problems found.

    A check is ``skipped`` if the config has nothing to measure; ``measured`` is then the reason.
    """

    name: str
    measured: str
    bound: str
    problems: tuple[str, ...] = ()
    skipped: bool = False

    @classmethod
    def skip(cls, name: str, reason: str) -> Check:
        """Return the result of a check that is skipped for a reason."""
        return cls(name, reason, "", skipped=True)

    @property
    def passed(self) -> bool:
        """Whether the check was made and has no problems."""
        return not self.problems and not self.skipped

    @property
    def verdict(self) -> str:
        """Verdict in one word: ``ok``, ``skipped`` or ``FAILED``."""
        return "skipped" if self.skipped else "ok" if self.passed else "FAILED"


@dataclass(frozen=True)
class AuditReport:
    """Results of all checks of one dataset folder."""

    root: str
    checks: tuple[Check, ...]

    @property
    def failures(self) -> tuple[Check, ...]:
        """Checks that did not pass; those that are skipped are no failures."""
        return tuple(check for check in self.checks if check.problems)

    @property
    def skipped(self) -> tuple[Check, ...]:
        """Checks that were skipped."""
        return tuple(check for check in self.checks if check.skipped)


def print_audit(report: AuditReport, console: Console | None = None) -> None:
    """Print one table row per check, then the problems of each failed check.

    ``console`` defaults to a new console on standard output.
    """
    console = console or Console()
    table = Table(title=f"Audit of {report.root}")
    for heading in ("check", "found", "bound", ""):
        table.add_column(heading, overflow="fold")
    for check in report.checks:
        table.add_row(check.name, check.measured, check.bound, check.verdict)
    console.print(table)
    for check in report.failures:
        console.print(f"{check.name}: {problem_summary(check.problems)}", markup=False, highlight=False)
