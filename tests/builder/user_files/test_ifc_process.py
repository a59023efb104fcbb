"""Process that reads IFC files: limits, crashes, invalid answers, and its end with the parent."""

from __future__ import annotations

import io
import json
import os
import resource
import signal
import subprocess
import sys
import time
from contextlib import suppress
from typing import Any

import numpy as np
import pytest

from dataset_builder.scene.model import MAX_BARS
from dataset_builder.user_files import ifc_file
from dataset_builder.user_files.ifc_file import Answer, ifc_cage
from dataset_builder.user_files.ifc_reader.bars import SECONDS_PER_SHAPE, limited_time
from dataset_builder.user_files.ifc_records import MAX_ARRAY_BYTES, AnswerError
from rebar_depth_bench.base.errors import InputError, MeshError
from rebar_depth_bench.base.limits import IFC_MEMORY_BYTES, IFC_SECONDS
from tests.builder.catalog.scene_files import scene_config
from tests.builder.user_files.ifc_step_text import MILLIMETRES, Step
from tests.builder.user_files.ifc_writer import COLUMN, Ifc, column_with, extruded_circle
from tests.processes import is_running, wait_until


def run_instead(monkeypatch: pytest.MonkeyPatch, code: str) -> None:
    """Let a Python program take the place of the reader; its standard output is the answer."""
    program = f"import json, sys; sys.stdin.buffer.read(); out = sys.stdout.buffer; {code}"
    monkeypatch.setattr(ifc_file, "COMMAND", (sys.executable, "-c", program))


def run_changed_reader(monkeypatch: pytest.MonkeyPatch, code: str) -> None:
    """Let the reader run after a change of its process or modules."""
    reader = "runpy.run_module('dataset_builder.user_files.ifc_reader', run_name='__main__')"
    program = f"import os, runpy, sys, time; {code}; {reader}"
    monkeypatch.setattr(ifc_file, "COMMAND", (sys.executable, "-c", program))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("content", "words"),
    [
        (column_with("'IFC4'", f"'{'A' * 1000}'"), "crashed .Segmentation"),
        (column_with("DATA;", "DATA;" + "/* " * 60_000), "contains no reinforcement"),
        (column_with("HEADER;", "HEADER;" + "/* " * 60_000), "not a readable IFC file .Unexpected end"),
        (column_with("DATA;", "DATA;\n#1=A(" + "'" * 180_001 + ");"), "not all of it can be read"),
        (column_with("DATA;", "DATA;\n#1=A(" + "/* */" * 40_000 + "/* "), "not all of it can be read"),
        (column_with("((-46.,-46.,0.1)", f"({'(' * 100_000}1.{')' * 100_000}"), "not all of it can be read"),
        (column_with("((-46.,-46.,0.1)", f"({'IFCLABEL(' * 100_000}{')' * 100_000}"), "Segmentation|#24 "),
        (column_with("#11=IFCLOCALPLACEMENT($,", "#11=IFCLOCALPLACEMENT(#11,"), "#33.*is circular"),
    ],
    ids=["schema", "comments", "header", "quotes", "open comment", "depth", "types", "cycle"],
)  # fmt: skip
def test_content_that_crashed_or_stalled_is_refused_quickly(content: str, words: str) -> None:
    start = time.monotonic()
    with pytest.raises(MeshError, match=f"^a.ifc: .*{words}"):
        ifc_cage(content.encode(), "a.ifc")
    assert time.monotonic() - start < 30  # On an idle machine, 2 s.


@pytest.mark.slow
def test_crash_and_time_limits_name_the_object(monkeypatch: pytest.MonkeyPatch) -> None:
    ifc = Ifc()
    bar = ifc.bar(extruded_circle(ifc))
    content = ifc.file.to_string().encode()
    step = json.dumps({"kind": "step", "label": f"IfcReinforcingBar (#{bar.id()})", "reason": "no axis"})
    write = f"out.write({step!r}.encode() + b'\\n'); out.flush(); import os, signal; "
    for end, words in [
        ("os.abort()", "crashed .Aborted., or needs more than .*REBAR_MAX_IFC_MEMORY_BYTES"),
        ("os.kill(os.getpid(), signal.SIGALRM)", "time limit for one object"),
        ("os.kill(os.getpid(), signal.SIGXCPU)", "more than 1800 s .REBAR_MAX_IFC_SECONDS raises"),
        ("sys.exit(3)", "crashed .status 3."),
    ]:
        run_instead(monkeypatch, write + end)
        with pytest.raises(MeshError, match=rf"^a.ifc: .*\(#{bar.id()}\) .*no axis; tessellation: .*{words}"):
            ifc_cage(content, "a.ifc")


@pytest.mark.slow
def test_early_end_and_invalid_answer_of_the_process_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ifc_file, "COMMAND", (sys.executable, "-c", "raise SystemExit(7)"))
    with pytest.raises(MeshError, match=r"^a.ifc: the file cannot be read: ifcopenshell crashed \(status 7\)"):
        ifc_cage(b" " * 5_000_000, "a.ifc")
    run_instead(monkeypatch, "out.write(b'garbage\\n' * 1000000)")
    with pytest.raises(MeshError, match=r"^a.ifc: the IFC reader gave an invalid answer"):
        ifc_cage(COLUMN.read_bytes(), "a.ifc")


@pytest.mark.slow
def test_limits_of_time_and_memory_end_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    points = "".join(f"#{number}=IFCCARTESIANPOINT((1.,2.,3.));\n" for number in range(1000, 600_000))
    content = column_with("DATA;", f"DATA;\n{points}").encode()
    monkeypatch.setenv(IFC_SECONDS.variable, "1")
    with pytest.raises(MeshError, match=r"^a.ifc: .*more than 1 s \(REBAR_MAX_IFC_SECONDS raises the limit\)"):
        ifc_cage(content, "a.ifc")
    monkeypatch.undo()
    monkeypatch.setenv(IFC_MEMORY_BYTES.variable, str(250 << 20))
    with pytest.raises(MeshError, match=r"^a.ifc: .*needs more than 262144000 .*IFC_MEMORY_BYTES raises"):
        ifc_cage(content, "a.ifc")


@pytest.mark.slow
def test_large_model_is_read_by_one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    bars, step = 600, Step(MILLIMETRES, "IFC4")
    solid = step.disc(step.polyline((0, 0, 0), (0, 0, 1000)), 5.0, "$", "$")
    for bar in range(bars):
        step.bar([solid], 0.010, 1.0, at=(100 * bar, 0, 0))
    run_changed_reader(
        monkeypatch, "sys.addaudithook(lambda event, _: os._exit(3) if event == 'os.fork' else None)"
    )
    assert len(ifc_cage(step.text().encode(), "a.ifc").bars) == bars  # A fork would have limits of its own.


@pytest.mark.parametrize(("own_s", "during_s", "after_s"), [(0, 60, 0), (30, 30, 30), (90, 60, 90)])
def test_time_limit_of_an_object_keeps_that_of_the_process(own_s: int, during_s: int, after_s: int) -> None:
    assert SECONDS_PER_SHAPE == 60
    signal.setitimer(signal.ITIMER_REAL, own_s)
    try:
        with limited_time():
            assert during_s - 10 < signal.getitimer(signal.ITIMER_REAL)[0] <= during_s
        assert after_s - 10 < signal.getitimer(signal.ITIMER_REAL)[0] <= after_s
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)


@pytest.mark.slow
def test_process_that_sleeps_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    sleep = "from dataset_builder.user_files.ifc_reader import bars; bars.read_bars = lambda *_: time.sleep(100)"
    run_changed_reader(monkeypatch, sleep)
    monkeypatch.setenv(IFC_SECONDS.variable, "1")
    start = time.monotonic()
    with pytest.raises(MeshError, match=r"more than 1 s \(REBAR_MAX_IFC_SECONDS raises the limit\)"):
        ifc_cage(COLUMN.read_bytes(), "a.ifc")
    assert time.monotonic() - start < 50


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="needs prctl")
def test_process_ends_with_its_parent() -> None:
    code = f"""
import os, subprocess, time
command = [{sys.executable!r}, "-m", "dataset_builder.user_files.ifc_reader"]
child = subprocess.Popen([*command, str(os.getpid()), str(8 << 30), "60", "120"])
print(child.pid, flush=True)
time.sleep(100)
"""
    read_end, write_end = os.pipe()  # Open in this process: the reader waits for the end of its input.
    try:
        with subprocess.Popen([sys.executable, "-c", code], stdin=read_end, stdout=subprocess.PIPE) as parent:
            assert parent.stdout
            reader = int(parent.stdout.readline())
            wait_until(lambda: resource.prlimit(reader, resource.RLIMIT_CORE) == (0, 0), "the limits are set")
            assert resource.prlimit(reader, resource.RLIMIT_DATA) == (8 << 30, 8 << 30)
            assert is_running(reader)
            parent.kill()
        wait_until(lambda: not is_running(reader), "the reader ends", within_s=30)
    finally:
        os.close(read_end)
        os.close(write_end)
        with suppress(ProcessLookupError, UnboundLocalError):
            os.kill(reader, signal.SIGKILL)


Record = dict[str, Any] | np.ndarray | bytes
NAMES: dict[str, Any] = {"global_id": "g", "label": "a", "host": "Wall", "storey": None}
SOURCE: dict[str, Any] = NAMES | {"diameters_m": [], "length_m": None}
PROJECT: dict[str, Any] = {"kind": "project", "unit_m": 0.001}
LEFT_OUT: dict[str, Any] = {"kind": "left_out", "global_id": "w", "reason": "IfcWall: not reinforcement"}
SWEEP: dict[str, Any] = {"role": "b", "diameter_m": 0.01, "points": 2}
BAR: dict[str, Any] = {"kind": "bar", "source": SOURCE, "notes": {}} | SWEEP
SURFACE: dict[str, Any] = {"kind": "surface", "source": SOURCE, "vertices": 3, "faces": 1}
END: dict[str, Any] = {"kind": "end", "records": 2}
LINE = np.array([[0, 0, 0], [1, 0, 0]], "<f8")
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f8")


def answer(*records: Record) -> Answer:
    lines = [
        json.dumps(record).encode() + b"\n" if isinstance(record, dict) else bytes(record) for record in records
    ]
    return Answer(io.BytesIO(b"".join(lines)), "a.ifc")


def test_sound_answer_gives_bars() -> None:
    cage = answer(PROJECT, LEFT_OUT, BAR, LINE, END | {"records": 3}).cage()
    [bar], [left_out] = cage.bars, cage.left_out
    assert (left_out.source, left_out.reason) == ("w", "IfcWall: not reinforcement")
    assert (bar.source, bar.host, bar.storey) == ("g", "Wall", None)
    np.testing.assert_array_equal(cage.world_from_source, np.diag([0.001, 0.001, 0.001, 1]))
    assert (bar.label, bar.bar.bar_id, bar.bar.role, bar.bar.axis_m[1]) == ("bar 1, a", 1, "b", (1.0, 0.0, 0.0))
    [bar] = answer(PROJECT, SURFACE, CORNERS, np.array([[0, 1, 2]], "<i4"), END).cage().bars
    assert bar.mesh is not None
    assert bar.bar.role == "imported"


@pytest.mark.parametrize(
    "records",
    [
        [b"\x80\x04]\x94.\n"],
        [b"x" * 30_000],
        [b"[" * 5000 + b"\n"],
        [{"kind": "other"}],
        [BAR | {"points": 1}, LINE, END],
        [BAR | {"points": -1}, LINE, END],
        [BAR | {"points": 1 << 62}, LINE, END],
        [BAR | {"points": MAX_ARRAY_BYTES // 24 + 1}, LINE, END],
        [BAR | {"points": "2"}, LINE, END],
        [BAR | {"diameter_m": 0}, LINE, END],
        [BAR | {"diameter_m": float("nan")}, LINE, END],
        [BAR | {"role": "x" * 61}, LINE, END],
        [BAR | {"role": ""}, LINE, END],
        [BAR | {"source": SOURCE | {"label": "x" * 201}}, LINE, END],
        [BAR | {"source": SOURCE | {"diameters_m": [-1.0]}}, LINE, END],
        [BAR | {"notes": {"A b": ""}}, LINE, END],
        [BAR | {"extra": 1}, LINE, END],
        [BAR | {"source": SOURCE | {"host": 1}}, LINE, END],
        [BAR, LINE + np.inf, END],
        [PROJECT | {"unit_m": 0.0}],
        [LEFT_OUT | {"reason": "x" * 201}],
        [BAR, LINE, END | {"records": 3}],
        [SURFACE | {"vertices": 2}, CORNERS, END],
        [SURFACE, CORNERS, np.array([[0, 1, 3]], "<i4"), END],
        [SURFACE, CORNERS, np.array([[0, 1, -1]], "<i4"), END],
        [SURFACE, CORNERS + np.nan, np.array([[0, 1, 2]], "<i4"), END],
    ],
)  # fmt: skip
def test_invalid_answers_are_refused(records: list[Record]) -> None:
    with pytest.raises(AnswerError) as caught:
        answer(PROJECT, *records).cage()
    assert not caught.value.ended


@pytest.mark.parametrize("records", [[], [BAR], [BAR, LINE], [BAR, LINE, b'{"kind": "e'], [SURFACE, CORNERS]])
def test_incomplete_answers_are_refused(records: list[Record]) -> None:
    with pytest.raises(AnswerError) as caught:
        answer(PROJECT, *records).cage()
    assert caught.value.ended


@pytest.mark.slow
def test_too_many_bars_are_refused() -> None:
    with pytest.raises(MeshError, match=f"more than {MAX_BARS} bars found"):
        answer(PROJECT, *(record for _ in range(MAX_BARS + 1) for record in (BAR, LINE))).cage()


@pytest.mark.slow
def test_bar_without_readable_shape_is_named() -> None:
    ifc = Ifc()
    bar = ifc.rooted("IfcReinforcingBar")
    name = bar.GlobalId.replace("$", "[$]")
    with pytest.raises(MeshError, match=f"^a.ifc: .*{name} .* no readable shape: .*empty"):
        ifc_cage(ifc.file.to_string().encode(), "a.ifc")


def test_missing_ifcopenshell_names_pip_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ifcopenshell", None)
    with pytest.raises(InputError, match=r"pip install '\.\[ifc\]'"):
        scene_config(COLUMN)
