"""Answer of the IFC reader: one JSON line per record, followed by the arrays that it announces.

The records, told apart by ``kind``, are ``project`` (first), ``left_out``, ``bar`` (points as float64),
``surface`` (vertices as float64, triangles as int32), ``step`` before the geometry kernel is used, and at the end
``failure`` or ``end``. ``scene.assemblies.ifc_file`` reads and validates them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy import ndarray

from rebar_depth_bench.errors import MeshError, exception_summary, printable

if TYPE_CHECKING:
    from dataset_builder.scene.ifc_reader.bars import Project, Shape, Source
    from dataset_builder.scene.ifc_reader.objects import LeftOut
    from dataset_builder.scene.selection import Selection

_MAX_MESSAGE = 1000


def write_answer(
    content: bytes,
    stream: BinaryIO,
    select: Sequence[Selection] = (),
    kernel_limit: Callable[[], AbstractContextManager[object]] = nullcontext,
) -> None:
    """Write the selected shapes of an IFC file's ``content`` to ``stream``, or a failure; nothing is raised.

    The geometry kernel is used within ``kernel_limit()``.
    """

    def kernel_step(label: str, reason: str) -> AbstractContextManager[object]:
        _write(stream, {"kind": "step", "label": label, "reason": printable(reason)})
        stream.flush()  # The step must be known if the kernel crashes.
        return kernel_limit()

    try:
        # Imported here, so that a failed import is part of the answer.
        from dataset_builder.scene.ifc_reader.bars import ShapeError, read_bars
    except ImportError as error:
        _write(stream, _failure("package", exception_summary(error)))
        return
    try:
        records = 0
        for records, item in enumerate(read_bars(content, select, kernel_step), start=1):  # noqa: B007
            _write(stream, *_record(item))
        _write(stream, {"kind": "end", "records": records})
    except MemoryError:
        _write(stream, _failure("memory", ""))
    except ShapeError as error:
        _write(stream, _failure("shape", str(error)))
    except MeshError as error:
        _write(stream, _failure("file", str(error)))
    except Exception as error:  # Damaged instances raise various exceptions when their attributes are read.
        _write(stream, _failure("file", f"cannot be read ({exception_summary(error)}), expected an IFC file"))


def _record(item: Project | Shape | LeftOut) -> tuple[Any, ...]:
    """Return the record of an item and its arrays."""
    from dataset_builder.scene.ifc_reader.bars import Project, Surface, SweptBar

    match item:
        case Project():
            return ({"kind": "project", **asdict(item)},)
        case SweptBar():
            values = {"role": item.role, "diameter_m": item.diameter_m, "points": len(item.axis_m)}
            notes = [{"code": code, "text": text} for code, text in item.notes]
            record = {"kind": "bar", "source": _source(item.source), "notes": notes, **values}
            return record, item.axis_m.astype("<f8")
        case Surface():
            sizes = {"vertices": len(item.vertices_m), "faces": len(item.faces)}
            record = {"kind": "surface", "source": _source(item.source), **sizes}
            return record, item.vertices_m.astype("<f8"), item.faces.astype("<i4")
        case _:
            return ({"kind": "left_out", **asdict(item)},)


def _source(source: Source) -> dict[str, Any]:
    """Return the record of an object: its GlobalId, names, and declared sizes in metres."""
    sizes = {"diameters_m": list(source.declared.diameters_m), "length_m": source.declared.length_m}
    names = {"global_id": source.global_id, "label": source.label, "host": source.host, "storey": source.storey}
    return {**names, **sizes}


def _failure(cause: str, message: str) -> dict[str, Any]:
    return {"kind": "failure", "cause": cause, "message": printable(message, _MAX_MESSAGE)}


def _write(stream: BinaryIO, record: dict[str, Any], *arrays: ndarray) -> None:
    stream.write(json.dumps(record).encode() + b"\n")
    for array in arrays:
        stream.write(np.ascontiguousarray(array).tobytes())
