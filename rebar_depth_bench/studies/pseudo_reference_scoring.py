"""Every method against every reference, view by view: what the study of pseudo-references counts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import permutations

from jaxtyping import Float
from numpy import ndarray

from rebar_depth_bench.progress import Progress, silent
from rebar_depth_bench.streaming import ordered_map
from rebar_depth_bench.studies.depth_source import DepthSource
from rebar_depth_bench.studies.full_frame import (
    Agreement,
    DepthRange,
    FrameScore,
    agreement,
    frame_score,
    has_depth,
    no_depth,
    only_on,
    reference_pixels,
    usable,
)
from rebar_depth_bench.submission import EntryError

EXACT = "exact"
Map = Float[ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class FrameView:
    """A view to score: its id, (H, W), and its exact depth in metres where there is any truth."""

    view_id: str
    shape: tuple[int, int]
    exact_m: Map | None = None


@dataclass(frozen=True)
class FrameOutcome:
    """One view: (method, reference) scores, the share of the frame that each reference covers, and how two agree.

    ``problems`` are (label of the source, sentence): then there is nothing else.
    """

    scores: Mapping[tuple[str, str], FrameScore] = field(default_factory=dict)
    shares: Mapping[str, float] = field(default_factory=dict)
    agreements: Mapping[tuple[str, str], Agreement] = field(default_factory=dict)
    problems: tuple[tuple[str, str], ...] = ()


def exact_on(reference: str) -> str:
    """Return the name of the exact depth restricted to the pixels of a pseudo-reference."""
    return f"{EXACT} where {reference} has depth"


def score_views(
    views: Iterable[FrameView],
    total: int,
    methods: Mapping[str, DepthSource],
    references: Mapping[str, DepthSource],
    allowed: DepthRange,
    workers: int | None = None,
    progress: Progress = silent,
) -> list[FrameOutcome]:
    """Score ``total`` views on ``workers`` threads; a few views are in memory at a time."""
    outcomes = []
    done = ordered_map(lambda view: score_one(view, methods, references, allowed), views, workers)
    for count, outcome in enumerate(done, start=1):
        outcomes.append(outcome)
        progress("scoring the full frame", count, total)
    return outcomes


def score_one(
    view: FrameView,
    methods: Mapping[str, DepthSource],
    references: Mapping[str, DepthSource],
    allowed: DepthRange,
) -> FrameOutcome:
    """Score one view of every method against every reference, and against the exact depth if there is any."""
    problems: list[tuple[str, str]] = []
    predictions = {name: _read(name, source, view, allowed, problems) for name, source in methods.items()}
    read = {name: _read(name, source, view, allowed, problems) for name, source in references.items()}
    pseudo = {name: no_depth(view.shape) if depth_m is None else depth_m for name, depth_m in read.items()}
    if problems:
        return FrameOutcome(problems=tuple(problems))
    maps = {**pseudo, **_exact_maps(view, pseudo, allowed)}
    scores, shares = {}, {}
    for name, reference_m in maps.items():
        truth = reference_pixels(view.view_id, reference_m)
        shares[name] = float(has_depth(reference_m).mean())
        for method, prediction_m in predictions.items():
            scores[method, name] = frame_score(view.view_id, view.shape, truth, prediction_m)
    compared = [*pseudo, *([EXACT] if EXACT in maps else [])]
    pairs = [(one, other) for one, other in permutations(compared, 2) if one != EXACT]
    return FrameOutcome(scores, shares, {pair: agreement(maps[pair[0]], maps[pair[1]]) for pair in pairs})


def _exact_maps(view: FrameView, pseudo: Mapping[str, Map], allowed: DepthRange) -> dict[str, Map]:
    """Return the exact depth, whole and on each pseudo-reference's pixels; nothing where there is no truth.

    The restricted ones tell the two effects of a pseudo-reference apart: other pixels, and wrong depth on them.
    """
    if view.exact_m is None:
        return {}
    exact_m = usable(view.exact_m, allowed)
    return {EXACT: exact_m} | {exact_on(name): only_on(exact_m, has_depth(one)) for name, one in pseudo.items()}


def _read(
    name: str, source: DepthSource, view: FrameView, allowed: DepthRange, problems: list[tuple[str, str]]
) -> Map | None:
    """Return a source's usable map of a view, None where it has none or what it has is refused."""
    if view.view_id not in source.view_ids:
        return None
    try:
        return usable(source.read(view.view_id), allowed)
    except EntryError as error:
        problems.append((name, error.problem))
        return None
