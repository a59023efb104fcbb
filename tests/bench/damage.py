"""Seeded damage of files at byte, line and value level."""

from __future__ import annotations

import random
import re

_TOKEN = re.compile(rb'"[^"\n]*"|[-+.\w]+')
_VALUES = (
    *(b"nan", b"inf", b"-inf", b"1e999", b"-1", b"0", b"1e-320", b"1e308", b"7_0", b"0x10", b"true", b"null", b""),
    *(b"9" * 4400, b"[" * 3000, b"{}", b"[]", b"[1, 2]", b'{"a": 1, "a": 2}', b'"\\ud800"', b'"\\u001b[2J"'),
    *(b"\x1b[2J", b"\x9b", b"../../x", b"/etc/passwd", b'"x"', b"'", b"=", b"#", b"\0", b"\xff\xfe", b"\r"),
    *(b"." * 300, b"a." * 3000, b"[link=x]", "\N{ARABIC-INDIC DIGIT SEVEN}".encode(), b"x" * 100_000),
)


def damaged(content: bytes, rng: random.Random) -> bytes:
    """Return the content with one to three random changes."""
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        content = rng.choice((_change_bytes, _change_bytes, _change_lines, _change_value, _change_value))(
            content, rng
        )
    return content


def _change_bytes(content: bytes, rng: random.Random) -> bytes:
    start = rng.randrange(len(content) + 1)
    end = min(len(content), start + rng.choice((1, 1, 2, 4, 8, 100)))
    middle = content[start:end]
    changes = (
        bytes(byte ^ (1 << rng.randrange(8)) for byte in middle),
        rng.choice((b"\0", b"\xff", b"\x7f", b"\x80")) * len(middle),
        rng.randbytes(len(middle)),
        rng.randbytes(rng.choice((1, 4, 100))) + middle,
        middle * 2,
        b"",
    )
    if rng.random() < 0.1:
        return content[:start]
    return content[:start] + rng.choice(changes) + content[end:]


def _change_lines(content: bytes, rng: random.Random) -> bytes:
    lines = content.splitlines(keepends=True) or [b""]
    first, second = rng.randrange(len(lines)), rng.randrange(len(lines))
    line = lines[first]
    if rng.random() < 0.3:
        del lines[first]
    lines.insert(second, rng.choice((line, line.upper(), line.lower(), b"  " + line)))
    return b"".join(lines)


def _change_value(content: bytes, rng: random.Random) -> bytes:
    token = rng.choice(list(_TOKEN.finditer(content)) or list(re.finditer(b"", content)))
    return content[: token.start()] + rng.choice(_VALUES) + content[token.end() :]
