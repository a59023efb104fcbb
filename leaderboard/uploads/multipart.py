"""Multipart form of an upload, read as a stream: its token and its archive."""

from __future__ import annotations

from collections.abc import AsyncIterator

from multipart import MultipartError, MultipartSegment, PushMultipartParser, parse_options_header

from leaderboard.refusals import RefusedError

ARCHIVE_FIELD, TOKEN_FIELD = "archive", "token"
MAX_FIELD_BYTES = 1 << 10
"""Maximum size in bytes of a text field."""
MAX_OVERHEAD_BYTES = 64 << 10
"""Maximum size in bytes of everything in the body except the content of the archive."""


class UploadForm:
    """Reader of a form whose field ``archive`` is consumed as a stream.

    Raises ``RefusedError`` (422) for a body that is not valid multipart, lacks the field, has it twice or
    has too much else.
    """

    def __init__(self, body: AsyncIterator[bytes], content_type: str) -> None:
        self._body, self._overhead = body, 0
        self._events = self._parse(_boundary_of(content_type))
        self._archives = 0

    async def token(self) -> str:
        """Return the text of the field ``token`` if it comes before the archive, otherwise ""."""
        text = bytearray()
        async for name, content in self._events:
            if name == ARCHIVE_FIELD:
                break
            text += content if name == TOKEN_FIELD else b""
        return text.decode(errors="replace") if len(text) <= MAX_FIELD_BYTES else ""

    async def archive(self) -> AsyncIterator[bytes]:
        """Yield the content of the field ``archive``."""
        async for name, content in self._events:
            if name == ARCHIVE_FIELD and content:
                yield content
        if not self._archives:
            raise RefusedError(422, f"the body has no field {ARCHIVE_FIELD!r}, expected a zip file in it")

    async def _parse(self, boundary: str) -> AsyncIterator[tuple[str, bytes]]:
        """Yield the name of a field and its content in parts, of which the first is empty."""
        name = ""
        try:
            with PushMultipartParser(boundary) as parser:
                async for chunk in self._body:
                    self._overhead += len(chunk)
                    for event in parser.parse(chunk):
                        if isinstance(event, MultipartSegment):
                            name = event.name or ""
                            self._archives += name == ARCHIVE_FIELD
                            yield name, b""
                        elif event:
                            self._overhead -= len(event) if name == ARCHIVE_FIELD else 0
                            yield name, bytes(event)
                    self._check()
        except MultipartError as error:
            raise RefusedError(422, f"the body is not valid multipart/form-data: {error}") from None

    def _check(self) -> None:
        if self._archives > 1:
            raise RefusedError(422, f"the body has the field {ARCHIVE_FIELD!r} twice, expected once")
        if self._overhead > MAX_OVERHEAD_BYTES:  # Including preamble and epilogue.
            raise RefusedError(
                422, f"the body has more than {MAX_OVERHEAD_BYTES} bytes outside the field {ARCHIVE_FIELD!r}"
            )


def _boundary_of(content_type: str) -> str:
    kind, options = parse_options_header(content_type)
    boundary = options.get("boundary")
    if kind != "multipart/form-data" or not boundary:
        raise RefusedError(
            422, f"the content type is {content_type!r}, expected multipart/form-data with a boundary"
        )
    return str(boundary)
