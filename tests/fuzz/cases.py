"""Registry of entry points, and one fuzz case: sound inputs, damaged by a seeded generator, read and observed."""

from __future__ import annotations

import os
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rebar_depth_bench.cli.console import EXIT_DONE
from tests.fuzz.damage import SPECIAL_FILES, damage_content, replace_by_special_file
from tests.fuzz.dataset_entries import DATASET_ENTRIES
from tests.fuzz.file_entries import FILE_ENTRIES
from tests.fuzz.import_entries import IMPORT_ENTRIES
from tests.fuzz.model_entries import MODEL_ENTRIES
from tests.fuzz.oracle import Expectation, Observation, failures, observe
from tests.fuzz.workspace import CASE, ELSEWHERE, EntryPoint, Workspace

ENTRY_POINTS: Mapping[str, EntryPoint] = {
    entry.name: entry for entry in (*DATASET_ENTRIES, *FILE_ENTRIES, *IMPORT_ENTRIES, *MODEL_ENTRIES)
}
"""Entry points by name."""
_SPECIAL_SHARE, _TRUNCATED_SHARE, _SECOND_DAMAGE_SHARE = 0.15, 0.08, 0.15
_LEAST_TRUNCATION_BYTES = 20
"""A text format cannot show that its last number has lost a digit."""


def number_of_cases(total: int, entries: Sequence[str]) -> dict[str, int]:
    """Return how many of ``total`` cases each of the named entry points gets by its share, at least one."""
    shares = sum(ENTRY_POINTS[name].share for name in entries)
    return {name: max(1, round(total * ENTRY_POINTS[name].share / shares)) for name in entries}


def work_folder(base: Path) -> Path:
    """Return the work folder: it lies deep, so that names with ``..`` in unsound code end below ``base``."""
    return base / "1/2/3/4/work"


@dataclass(frozen=True)
class Outcome:
    """Result of a case: the damage, exit status, codes of the problems, violated properties and costs."""

    entry: str
    seed: int
    case: int
    damage: str
    status: int
    codes: tuple[str, ...]
    failures: tuple[str, ...]
    cpu_s: float
    peak_mib: int
    stderr: str

    @property
    def command(self) -> str:
        """Command that runs the case again."""
        return f"python -m tests.fuzz '{self.entry}' --seed {self.seed} --case {self.case}"

    @property
    def kind(self) -> str:
        """Word for the table: ``accepted``, ``refused`` or ``failed``."""
        return "failed" if self.failures else "accepted" if self.status == EXIT_DONE else "refused"


@dataclass(frozen=True)
class _Sound:
    """Sound inputs of an entry point, saved in a folder, and what they give."""

    folder: Path
    result: bytes | None


class CaseRunner:
    """Runner of cases below ``base``, which prepares the inputs of each entry point once."""

    def __init__(self, base: Path) -> None:
        self._base = base
        self._workspace = Workspace(work_folder(base))
        self._sound: dict[str, _Sound] = {}

    def run(self, entry: EntryPoint, seed: int, case: int) -> Outcome:
        """Run case number ``case`` of a seed; equal arguments give the same damage in every process."""
        sound = self._sound.get(entry.name) or self._prepare(entry)
        self._workspace.restore(sound.folder)
        os.chdir(self._workspace.case)
        rng = np.random.default_rng([seed, zlib.crc32(entry.name.encode()), case])
        damage = _damage(entry, self._workspace, rng)
        seen = observe(lambda: entry.run(self._workspace), self._workspace)
        violated = failures(seen, _expectation(entry, damage.partition(":")[0]))
        if seen.status == EXIT_DONE and not seen.crash:
            must_match = entry.covered or (entry.shows_truncation and "truncated" in damage)
            violated += _unsound_outputs(entry, self._workspace, sound.result if must_match else None)
        return _outcome(entry.name, seed, case, damage, seen, violated)

    def _prepare(self, entry: EntryPoint) -> _Sound:
        """Write the sound inputs; raise ``AssertionError`` unless they are accepted without any failure."""
        self._workspace.make()
        os.chdir(self._workspace.case)
        entry.prepare(self._workspace)
        folder = self._base / "sound" / entry.name.replace(" ", "-")
        self._workspace.save(folder)
        seen = observe(lambda: entry.run(self._workspace), self._workspace)
        violated = failures(seen, _expectation(entry, "no damage"))
        assert not violated, f"{entry.name}: sound inputs: {'; '.join(violated)}"
        assert seen.status == EXIT_DONE, f"{entry.name}: sound inputs are refused: {seen.stderr}"
        sound = _Sound(folder, entry.result(self._workspace) if entry.result else None)
        self._sound[entry.name] = sound
        return sound


def _expectation(entry: EntryPoint, file: str) -> Expectation:
    """Return what may happen if ``file`` is damaged: messages name it or its folder."""
    names = (CASE, file, *entry.names)
    return Expectation(entry.statuses, names, entry.kept_outputs, entry.may_change, entry.cpu_s)


def _damage(entry: EntryPoint, workspace: Workspace, rng: np.random.Generator) -> str:
    """Damage one file of an entry point once or twice, and return its name and the damage."""
    files = entry.files(workspace.root)
    path = files[rng.integers(len(files))]
    if entry.special_files and rng.random() < _SPECIAL_SHARE:
        kind = str(rng.choice(list(SPECIAL_FILES)))
        replace_by_special_file(path, kind, workspace.root / ELSEWHERE)
        return f"{path.name}: {kind}"
    content, levels = path.read_bytes(), []
    for _ in range(2 if rng.random() < _SECOND_DAMAGE_SHARE else 1):
        if rng.random() < _TRUNCATED_SHARE:
            content, level = content[: rng.integers(max(1, len(content) - _LEAST_TRUNCATION_BYTES))], "truncated"
        else:
            content, level = damage_content(path.name, content, rng)
        levels.append(level)
    path.write_bytes(content)
    return f"{path.name}: {', '.join(levels)}"


def _unsound_outputs(entry: EntryPoint, workspace: Workspace, sound_result: bytes | None) -> list[str]:
    """Return the failures of an accepted case's outputs; ``sound_result`` is what its result must be, or None."""
    found = []
    if entry.result and sound_result is not None and (result := entry.result(workspace)) != sound_result:
        found.append(f"other result: {result[:200]!r}")
    try:
        if entry.check:
            entry.check(workspace)
    except Exception as error:
        found.append(f"invalid output: {type(error).__name__}: {error}"[:500])
    return found


def _outcome(entry: str, seed: int, case: int, damage: str, seen: Observation, violated: list[str]) -> Outcome:
    return Outcome(
        entry=entry,
        seed=seed,
        case=case,
        damage=damage,
        status=seen.status,
        codes=seen.codes,
        failures=tuple(violated),
        cpu_s=round(seen.cpu_s, 3),
        peak_mib=seen.peak_bytes >> 20,
        stderr=seen.stderr[-500:],
    )
