"""Process that runs fuzz cases: ``python -m tests.fuzz.worker BASE``.

It reads one request per line, ``[entry, seed, case]``, and answers each with one line, the outcome, both as JSON.
A crash or an endless loop ends only this process, and a case needs no interpreter of its own. ``Worker`` is the
parent's side.
"""

from __future__ import annotations

import json
import os
import resource
import select
import signal
import subprocess
import sys
import tempfile
import traceback
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Self

from tests.fuzz.cases import CaseRunner, Outcome, work_folder
from tests.fuzz.workspace import Workspace

HANG_S = 60.0
"""Default of the time, seconds, after which a case that has not ended is stopped; busy machines need less."""
MEMORY_BYTES = 6 << 30
"""Memory of the process; allocations beyond it fail."""
_PROJECT = Path(__file__).parents[2]
_ENVIRONMENT = {
    "PYTHONPATH": str(_PROJECT),
    "COLUMNS": "200",
    "HF_HUB_OFFLINE": "1",
    "HF_DATASETS_DISABLE_PROGRESS_BARS": "1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "REBAR_MAX_IFC_SECONDS": "8",
    "REBAR_MAX_IFC_MEMORY_BYTES": str(2 << 30),
}


class Worker:
    """Worker process, started when it is first needed and again after it has died; a context manager.

    ``process`` is None while there is none.
    """

    def __init__(self, hang_s: float = HANG_S) -> None:
        self._hang_s = hang_s
        self.process: subprocess.Popen[str] | None = None
        self._base = tempfile.TemporaryDirectory(prefix="rebar-fuzz-", ignore_cleanup_errors=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: object, traceback: TracebackType | None) -> None:
        if self.process is not None:
            self.process.communicate()  # It ends when its input does.
        self._base.cleanup()

    def run(self, entry: str, seed: int, case: int) -> Outcome:
        """Run a case; a process that dies or does not answer in time is a failure of the case.

        Raises ``AssertionError`` if the entry point does not accept its sound inputs.
        """
        process = self.process or self._start()
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write(json.dumps([entry, seed, case]) + "\n")
            process.stdin.flush()
            answered = select.select([process.stdout], [], [], self._hang_s)[0]
            line = process.stdout.readline() if answered else ""
        except BrokenPipeError:
            answered, line = [process.stdout], ""
        if line:
            values = json.loads(line)
            assert "error" not in values, values["error"]
            return Outcome(**{**values, "codes": tuple(values["codes"]), "failures": tuple(values["failures"])})
        self._stop()
        failure = (
            f"crash: exit status {process.returncode}" if answered else f"hang: no end after {self._hang_s:g} s"
        )
        failure += f"\n{(Path(self._base.name) / 'stderr').read_text(errors='replace')[-3000:]}"
        return Outcome(entry, seed, case, "", 1, (), (failure,), 0.0, 0, "")

    def _start(self) -> subprocess.Popen[str]:
        base = Path(self._base.name)
        (base / "tmp").mkdir(exist_ok=True)
        environment = {**os.environ, **_ENVIRONMENT, **Workspace(work_folder(base)).environment(base / "tmp")}
        with (base / "stderr").open("w") as stderr:
            self.process = subprocess.Popen(
                [sys.executable, "-X", "faulthandler", "-m", "tests.fuzz.worker", str(base)],
                cwd=_PROJECT,
                env=environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stderr,
                text=True,
                start_new_session=True,
            )
        return self.process

    def _stop(self) -> None:
        """End the process and its children."""
        if self.process is not None:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.communicate()
            self.process = None


def main() -> None:
    """Answer requests until standard input ends."""
    import faulthandler

    from tests.fuzz.cases import ENTRY_POINTS

    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # What libraries print does not mix with the answers.
    runner = CaseRunner(Path(sys.argv[1]))
    for line in sys.stdin:
        entry, seed, case = json.loads(line)
        faulthandler.dump_traceback_later(HANG_S - 5)
        try:
            answer = asdict(runner.run(ENTRY_POINTS[entry], seed, case))
        except Exception:  # Unsound inputs, or a fault of these tests.
            answer = {"error": traceback.format_exc()}
        faulthandler.cancel_dump_traceback_later()
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
