"""Tables of the files of other programs, for the page docs/formats.md.

python -m scripts.format_tables docs/formats.md

The tables are those by which the readers look up keys. They replace what is between the two marks of the page.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable
from itertools import groupby
from pathlib import Path

from dataset_builder.importing.view_cameras import BOP, NERFSTUDIO
from rebar_depth_bench.captures.calibration_files import ZED_CONF
from rebar_depth_bench.captures.fields import Field, FileFormat
from rebar_depth_bench.captures.program_formats import CAMERA, KALIBR, MIDDLEBURY, PAIR

FORMATS = (ZED_CONF, CAMERA, PAIR, KALIBR, MIDDLEBURY, BOP, NERFSTUDIO)
_BLOCK = re.compile(r"(<!-- tables of fields -->\n).*(<!-- end of tables of fields -->)", re.DOTALL)


def with_tables(page: str) -> str:
    """Return the text of a page with the tables between its marks. Raises ``ValueError`` if it has none."""
    if not _BLOCK.search(page):
        raise ValueError("the page has no marks of the tables of fields")
    tables = "\n\n".join(map(format_table, FORMATS))
    return _BLOCK.sub(lambda match: f"{match[1]}\n{tables}\n\n{match[2]}", page)


def format_table(file_format: FileFormat) -> str:
    """Return the heading and the table of a format; fields of the same use and meaning share a row."""
    lines = [f"### {file_format.title}", "", "| keys | use | meaning |", "|---|---|---|"]
    for (use, meaning), fields in groupby(file_format.fields, lambda field: (field.use, field.meaning)):
        lines.append(f"| {_keys(fields)} | {use} | {meaning} |")
    return "\n".join(lines)


def _keys(fields: Iterable[Field]) -> str:
    """Return the keys of fields as code, those of one section together."""
    sections: dict[str, list[str]] = {}
    for field in fields:
        for key in field.keys:
            section, _, name = key.rpartition(".")
            sections.setdefault(section, []).append(f"`{name}`")
    return "; ".join(
        f"`{section}`: {', '.join(names)}" if section else ", ".join(names) for section, names in sections.items()
    )


if __name__ == "__main__":
    path = Path(sys.argv[1])
    path.write_text(with_tables(path.read_text()))
