"""Process that reads an IFC file: a line of JSON and the content on standard input, answer on standard output.

The line is a list of the tables that select objects (``specs.file_specs.TABLES``), the answer a list of records
(``user_files.ifc_records``).

``python -m dataset_builder.user_files.ifc_reader PARENT_PID MEMORY_BYTES CPU_SECONDS WALL_SECONDS``
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import IO

from dataset_builder.specs.file_specs import TABLES, Selection
from dataset_builder.user_files.ifc_records import MAX_MESSAGE, EndRecord, FailureRecord, write_record
from rebar_depth_bench.base.errors import MeshError, exception_summary, printable
from rebar_depth_bench.base.system import limit_process


def main() -> None:
    """Set the limits, read the content and write the answer; native output is redirected to standard error."""
    parent, memory_bytes, cpu_seconds, wall_seconds = map(int, sys.argv[1:])
    limit_process(parent, memory_bytes, cpu_seconds=cpu_seconds, wall_seconds=wall_seconds)
    with os.fdopen(os.dup(1), "wb") as stream:
        os.dup2(2, 1)
        select = TABLES.validate_json(sys.stdin.buffer.readline())
        write_answer(sys.stdin.buffer.read(), stream, select)


def write_answer(content: bytes, stream: IO[bytes], select: Sequence[Selection] = ()) -> None:
    """Write the selected shapes of an IFC file's ``content`` to ``stream``, or a failure; nothing is raised."""
    count = 0
    end: EndRecord | FailureRecord
    try:
        # Imported here, so that a failed import is part of the answer.
        from dataset_builder.user_files.ifc_reader.bars import read_bars

        for count, (record, arrays) in enumerate(read_bars(content, select), start=1):  # noqa: B007
            write_record(stream, record, arrays)
        end = EndRecord(records=count)
    except MemoryError:
        end = FailureRecord(message=None)
    except MeshError as error:
        end = _failure(str(error))
    except ImportError as error:
        end = _failure(exception_summary(error))
    except Exception as error:  # Damaged instances raise various exceptions when their attributes are read.
        end = _failure(f"cannot be read ({exception_summary(error)}), expected an IFC file")
    write_record(stream, end)


def _failure(message: str) -> FailureRecord:
    return FailureRecord(message=printable(message, MAX_MESSAGE))


if __name__ == "__main__":
    main()
