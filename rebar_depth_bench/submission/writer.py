"""Submission writer: atomic and deterministic creation of submission archives."""

from __future__ import annotations

import json
import os
import re
import zipfile
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from threading import Lock
from types import TracebackType
from typing import Any, BinaryIO, Self

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from rebar_depth_bench.base.errors import InputError, Problem, escape_text
from rebar_depth_bench.base.names import VIEW_ID_PATTERN
from rebar_depth_bench.base.validation import short_repr
from rebar_depth_bench.base.writing import named_write_errors, output_file
from rebar_depth_bench.submission.declaration import MAX_NUMBER, METADATA_NAME, METRIC, parse_metadata
from rebar_depth_bench.submission.maps import Depth, resize_hint

_EPOCH = (1980, 1, 1, 0, 0, 0)
_UNIX_MODE = 0o100644
# Zip readers skip this extra field. It aligns the array values to 64 bytes in the file, so that they can be used
# in place in a memory mapping.
_ALIGNMENT_BYTES = 64
_PADDING_FIELD_ID = 0xD935
_LOCAL_HEADER_BYTES = 30


class _DiscardedError(Exception):
    """Reason for which the file of an archive is deleted."""


class SubmissionWriter:
    """Context manager that writes an archive to ``path``: one ``.npy`` entry per view, and ``submission.json``.

    The archive appears at ``path`` only on a clean exit; after an exception in the block an existing file at
    ``path`` is unchanged. The target of a link is replaced; a device or a pipe is written through. The same
    predictions, added in the same order, give the same bytes. Several threads may add views; the order of the
    entries, which changes no score, is then theirs. Entries are stored uncompressed, which is fastest to read;
    ``compress=True`` deflates them (about 100 times slower to write, 10 times slower to read, a fifth smaller),
    and the bytes then also depend on the zlib library in use. ``inputs`` and ``uses_ground_truth`` are declared as
    in ``Declaration``, ``prediction`` is one of ``PREDICTION_KINDS``, by default metric. ``notes`` is free-form
    information about the method; no score depends on it.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        method: str,
        *,
        description: str | None = None,
        url: str | None = None,
        code_url: str | None = None,
        licence: str | None = None,
        training_data: str | None = None,
        parameters: float | str | None = None,
        inputs: str | None = None,
        uses_ground_truth: bool | None = None,
        prediction: str | None = None,
        runtime: Mapping[str, object] | None = None,
        notes: Mapping[str, object] | None = None,
        compress: bool = False,
    ) -> None:
        """Check the metadata. Raises ``InputError`` if a reader would reject it."""
        self.path = Path(path)
        self._compression = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
        metadata: dict[str, Any] = {
            "method": method,
            "description": description,
            "url": url,
            "code_url": code_url,
            "licence": licence,
            "training_data": training_data,
            "parameters": parameters,
            "inputs": inputs,
            "uses_ground_truth": uses_ground_truth,
            "prediction": None if prediction == METRIC else prediction,
            "runtime": None if runtime is None else dict(runtime),
            "notes": None if notes is None else dict(notes),
        }
        self._metadata = {key: value for key, value in metadata.items() if value is not None}
        try:
            content = json.dumps(self._metadata, allow_nan=False, ensure_ascii=False, sort_keys=True).encode()
        except (TypeError, ValueError, RecursionError) as error:
            expected = f"text, numbers of at most {MAX_NUMBER:g}, lists and objects"
            problems = [Problem("invalid", "", f"the metadata is not JSON ({error})", expected)]
        else:
            _, problems = parse_metadata(content)
        if problems:
            raise InputError.from_problems(self.path, problems)
        self._seconds: dict[str, float] = {}
        self._view_ids: set[str] = set()
        self._lock = Lock()
        self._open = ExitStack()
        self._file: BinaryIO | None = None
        self._zip: zipfile.ZipFile | None = None

    def add(self, view_id: str, depth: object, seconds: float | None = None) -> None:
        """Store the planar depth of a left view in metres: an array or tensor (H, W), as ``depth_map`` accepts.

        float16 is kept, every other float type is converted to float32 (values out of its range become infinite).
        Values that are not finite, and of ``metric`` and ``scale`` predictions those <= 0, mean no prediction.
        ``seconds`` is the method's computing time for the view; it is stored in ``runtime``, so that the bytes of
        the archive depend on it.

        Raises ``InputError`` if the writer is not open, ``view_id`` is malformed or was added before, ``depth`` is
        not one map of floats, or ``seconds`` is not a number from 0 to ``MAX_NUMBER``.
        """
        if self._zip is None:
            raise InputError(f"{self.path}: the writer is not open, expected add() inside its 'with' block")
        if not isinstance(view_id, str) or not re.fullmatch(VIEW_ID_PATTERN, view_id):
            raise InputError(
                f"view_id is {escape_text(str(view_id))}, expected '<config>/<number>' like 'lattice/0000'"
            )
        if seconds is not None and not (isinstance(seconds, int | float) and 0 <= seconds <= MAX_NUMBER):
            found = short_repr(seconds)
            raise InputError(f"{view_id}: seconds is {found}, expected a number from 0 to {MAX_NUMBER:g}")
        self.write_map(view_id, depth_map(f"{view_id}: depth is", depth), seconds)

    def write_map(self, view_id: str, array: Float[ndarray, "h w"], seconds: float | None = None) -> None:
        """Store a map that ``depth_map`` returned, as ``add`` does; the caller has checked the other arguments."""
        assert self._zip is not None
        assert self._file is not None
        values = stored_map(array)
        with self._lock:
            if view_id in self._view_ids:
                raise InputError(f"{view_id}: the view was added twice, expected once")
            with named_write_errors(self.path):
                self._write_entry(self._zip, f"{view_id}.npy", _npy_header(values), values.data.cast("B"))
                self._file.flush()  # A process that is forked now has nothing left to write.
            self._view_ids.add(view_id)
            if seconds is not None:
                self._seconds[view_id] = float(seconds)

    def __enter__(self) -> Self:
        if not self.path.parent.is_dir():
            raise InputError(f"{self.path.parent}: no such folder, expected an existing folder for the archive")
        if self.path.is_dir():
            raise InputError(f"{self.path}: the path is a directory, expected a file name for the archive")
        with ExitStack() as stack:
            part = stack.enter_context(output_file(self.path))
            self._file = stack.enter_context(part.open("wb"))
            self._zip = zipfile.ZipFile(self._file, "w", allowZip64=True)
            self._open = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        archive, self._zip = self._zip, None
        assert archive is not None
        with self._open:
            try:
                if error is not None:
                    raise error
                values = dict(self._metadata)
                if self._seconds:
                    values["runtime"] = {**values.get("runtime", {}), "seconds": self._seconds}
                content = (json.dumps(values, indent=2, sort_keys=True) + "\n").encode()
                self._write_entry(archive, METADATA_NAME, b"", memoryview(content))
                archive.close()
            finally:
                # Without this, ZipFile would write a directory into the discarded file when it is closed again.
                archive.fp = None

    def discard(self) -> None:
        """End the archive without writing it, as an exception in the block does; nothing if it is not open."""
        archive, self._zip = self._zip, None
        if archive is not None:
            archive.fp = None  # Without this, ZipFile would write a directory into the discarded file.
            with suppress(_DiscardedError), self._open:
                raise _DiscardedError

    def _write_entry(self, archive: zipfile.ZipFile, name: str, header: bytes, body: memoryview) -> None:
        assert self._file is not None
        info = zipfile.ZipInfo(name, _EPOCH)
        info.create_system = 3
        info.external_attr = _UNIX_MODE << 16
        info.compress_type = self._compression
        info.file_size = len(header) + len(body)
        if self._compression == zipfile.ZIP_STORED:
            info.extra = _padding_field(self._file.tell() + _LOCAL_HEADER_BYTES + len(name) + len(header))
        with archive.open(info, "w") as entry:
            entry.write(header)
            entry.write(body)


def depth_map(
    what: str, depth: object, grid: tuple[int, int] | None = None, error: type[InputError] = InputError
) -> Float[ndarray, "h w"]:
    """Return the depth of one view: an array of NumPy, a tensor of torch of any float type and device, or lists.

    Axes of length 1 before H x W are dropped. ``grid`` is the expected (H, W), None for any. Raises ``error``, its
    message beginning with ``what``, for anything but floats of that shape, and for masked arrays.
    """
    try:
        values: Any = depth
        if hasattr(values, "detach"):
            values = values.detach()
            values = (values.float() if "bfloat16" in str(values.dtype) else values).cpu().numpy()
        array: ndarray = np.asanyarray(values)
        array = array.astype(np.float32) if array.dtype.name == "bfloat16" else array
    except Exception as reason:  # The object's own conversion may raise anything.
        found = f"an object of type {type(depth).__name__}, which cannot be converted to a numpy array"
        raise error(f"{what} {found} ({escape_text(str(reason))})") from reason
    if isinstance(array, np.ma.MaskedArray):  # numpy.asarray would silently drop the mask.
        raise error(f"{what} a masked array, expected NaN where there is no prediction")
    shape = array.shape
    if set(shape[:-2]) <= {1}:
        array = array.reshape(shape[-2:])
    if array.dtype.kind != "f" or array.ndim != 2 or 0 in shape or (grid and array.shape != grid):
        found = f"{array.dtype} of shape {shape}"
        if array.dtype.kind in "OSU":
            found = "None" if depth is None else f"an object of type {type(depth).__name__}"
            if isinstance(depth, Mapping):
                found += f" with the keys {escape_text(', '.join(map(str, depth)))}"
        hint = resize_hint(array.shape, grid) if grid and array.dtype.kind == "f" else ""
        raise error(f"{what} {found}, expected an array of floats of shape {grid or '(H, W)'}{hint}")
    return np.asarray(array)


def stored_map(array: Float[ndarray, "h w"]) -> Depth:
    """Return a map as archives store it: float16, or float32 with values out of its range infinite."""
    with np.errstate(over="ignore", under="ignore"):
        return np.ascontiguousarray(array, "<f2" if array.dtype.itemsize == 2 else "<f4")


def _npy_header(values: Depth) -> bytes:
    text = f"{{'descr': '{values.dtype.str}', 'fortran_order': False, 'shape': {values.shape}, }}"
    # The .npy format requires a final newline and values that start at a multiple of 64 bytes.
    text += " " * (-(len(text) + 11) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode("ascii")


def _padding_field(values_offset: int) -> bytes:
    """Return a zip extra field that moves byte ``values_offset`` of the file to a multiple of the alignment."""
    length = -(values_offset + 4) % _ALIGNMENT_BYTES
    return _PADDING_FIELD_ID.to_bytes(2, "little") + length.to_bytes(2, "little") + bytes(length)
