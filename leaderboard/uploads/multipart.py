"""A multipart upload, straight to disk: the archive never stands in memory, and no more of it than is allowed."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field
from pathlib import Path

from anyio import to_thread
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

FIELD = "archive"
MOST_FIELD = 1 << 10
"""Bytes of a text field that comes before the archive."""
BATCH = 1 << 20
"""Bytes that are written at once, off the event loop."""
MOST_ELSE = 64 << 10
"""Bytes of everything in the body that is not the archive's content."""


class UploadError(Exception):
    """An upload is refused: the HTTP status and the sentence that says why."""

    def __init__(self, status: int, detail: str) -> None:
        self.status, self.detail = status, detail
        super().__init__(detail)


@dataclass(frozen=True)
class Received:
    """An archive as it came: the file, its SHA-256 and its size in bytes."""

    path: Path
    sha256: str
    size: int


@dataclass
class _Parts:
    """The parser's callbacks for the parts' headers: ``name`` is the field at hand, ``number`` its place."""

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
class _Spool(_Parts):
    """What the parser's callbacks write to: the archive's bytes that are not yet on disk."""

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
        return self.name == FIELD.encode()

    def part_data(self, data: bytes, start: int, end: int) -> None:
        if self.is_archive:
            self.waiting.append(data[start:end])

    def end(self) -> None:
        self.complete = True


@dataclass
class _First(_Parts):
    """What the parser's callbacks write to while the body's first part is read: its text."""

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
        if not self.ended and len(self.text) <= MOST_FIELD:
            self.text += data[start:end]

    def part_end(self) -> None:
        self.ended = True


async def receive(stream: AsyncIterator[bytes], content_type: str, spool: Path, most: int) -> Received:
    """Write the field ``archive`` of a multipart body into a new file below ``spool``.

    Raises ``UploadError``, and leaves no file, for a body that is none (422) or an archive of more than ``most``
    bytes (413).
    """
    boundary = boundary_of(content_type)
    parts = _Spool()
    handle, name = tempfile.mkstemp(dir=spool, suffix=".upload")
    path, sha256, size, came = Path(name), hashlib.sha256(), 0, 0
    try:
        parser = MultipartParser(boundary, parts.callbacks())  # type: ignore[arg-type]
        with os.fdopen(handle, "wb") as file:

            def flush() -> int:
                batch = b"".join(parts.waiting)
                parts.waiting.clear()
                sha256.update(batch)
                return file.write(batch)

            async for chunk in stream:
                came += len(chunk)
                parser.write(chunk)
                waiting = sum(map(len, parts.waiting))
                _check(parts, came - size - waiting)
                if size + waiting > most:
                    raise UploadError(413, too_large(most))
                if waiting >= BATCH:
                    size += await to_thread.run_sync(flush)
            parser.finalize()
            size += await to_thread.run_sync(flush)
        if not parts.complete or not parts.archives:
            raise UploadError(
                422, f"the body ends early or has no field {FIELD!r}, expected one with the zip in it"
            )
        return Received(path, sha256.hexdigest(), size)
    except FormParserError as error:
        path.unlink(missing_ok=True)
        raise UploadError(422, f"the body is no multipart/form-data: {error}") from None
    except BaseException:
        path.unlink(missing_ok=True)
        raise


async def leading_field(
    stream: AsyncIterator[bytes], content_type: str, name: str
) -> tuple[str, AsyncIterator[bytes]]:
    """Return the text of a multipart body's first field, if that is ``name``, else "", and the whole body again.

    So that who uploads is known before anything is kept. Raises ``UploadError`` (422) for a body that is none.
    """
    first = _First()
    parser = MultipartParser(boundary_of(content_type), first.callbacks())  # type: ignore[arg-type]
    chunks: list[bytes] = []
    try:
        async for chunk in stream:
            chunks.append(chunk)
            parser.write(chunk)
            is_other = first.name not in (b"", name.encode())
            if first.ended or is_other or len(first.text) > MOST_FIELD or sum(map(len, chunks)) > MOST_ELSE:
                break
    except FormParserError as error:
        raise UploadError(422, f"the body is no multipart/form-data: {error}") from None
    told = first.ended and first.name == name.encode() and len(first.text) <= MOST_FIELD
    return (first.text.decode(errors="replace") if told else ""), _again(chunks, stream)


async def _again(chunks: list[bytes], stream: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    while chunks:
        yield chunks.pop(0)
    async for chunk in stream:
        yield chunk


def boundary_of(content_type: str) -> bytes:
    """Return the boundary of a multipart body; raise ``UploadError`` (422) for the type of another body."""
    kind, options = parse_options_header(content_type)
    boundary = options.get(b"boundary")
    if kind != b"multipart/form-data" or not boundary:
        raise UploadError(422, f"the body is {content_type or 'nothing'!r}, expected multipart/form-data")
    return boundary


def too_large(most: int) -> str:
    """Return the sentence that refuses an archive of more than ``most`` bytes."""
    return f"the archive is larger than {most} bytes, the most this service takes"


def _check(parts: _Spool, else_bytes: int) -> None:
    if parts.archives > 1:
        raise UploadError(422, f"the body has the field {FIELD!r} twice, expected once")
    if else_bytes > MOST_ELSE:  # what stands before the first part or after the last counts too
        raise UploadError(422, f"the body has more than {MOST_ELSE} bytes beside the field {FIELD!r}")
