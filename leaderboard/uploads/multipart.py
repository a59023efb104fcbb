"""Multipart upload parser that streams the archive to disk, with a size limit, instead of holding it in memory."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from anyio import to_thread
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from rebar_depth_bench.errors import Problem

ARCHIVE_FIELD = "archive"
MAX_FIELD_BYTES = 1 << 10
"""Maximum size in bytes of a text field before the archive."""
WRITE_CHUNK_BYTES = 1 << 20
"""Number of buffered bytes that triggers a write, which runs in a worker thread."""
MAX_OVERHEAD_BYTES = 64 << 10
"""Maximum size in bytes of everything in the body except the content of the archive."""


class UploadRejectedError(Exception):
    """Raised when an upload is rejected.

    Holds the HTTP status, the detail message and, for status 422 only, all problems.
    """

    def __init__(self, status: int, detail: str, problems: Sequence[Problem] = ()) -> None:
        self.status, self.detail = status, detail
        self.problems = (problems or (Problem("syntax", "", detail),)) if status == 422 else ()
        super().__init__(detail)


@dataclass(frozen=True)
class ReceivedArchive:
    """A received archive: its file, its SHA-256 in hexadecimal and its size in bytes."""

    path: Path
    sha256: str
    size: int


@dataclass
class _PartHeaders:
    """Parser callbacks for part headers: ``name`` is the current part's field, ``number`` its 1-based index."""

    header: bytearray = field(default_factory=bytearray)
    value: bytearray = field(default_factory=bytearray)
    name: bytes = b""
    number: int = 0

    def part_begin(self) -> None:
        self.name = b""
        self.number += 1
        self.header.clear()
        self.value.clear()

    def header_field(self, data: bytes, start: int, end: int) -> None:
        self.header += data[start:end]

    def header_value(self, data: bytes, start: int, end: int) -> None:
        self.value += data[start:end]

    def header_end(self) -> None:
        if bytes(self.header).lower() == b"content-disposition":
            self.name = parse_options_header(bytes(self.value))[1].get(b"name", b"")
        self.header.clear()
        self.value.clear()

    def callbacks(self) -> dict[str, Callable[..., None]]:
        return {
            "on_part_begin": self.part_begin,
            "on_header_field": self.header_field,
            "on_header_value": self.header_value,
            "on_header_end": self.header_end,
        }


@dataclass
class _ArchivePart(_PartHeaders):
    """Parser callbacks that buffer the content of the archive field until it is written to disk."""

    archives: int = 0
    complete: bool = False
    waiting: list[bytes] = field(default_factory=list)

    def callbacks(self) -> dict[str, Callable[..., None]]:
        return {**super().callbacks(), "on_part_data": self.part_data, "on_end": self.end}

    def header_end(self) -> None:
        was_archive = self.is_archive
        super().header_end()
        self.archives += self.is_archive and not was_archive

    @property
    def is_archive(self) -> bool:
        return self.name == ARCHIVE_FIELD.encode()

    def part_data(self, data: bytes, start: int, end: int) -> None:
        if self.is_archive:
            self.waiting.append(data[start:end])

    def end(self) -> None:
        self.complete = True


@dataclass
class _FirstPart(_PartHeaders):
    """Parser callbacks that collect the text of the first part of the body."""

    text: bytearray = field(default_factory=bytearray)
    ended: bool = False

    def callbacks(self) -> dict[str, Callable[..., None]]:
        return {**super().callbacks(), "on_part_data": self.part_data, "on_part_end": self.part_end}

    def header_end(self) -> None:
        if not self.ended:
            super().header_end()

    def part_begin(self) -> None:
        if not self.ended:
            super().part_begin()

    def part_data(self, data: bytes, start: int, end: int) -> None:
        if not self.ended and len(self.text) <= MAX_FIELD_BYTES:
            self.text += data[start:end]

    def part_end(self) -> None:
        self.ended = True


async def receive(stream: AsyncIterator[bytes], content_type: str, spool: Path, max_bytes: int) -> ReceivedArchive:
    """Write the field ``archive`` of a multipart body to a new file in ``spool`` and return the received archive.

    Raises ``UploadRejectedError``, and leaves no file, if the body is not valid multipart (422) or the archive has
    more than ``max_bytes`` bytes (413).
    """
    boundary = boundary_of(content_type)
    parts = _ArchivePart()
    descriptor, name = tempfile.mkstemp(dir=spool, suffix=".upload")
    path, sha256, size, received_bytes = Path(name), hashlib.sha256(), 0, 0
    try:
        parser = MultipartParser(boundary, parts.callbacks())  # type: ignore[arg-type]
        with os.fdopen(descriptor, "wb") as file:

            def flush() -> int:
                batch = b"".join(parts.waiting)
                parts.waiting.clear()
                sha256.update(batch)
                return file.write(batch)

            async for chunk in stream:
                received_bytes += len(chunk)
                parser.write(chunk)
                waiting = sum(map(len, parts.waiting))
                _check_parts(parts, received_bytes - size - waiting)
                if size + waiting > max_bytes:
                    raise UploadRejectedError(413, too_large_message(max_bytes))
                if waiting >= WRITE_CHUNK_BYTES:
                    size += await to_thread.run_sync(flush)
            parser.finalize()
            size += await to_thread.run_sync(flush)
        if not parts.complete or not parts.archives:
            raise UploadRejectedError(
                422, f"the body is incomplete or has no field {ARCHIVE_FIELD!r}, expected a zip file in this field"
            )
        return ReceivedArchive(path, sha256.hexdigest(), size)
    except FormParserError as error:
        path.unlink(missing_ok=True)
        raise UploadRejectedError(422, f"the body is not valid multipart/form-data: {error}") from None
    except BaseException:
        path.unlink(missing_ok=True)
        raise


async def read_leading_field(
    stream: AsyncIterator[bytes], content_type: str, name: str
) -> tuple[str, AsyncIterator[bytes]]:
    """Read the first field of a multipart body; return its text and a stream of the whole body.

    The text is "" if the first field is not ``name`` or is too long. The form sends its token this way, so that
    the uploader is identified before the archive is stored. Raises ``UploadRejectedError`` (422) if the body is
    not multipart.
    """
    first = _FirstPart()
    parser = MultipartParser(boundary_of(content_type), first.callbacks())  # type: ignore[arg-type]
    chunks: list[bytes] = []
    try:
        async for chunk in stream:
            chunks.append(chunk)
            parser.write(chunk)
            is_other = first.name not in (b"", name.encode())
            if (
                first.ended
                or is_other
                or len(first.text) > MAX_FIELD_BYTES
                or sum(map(len, chunks)) > MAX_OVERHEAD_BYTES
            ):
                break
    except FormParserError as error:
        raise UploadRejectedError(422, f"the body is not valid multipart/form-data: {error}") from None
    is_complete = first.ended and first.name == name.encode() and len(first.text) <= MAX_FIELD_BYTES
    return (first.text.decode(errors="replace") if is_complete else ""), _replay(chunks, stream)


async def _replay(chunks: list[bytes], stream: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    while chunks:
        yield chunks.pop(0)
    async for chunk in stream:
        yield chunk


def boundary_of(content_type: str) -> bytes:
    """Return the boundary of a multipart body. Raises ``UploadRejectedError`` (422) for any other content type."""
    kind, options = parse_options_header(content_type)
    boundary = options.get(b"boundary")
    if kind != b"multipart/form-data" or not boundary:
        raise UploadRejectedError(
            422, f"the content type is {content_type!r}, expected multipart/form-data with a boundary"
        )
    return boundary


def too_large_message(max_bytes: int) -> str:
    """Return the message that rejects an archive of more than ``max_bytes`` bytes."""
    return f"the archive is larger than {max_bytes} bytes, the limit of this service"


def _check_parts(parts: _ArchivePart, overhead_bytes: int) -> None:
    if parts.archives > 1:
        raise UploadRejectedError(422, f"the body has the field {ARCHIVE_FIELD!r} twice, expected once")
    if overhead_bytes > MAX_OVERHEAD_BYTES:  # including preamble and epilogue
        raise UploadRejectedError(
            422, f"the body has more than {MAX_OVERHEAD_BYTES} bytes outside the field {ARCHIVE_FIELD!r}"
        )
