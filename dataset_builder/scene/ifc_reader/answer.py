"""Answer of the IFC reader: one JSON line per record, followed by the arrays that it announces.

The records, told apart by ``kind``, are ``bar`` (points as float64), ``surface`` (vertices as float64, triangles
as int32), ``step`` before the geometry kernel is used, and at the end ``failure`` or ``end``.
``scene.assemblies.ifc.answer`` reads and validates them.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy import ndarray

from rebar_depth_bench.errors import MeshError, exception_summary, printable

if TYPE_CHECKING:
    from dataset_builder.scene.ifc_reader.bars import Source

_MAX_MESSAGE = 1000


def write_answer(content: bytes, stream: BinaryIO, before_kernel: Callable[[], object] = lambda: None) -> None:
    """Write the shapes of an IFC file's ``content`` to ``stream``, or a failure; nothing is raised.

    ``before_kernel`` is called before the geometry kernel is used.
    """

    def step(label: str, reason: str) -> None:
        _write(stream, {"kind": "step", "label": label, "reason": printable(reason)})
        stream.flush()  # The step must be known if the kernel crashes.
        before_kernel()

    try:
        # Imported here, so that a failed import is part of the answer.
        from dataset_builder.scene.ifc_reader.bars import ShapeError, Surface, read_bars
    except ImportError as error:
        _write(stream, _failure("package", exception_summary(error)))
        return
    count = 0
    try:
        for shape in read_bars(content, step):
            count += 1
            source = _source(shape.source)
            if isinstance(shape, Surface):
                sizes = {"vertices": len(shape.vertices_m), "faces": len(shape.faces)}
                record = {"kind": "surface", "source": source, **sizes}
                _write(stream, record, shape.vertices_m.astype("<f8"), shape.faces.astype("<i4"))
            else:
                values = {"role": shape.role, "diameter_m": shape.diameter_m, "points": len(shape.axis_m)}
                notes = [{"code": code, "text": text} for code, text in shape.notes]
                record = {"kind": "bar", "source": source, "notes": notes, **values}
                _write(stream, record, shape.axis_m.astype("<f8"))
        _write(stream, {"kind": "end", "shapes": count})
    except MemoryError:
        _write(stream, _failure("memory", ""))
    except ShapeError as error:
        _write(stream, _failure("shape", str(error)))
    except MeshError as error:
        _write(stream, _failure("file", str(error)))
    except Exception as error:  # Damaged instances raise various exceptions when their attributes are read.
        _write(stream, _failure("file", f"cannot be read ({exception_summary(error)}), expected an IFC file"))


def _source(source: Source) -> dict[str, Any]:
    """Return the record of an object: its GlobalId, name, and declared sizes in metres."""
    sizes = {"diameters_m": list(source.declared.diameters_m), "length_m": source.declared.length_m}
    return {"global_id": source.global_id, "label": source.label, **sizes}


def _failure(cause: str, message: str) -> dict[str, Any]:
    return {"kind": "failure", "cause": cause, "message": printable(message, _MAX_MESSAGE)}


def _write(stream: BinaryIO, record: dict[str, Any], *arrays: ndarray) -> None:
    stream.write(json.dumps(record).encode() + b"\n")
    for array in arrays:
        stream.write(np.ascontiguousarray(array).tobytes())
