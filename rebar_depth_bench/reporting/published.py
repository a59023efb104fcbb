"""The paper's published numbers: data to show beside a result, never to rank with it.

Source: "Benchmarking Metric Depth for Construction Perception: Industrial Rebar Scenes with Exact Synthetic Ground
Truth", Tables I and II, sections III.A and III.C. The authors measured on renders and recordings of their own:
``PublishedPart.mark`` says so and goes wherever a number goes. Numbers stay strings, to print as published.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from rebar_depth_bench.errors import RebarDepthError

_FILE = "published.json"
_PARTS = {
    "synthetic": ("scenes",),
    "physical": ("references",),
    "kitti": ("figures",),
    "anchor": ("one_view_scale_within_percent", "rmse_cm_6_markers", "rmse_cm_12_markers"),
}
_PART_TEXTS = ("place", "protocol", "mark")
_NUMBER = re.compile(r"[0-9]+(\.[0-9]+)?")


@dataclass(frozen=True)
class PublishedRow:
    """A method's line in Table I or II, native beside oracle-scaled: RMSE in cm, AbsRel, AbsRel_s, median s.

    ``median_anchored``: its scale was taken from ground truth (the dagger of Table I).
    """

    method: str
    rmse_cm: str
    abs_rel: str
    abs_rel_scaled: str
    scale: str
    median_anchored: bool


@dataclass(frozen=True)
class PublishedScene:
    """One scene of Table I: its title and working distance there, its rows in the table's order."""

    title: str
    distance: str
    rows: tuple[PublishedRow, ...]


@dataclass(frozen=True)
class PublishedReference:
    """One pseudo-reference of Table II: the share of pixels it covers, its rows in the table's order."""

    coverage_percent: str
    rows: tuple[PublishedRow, ...]


@dataclass(frozen=True)
class PublishedKitti:
    """What the text of section III.A states of a method; None where it states nothing."""

    method: str
    abs_rel: str | None
    rmse_m: str | None
    delta1: str | None


@dataclass(frozen=True)
class PublishedAnchor:
    """Section III.C: how near one known-depth view brings COLMAP's scale to ArUco's, and RMSE by markers."""

    one_view_scale_within_percent: str
    rmse_cm_6_markers: str
    rmse_cm_12_markers: str


@dataclass(frozen=True)
class PublishedPart:
    """Where a part stands in the paper, what it was measured over, and the mark that goes with its numbers."""

    place: str
    protocol: str
    mark: str


@dataclass(frozen=True)
class Published:
    """Everything that ships.

    The keys of ``parts`` are ``synthetic`` (``scenes``, Table I), ``physical`` (``references``, Table II),
    ``kitti`` and ``anchor``.
    """

    title: str
    parts: Mapping[str, PublishedPart]
    scenes: Mapping[str, PublishedScene]
    references: Mapping[str, PublishedReference]
    kitti: tuple[PublishedKitti, ...]
    anchor: PublishedAnchor


_TABLE_I_CONFIGS: Mapping[str, str] = {"lattice": "lattice", "pile": "pile", "pier": "pier"}
"""Rings, other optics, sweeps, other looks and users' own cages are other pictures: no row is theirs."""


def load_published() -> Published:
    """Return the numbers that ship with the package."""
    return read_published(files("rebar_depth_bench.reporting").joinpath(_FILE).read_text(encoding="utf-8"))


def published_rows(scene: str) -> tuple[PublishedRow, ...]:
    """Return Table I's rows of ``lattice``, ``pile`` or ``pier`` in the paper's order; none of any other scene."""
    scenes = load_published().scenes
    return scenes[scene].rows if scene in scenes else ()


def paper_scene(config: str) -> str | None:
    """Return which scene of Table I a config shows under the paper's cameras, None if none of them."""
    return _TABLE_I_CONFIGS.get(config)


def read_published(text: str) -> Published:
    """Return what a ``published.json`` says.

    Raises ``RebarDepthError`` naming the place where a key is missing or one too many, or a number is none.
    """
    try:
        content = json.loads(text)
    except ValueError as error:
        raise RebarDepthError(f"{_FILE}: not JSON: {error}") from error
    whole = _object(content, _FILE, {"title", *_PARTS})
    synthetic, physical, kitti, anchor = (
        _object(whole[part], part, {*_PART_TEXTS, *keys}) for part, keys in _PARTS.items()
    )
    return Published(
        title=_text(whole, "title", _FILE),
        parts={part: PublishedPart(*(_text(whole[part], key, part) for key in _PART_TEXTS)) for part in _PARTS},
        scenes={name: _scene(one, name) for name, one in _named(synthetic, "scenes")},
        references={name: _reference(one, name) for name, one in _named(physical, "references")},
        kitti=tuple(_kitti(one) for one in _list(kitti, "figures", "kitti")),
        anchor=PublishedAnchor(**{key: _number(anchor, key, "anchor") for key in _PARTS["anchor"]}),
    )


def _scene(content: Any, name: str) -> PublishedScene:
    scene = _object(content, name, {"title", "distance", "rows"})
    rows = tuple(_row(one, name) for one in _list(scene, "rows", name))
    return PublishedScene(_text(scene, "title", name), _text(scene, "distance", name), rows)


def _reference(content: Any, name: str) -> PublishedReference:
    reference = _object(content, name, {"coverage_percent", "rows"})
    rows = tuple(_row(one, name) for one in _list(reference, "rows", name))
    return PublishedReference(_number(reference, "coverage_percent", name), rows)


def _row(content: Any, where: str) -> PublishedRow:
    numbers = {"rmse_cm", "abs_rel", "abs_rel_scaled", "scale"}
    row = _object(content, f"a row of {where}", {"method", *numbers}, {"median_anchored"})
    anchored = row.get("median_anchored", False)
    if not isinstance(anchored, bool):
        raise RebarDepthError(f"{_FILE}: median_anchored of {where} is {anchored!r}, expected true or false")
    method = _text(row, "method", where)
    values = {key: _number(row, key, f"{method}, {where}") for key in sorted(numbers)}
    return PublishedRow(method=method, median_anchored=anchored, **values)


def _kitti(content: Any) -> PublishedKitti:
    numbers = ("abs_rel", "rmse_m", "delta1")
    row = _object(content, "a figure of kitti", {"method"}, set(numbers))
    method = _text(row, "method", "kitti")
    return PublishedKitti(method, *(_number(row, key, method) if key in row else None for key in numbers))


def _object(content: Any, where: str, required: set[str], optional: set[str] | None = None) -> dict[str, Any]:
    if not isinstance(content, dict):
        raise RebarDepthError(f"{_FILE}: {where} is {type(content).__name__}, expected an object")
    wrong = sorted((required - content.keys()) | (content.keys() - required - (optional or set())))
    if wrong:
        found, expected = ", ".join(wrong), ", ".join(sorted(required))
        raise RebarDepthError(f"{_FILE}: {where}: keys missing or unknown: {found}; expected {expected}")
    return content


def _named(content: dict[str, Any], key: str) -> list[tuple[str, Any]]:
    if not isinstance(content[key], dict) or not content[key]:
        raise RebarDepthError(f"{_FILE}: {key} is {content[key]!r}, expected an object with entries")
    return list(content[key].items())


def _list(content: dict[str, Any], key: str, where: str) -> list[Any]:
    if not isinstance(content[key], list) or not content[key]:
        raise RebarDepthError(f"{_FILE}: {key} of {where} is {content[key]!r}, expected a list with entries")
    return list(content[key])


def _text(content: dict[str, Any], key: str, where: str) -> str:
    value = content[key]
    if not isinstance(value, str) or not value.strip():
        raise RebarDepthError(f"{_FILE}: {key} of {where} is {value!r}, expected text")
    return value


def _number(content: dict[str, Any], key: str, where: str) -> str:
    value = content[key]
    if not isinstance(value, str) or not _NUMBER.fullmatch(value):
        raise RebarDepthError(f"{_FILE}: {key} of {where} is {value!r}, expected a number in quotes")
    return value
