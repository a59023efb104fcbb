"""Limits on the size, time and memory of files and answers from outside.

Each limit has a default, which an environment variable ``REBAR_MAX_<NAME>`` replaces. ``SECURITY.md`` lists them.
``call_within`` limits the time of a call; ``system.limit_process`` limits a process.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from concurrent.futures import Future, wait
from dataclasses import dataclass
from threading import Thread
from typing import TypeVar

from rebar_depth_bench.base.errors import InputError, escape_text

_MIB, _GIB = 1 << 20, 1 << 30
_Result = TypeVar("_Result")


@dataclass(frozen=True, slots=True)
class Limit:
    """Largest accepted value of a quantity; ``name`` ends with its unit, ``description`` says what is limited."""

    name: str
    default: int
    description: str

    @property
    def variable(self) -> str:
        """Name of the environment variable that replaces the default."""
        return f"REBAR_MAX_{self.name.upper()}"

    def value(self) -> int:
        """Return the limit in force. Raises ``InputError`` if the variable is not a whole number from 1."""
        text = os.environ.get(self.variable)
        if text is None:
            return self.default
        if not re.fullmatch(r"[1-9][0-9]{0,17}", text):
            raise InputError(f"{self.variable} is {escape_text(text)}, expected a whole number from 1")
        return int(text)

    def allowed(self, unit: str = "") -> str:
        """Return the largest accepted value in ``unit``, and the variable that raises it, for messages."""
        return f"at most {self.value()}{' ' if unit else ''}{unit}; {self.variable} raises the limit"


JSON_BYTES = Limit("json_bytes", 64 * _MIB, "a JSON file or answer: manifest, result, export record")
TOML_BYTES = Limit("toml_bytes", _MIB, "a scene, calibration or model description, and any other small text file")
TABLE_BYTES = Limit("table_bytes", _GIB, "the decoded size of `bars.parquet` and of `crossings.parquet`")
DETECTIONS_BYTES = Limit("detections_bytes", 256 * _MIB, "a file of detected crossings, also decoded")
CELL_BYTES = Limit("cell_bytes", 256 * _MIB, "an encoded image or depth map of a dataset row")
IMAGE_PIXELS = Limit("image_pixels", 100_000_000, "an image of a capture, before it is decoded")
MESH_BYTES = Limit("mesh_bytes", _GIB, "a PLY, STL or OBJ file")
MESH_SECONDS = Limit("mesh_seconds", 1800, "the processor time for finding the bars of a PLY, STL or OBJ file")
IFC_BYTES = Limit("ifc_bytes", _GIB, "an IFC file")
IFC_SECONDS = Limit("ifc_seconds", 1800, "the processor time for reading an IFC file")
IFC_MEMORY_BYTES = Limit("ifc_memory_bytes", 8 * _GIB, "the memory of the process that reads an IFC file")
ONNX_MEMORY_BYTES = Limit(
    "onnx_memory_bytes", 64 * _GIB, "the CPU memory of ONNX models, at most that of the machine"
)
CACHE_BYTES = Limit(
    "cache_bytes", 20 * _GIB, "the cache of ground truth; the least recently used entries go first"
)


class DeadlineError(Exception):
    """Call, such as an inference or a request to a server, that did not return in time."""


def call_within(
    seconds: float, function: Callable[[], _Result], cancel: Callable[[], object] = lambda: None
) -> _Result:
    """Return ``function()``. Raises ``DeadlineError`` if it takes longer than ``seconds``.

    The function runs in another thread. ``cancel`` is called to stop it at the deadline or on Ctrl-C. A function
    that does not end soon after is abandoned: its thread does not keep the process alive.
    """
    future: Future[_Result] = Future()

    def run() -> None:
        try:
            future.set_result(function())
        except BaseException as error:
            future.set_exception(error)

    Thread(target=run, daemon=True).start()
    try:
        wait([future], seconds)
        if not future.done():
            raise DeadlineError
    except BaseException:  # Ctrl-C, too.
        cancel()
        # A thread that returns from native code while Python exits would abort the process.
        wait([future], 2.0)
        raise
    return future.result()
