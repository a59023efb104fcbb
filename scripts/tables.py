"""Tables of the documentation that list what the code declares: settings, limits, options, columns and formats.

python -m scripts.tables

A page has a table between the marks ``<!-- table: NAME -->`` and ``<!-- end of table -->``, where NAME is a key of
``TABLES``. The command writes the tables of all ``PAGES``.
"""

from __future__ import annotations

import re
from argparse import ArgumentParser, _SubParsersAction
from collections.abc import Callable, Iterable, Iterator, Mapping
from math import atan2, degrees
from pathlib import Path

from pydantic import ByteSize

from cards.dataset import column_rows
from dataset_builder.cli.main import argument_parser
from dataset_builder.scene.variants.registry import VARIANTS
from dataset_builder.specs.config_specs import STEREO_CAMERAS
from leaderboard.settings import Settings
from rebar_depth_bench.base import limits
from rebar_depth_bench.captures.calibration_files import ZED_SIZES
from rebar_depth_bench.captures.programs import KEYS
from rebar_depth_bench.geometry.cameras import NOMINAL_WIDTH

ROOT = Path(__file__).parents[1]
PAGES = (
    ROOT / "SECURITY.md",
    *(ROOT / "docs" / f"{name}.md" for name in ("build", "cages", "formats", "leaderboard-operator")),
)
_BLOCK = re.compile(r"(<!-- table: ([\w-]+) -->\n).*?(<!-- end of table -->)", re.DOTALL)


def with_tables(page: str) -> str:
    """Return the text of a page with its tables. Raises ``KeyError`` for a mark with an unknown name."""
    return _BLOCK.sub(lambda block: f"{block[1]}\n{TABLES[block[2]]()}\n\n{block[3]}", page)


def _table(header: str, rows: Iterable[Iterable[str]]) -> str:
    """Return a table; ``header`` has the titles of the columns, separated by bars."""
    lines = [f"| {header} |", "|---" * (header.count("|") + 1) + "|"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])


def _settings() -> str:
    """Return the settings of the leaderboard with their defaults."""
    rows = (
        (f"`{name}`", "" if field.is_required() else _setting(field.default), field.description or "")
        for name, field in Settings.model_fields.items()
    )
    return _table("setting | default | description", rows)


def _setting(value: object) -> str:
    """Return the value of a setting as its users write it; empty for empty text."""
    if isinstance(value, ByteSize):
        text = _size(value)
    elif isinstance(value, bool):
        text = str(value).lower()
    else:
        text = f"{value:g}" if isinstance(value, float) else str(value)
    return text and f"`{text}`"


def _limits() -> str:
    """Return the limits that environment variables replace."""
    known = [limit for limit in vars(limits).values() if isinstance(limit, limits.Limit)]
    rows = [(f"`{limit.variable}`", _default(limit), limit.description) for limit in known]
    return _table("variable | default | limits", rows)


def _default(limit: limits.Limit) -> str:
    unit = limit.name.rpartition("_")[2]
    return _size(limit.default) if unit == "bytes" else f"{limit.default:,} {unit}"


def _size(size: int) -> str:
    """Return a whole number of bytes in the largest unit of which it is a multiple: ``64 MiB``."""
    power = max(power for power in range(4 if size else 1) if size % (1 << (10 * power)) == 0)
    return f"{size >> (10 * power)} {('B', 'KiB', 'MiB', 'GiB')[power]}"


def _build_options() -> str:
    """Return the options of ``rebar-build build`` as its help lists them."""
    [commands] = [one for one in argument_parser()._actions if isinstance(one, _SubParsersAction)]
    return _table("option | description", _options(commands.choices["build"]))


def _options(parser: ArgumentParser) -> Iterator[tuple[str, str]]:
    for action in parser._actions:
        if action.dest != "help":
            value = action.metavar or ("|".join(action.choices) if action.choices else action.dest.upper())
            usage = action.option_strings[0] + (f" {value}" if action.nargs != 0 else "")
            usage += " ..." if action.nargs == "+" else ""
            text = (action.help or "") % vars(action)
            yield f"`{usage}`".replace("|", "\\|"), re.sub("--[a-z-]+", r"`\g<0>`", text)


def _variants() -> str:
    """Return the appearance variants of scenes."""
    rows = ((f"`{variant.name}`", variant.description) for variant in VARIANTS.values())
    return _table("variant | what it does", rows)


def _rigs() -> str:
    """Return the named stereo cameras."""
    rows = (
        (
            f'`"{name}"`',
            f"{rig.baseline_m:.3f} m",
            f"{rig.width} x {rig.height}",
            f"{2 * degrees(atan2(NOMINAL_WIDTH / 2, rig.focal_px)):.1f} degrees",
        )
        for name, rig in STEREO_CAMERAS.items()
    )
    return _table("camera | baseline | pixels | horizontal field of view", rows)


def _columns() -> str:
    """Return the columns of a dataset, as the dataset card lists them."""
    rows = ((row["names"], row["type"], row["meaning"]) for row in column_rows())
    return _table("columns | type | meaning", rows)


def _calibration_keys() -> str:
    """Return the known keys of files of OpenCV and ROS."""
    return _table("field | keys", ((field, _code(keys)) for field, keys in KEYS.items()))


def _zed_sizes() -> str:
    """Return the image sizes of Stereolabs cameras."""
    rows = ((f"`{name}`", f"{width} x {height}") for name, (width, height) in ZED_SIZES.items())
    return _table("X | pixels", rows)


def _code(names: Iterable[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


TABLES: Mapping[str, Callable[[], str]] = {
    "settings": _settings,
    "limits": _limits,
    "build-options": _build_options,
    "variants": _variants,
    "rigs": _rigs,
    "columns": _columns,
    "zed-sizes": _zed_sizes,
    "calibration-keys": _calibration_keys,
}
"""Functions of the tables by their names in the marks."""


if __name__ == "__main__":
    for path in PAGES:
        path.write_text(with_tables(path.read_text()))
