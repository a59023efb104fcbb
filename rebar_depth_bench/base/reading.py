"""Reading of files from outside: regular files within a size limit, strict JSON and TOML, and random access.

Symbolic links to regular files are followed, since a snapshot of the Hub consists of links; pipes, devices and
folders are refused without blocking.
"""

from __future__ import annotations

import codecs
import errno
import hashlib
import json
import math
import os
import re
import shutil
import stat
import tomllib
import weakref
from collections import Counter
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO, NoReturn

from rebar_depth_bench.base.errors import InputError, Problem, ProblemCode, escape_text
from rebar_depth_bench.base.limits import Limit
from rebar_depth_bench.base.names import NAME_LETTERS, PATH_PATTERN
from rebar_depth_bench.base.system import READ_FLAGS, read_range

MAX_NESTING = 64
"""Largest number of JSON or TOML containers inside each other."""
_TOO_DEEP = ("the values are nested too deep", f"at most {MAX_NESTING} levels")
_MAX_KEY_COST = 10_000_000
"""Largest sum over the lines of a TOML file of the squared number of dots; tomllib needs about 10 ns for each."""
_DECIMAL_NUMBER = re.compile(rb"(?<![\w.\"'-])[-+]?\d+\.\d+(?=[\s,\]}eE]|$)")
_NUMBER = re.compile(r"[-+]?([0-9]++(\.[0-9]*+)?|\.[0-9]++)([eE][-+]?[0-9]++)?")
LFS_POINTER = "it is a pointer of git LFS, not the file itself (git lfs pull downloads it)"
"""What was found in place of a file that ``is_lfs_pointer``."""
_LFS_PREFIX = b"version https://git-lfs.github.com/spec/v1"
_KINDS = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a named pipe", stat.S_IFSOCK: "a socket"}


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file, or a link to one, for reading in binary mode.

    Raises ``OSError``, whose ``strerror`` can be shown to users, for anything else, and for a pointer of git LFS.
    """
    try:
        descriptor = os.open(path, READ_FLAGS)
    except ValueError as error:  # The path contains a null character.
        raise OSError(errno.EINVAL, str(error)) from None
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        found = _KINDS.get(stat.S_IFMT(mode), "a device")
        raise OSError(errno.EINVAL, f"it is {found}, not a regular file", str(path))
    stream = os.fdopen(descriptor, "rb")
    head = stream.read(len(_LFS_PREFIX))
    stream.seek(0)
    if is_lfs_pointer(head):
        stream.close()
        raise OSError(errno.EINVAL, LFS_POINTER, str(path))
    return stream


def is_lfs_pointer(content: bytes | memoryview) -> bool:
    """Return whether the content of a file begins as the text that git LFS stores in its place."""
    return content[: len(_LFS_PREFIX)] == _LFS_PREFIX


def read_file(path: Path, limit: Limit, expected: str, error_type: type[InputError]) -> bytes:
    """Return the content of a regular file that is ``expected``, for example "a TOML file".

    Raises ``error_type`` if the file cannot be read or has more bytes than ``limit``.
    """
    max_bytes = limit.value()
    try:
        with open_regular(path) as stream:
            size = os.fstat(stream.fileno()).st_size
            # A larger file is not read at all; the buffer of ``read`` is as large as its argument.
            content = b"" if size > max_bytes else stream.read(size)
    except OSError as error:
        code: ProblemCode = "missing" if isinstance(error, FileNotFoundError) else "unreadable"
        problem = Problem(code, "", f"cannot be read: {error.strerror or error}", expected)
        raise error_type.from_problems(path, [problem]) from None
    if size > max_bytes:
        problem = Problem("size", "", "the file is too large", f"{expected} of {limit.allowed('bytes')}")
        raise error_type.from_problems(path, [problem])
    return content


def decode_text(content: bytes, where: str = "") -> tuple[str, list[Problem]]:
    """Return a UTF-8 text without its byte order mark, or an empty text and the problem at ``where``."""
    try:
        return content.decode("utf-8-sig"), []
    except UnicodeDecodeError as error:
        is_utf16 = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        found = "the text is UTF-16" if is_utf16 else f"byte {error.start} is not UTF-8"
        return "", [Problem("syntax", where, found, "UTF-8 text")]


def parse_json(content: bytes, where: str = "") -> tuple[Any, list[Problem]]:
    """Return the value of a JSON text, or None and its problem.

    Stricter than ``json``: the text is UTF-8, no object has a key twice, numbers are finite, strings can be
    encoded, and at most ``MAX_NESTING`` containers are inside each other. ``where`` is the location in problems.
    """
    text, problems = decode_text(content, where)
    if problems:
        return None, problems
    try:
        value = json.loads(text, object_pairs_hook=_unique_keys, parse_constant=_refuse_constant)
        # json.loads accepts numbers like 1e999 and lone surrogates, which cannot be written as JSON again.
        json.dumps(value, allow_nan=False, ensure_ascii=False).encode()
        _check_nesting(value)
    except RecursionError:
        return None, [Problem("size", where, *_TOO_DEEP)]
    except KeyError as error:
        found = f"the key {escape_text(error.args[0])} occurs twice"
        return None, [Problem("duplicate", where, found, "each key once")]
    except ValueError as error:
        # Of a number with too many digits, json says after the semicolon how a programmer raises the limit.
        found = f"the text is not valid JSON ({escape_text(str(error).partition(';')[0])})"
        return None, [Problem("syntax", where, found, "JSON")]
    return value, []


def parse_toml(content: bytes) -> tuple[dict[str, Any], list[Problem]]:
    """Return the content of a TOML file, or an empty table and the problem of the content."""
    lines = _DECIMAL_NUMBER.sub(b"", content).splitlines()
    if sum(line.count(b".") ** 2 for line in lines) > _MAX_KEY_COST:
        return {}, [Problem("size", "", "the keys have too many parts", "a few parts")]
    text, problems = decode_text(content)
    if problems:
        return {}, problems
    try:
        values = tomllib.loads(text)
        _check_nesting(values)
    except RecursionError:
        return {}, [Problem("size", "", *_TOO_DEEP)]
    except ValueError as error:
        return {}, [Problem("syntax", "", f"not a valid TOML file: {escape_text(str(error))}")]
    return values, []


def parse_number(text: str) -> float:
    """Return a decimal number such as ``-1.5e-3``; NaN for any other text, infinity on overflow.

    Stricter than ``float``, which also reads ``1_0``, ``nan`` and digits of other scripts.
    """
    return float(text) if _NUMBER.fullmatch(text) else math.nan


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the object of some pairs. Raises ``KeyError`` with a key that occurs twice."""
    table = dict(pairs)
    if len(table) < len(pairs):
        [(duplicate, _)] = Counter(key for key, _ in pairs).most_common(1)
        raise KeyError(duplicate)
    return table


def _refuse_constant(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not JSON")


def _check_nesting(value: object, levels: int = MAX_NESTING) -> None:
    """Raise ``RecursionError`` if more than ``levels`` containers are inside each other."""
    if isinstance(value, dict | list):
        if levels == 0:
            raise RecursionError
        for child in value.values() if isinstance(value, dict) else value:
            _check_nesting(child, levels - 1)


def path_below(folder: Path, name: str) -> Path:
    """Return the path of ``name``, one or more names joined by ``/``, below ``folder``.

    Raises ``InputError`` for any other text, such as an absolute path or one with ``..``.
    """
    if not re.fullmatch(PATH_PATTERN, name):
        raise InputError(
            f"{folder}: {escape_text(name)} is not a path in this folder, expected names of {NAME_LETTERS}"
        )
    return folder / name


def is_below(path: str) -> bool:
    """Return whether a relative path from a file stays in its folder: it names no other files of the machine."""
    parts = PurePosixPath(path).parts
    return bool(parts) and path.isprintable() and ".." not in parts and not path.startswith(("/", "~"))


def check_no_links(folder: Path, *names: str) -> None:
    """Raise ``InputError`` if one of ``names`` below ``folder``, or a folder on the way to it, is a symbolic link.

    ``folder`` itself may be a link: the user named it.
    """
    for name in names:
        path = folder
        for part in Path(name).parts:
            path = path / part
            if path.is_symlink():
                raise InputError(
                    f"{path}: is a symbolic link, expected a file or folder (links are not followed here)"
                )


def remove_file(path: Path) -> None:
    """Delete a regular file; links, folders and missing files are left alone."""
    if path.is_file() and not path.is_symlink():
        path.unlink(missing_ok=True)


def remove_folder(path: Path) -> None:
    """Delete a folder with its content, without following links; a link or a missing folder is left alone."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)


# Sources of bytes that are read at positions, by several threads at once: files and memory.


class FileSource:
    """Byte source of a regular file. Raises ``OSError`` for a pipe, device or folder."""

    def __init__(self, path: Path) -> None:
        with open_regular(path) as stream:
            self._fd = os.dup(stream.fileno())
        self._close = weakref.finalize(self, os.close, self._fd)
        self.size = os.fstat(self._fd).st_size

    def read_at(self, offset: int, length: int) -> memoryview:
        """Return exactly ``length`` bytes, or raise ``EOFError`` if the file holds fewer."""
        if offset < 0 or length < 0 or offset + length > self.size:
            raise EOFError(f"{length} bytes at {offset} lie past the end of the file")
        data = read_range(self._fd, offset, length)
        if len(data) < length:
            raise EOFError(f"{len(data)} bytes found at {offset}, expected {length}")
        return memoryview(data)

    def sha256(self) -> str:
        """Return the hex SHA-256 of the whole file."""
        with os.fdopen(os.dup(self._fd), "rb") as stream:
            stream.seek(0)
            return hashlib.file_digest(stream, "sha256").hexdigest()

    def close(self) -> None:
        """Close the file; a second call has no effect."""
        self._close()
        self._fd = -1


class MemorySource:
    """Byte source of data in memory."""

    def __init__(self, data: memoryview) -> None:
        self._data = data
        self.size = len(data)

    def read_at(self, offset: int, length: int) -> memoryview:
        """Return exactly ``length`` bytes, or raise ``EOFError`` if the data have fewer."""
        if offset < 0 or length < 0 or offset + length > self.size:
            raise EOFError(f"{length} bytes at {offset} lie outside the data")
        return self._data[offset : offset + length]


ByteSource = FileSource | MemorySource
