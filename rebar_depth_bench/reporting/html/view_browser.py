"""View browser of the report: selection, order and contents of the views shown with images."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter

from rebar_depth_bench.errors import InputError, printable
from rebar_depth_bench.names import config_of
from rebar_depth_bench.reporting.html.rows import ScoreRow, view_row
from rebar_depth_bench.reporting.html.view_images import ViewImages, ViewPanels, view_images
from rebar_depth_bench.scoring.table import ViewScore

VIEWS_SHOWN = 12
"""Default number of views of a config shown with images, about 150 kB each at 1280 x 720."""


@dataclass(frozen=True)
class ShownView:
    """View shown with images: its numbers, images and the texts of their colour bars.

    ``error`` is its rank error, ``label`` the text of its thumbnail.
    """

    view_id: str
    error: float
    config: str
    label: str
    row: ScoreRow
    images: ViewImages
    near: str
    far: str
    predicted: str
    off_scale: bool
    native_limit: str
    scaled_limit: str


@dataclass(frozen=True)
class ShownCount:
    """Number of a config's views that are shown, and of all its views."""

    config: str
    shown: int
    views: int

    @property
    def partly(self) -> bool:
        """Whether some of the views are not shown."""
        return self.shown < self.views


def views_to_show(views: Sequence[ViewScore], count: int) -> list[ViewScore]:
    """Return ``count`` views, worst first: half are the worst, the rest evenly spaced from there to the best.

    All views are returned if there are at most ``count``. A view without a value counts as worst. Raises
    ``InputError`` if ``count`` is negative.
    """
    if count < 0:
        raise InputError(f"views to show: {count}, expected 0 or more of each config")
    worst_first = sorted(views, key=attrgetter("rank_error"), reverse=True)
    if len(worst_first) <= count:
        return worst_first
    worst = (count + 1) // 2
    rest, spread = worst_first[worst:], count - worst
    return worst_first[:worst] + [rest[(n + 1) * len(rest) // spread - 1] for n in range(spread)]


def sorted_views(views: Iterable[ShownView], configs: Sequence[str]) -> list[ShownView]:
    """Return encoded views in the order of ``configs``, the worst view of each config first."""
    rank = {config: number for number, config in enumerate(configs)}
    return sorted(
        views, key=lambda view: (rank.get(config_of(view.view_id), len(rank)), -view.error, view.view_id)
    )


def shown_counts(shown: Sequence[ShownView], views: Mapping[str, int]) -> list[ShownCount]:
    """Return the counts of every config with shown views; ``views`` holds the number of views by config."""
    shown_configs = [view.config for view in shown]
    counts = [
        ShownCount(printable(name), shown_configs.count(printable(name)), total) for name, total in views.items()
    ]
    return [count for count in counts if count.shown]


def shown_view(view: ViewPanels) -> ShownView:
    """Return the encoded images of a view with its numbers and the texts of the colour bars."""
    images = view_images(view)
    predicted = images.predicted_m
    row = view_row(view.score)
    return ShownView(
        view_id=view.view_id,
        error=view.score.rank_error,
        config=printable(config_of(view.view_id)),
        label=f"{row.name}\n{row.native[0].text}",
        row=row,
        images=images,
        near=_metres(images.near_m),
        far=_metres(images.far_m),
        predicted=f"{_metres(predicted[0])} to {_metres(predicted[1])}" if predicted else "",
        off_scale=predicted is not None and (predicted[0] > images.far_m or predicted[1] < images.near_m),
        native_limit=_centimetres(images.native_limit_cm),
        scaled_limit=_centimetres(images.scaled_limit_cm),
    )


def _metres(value: float) -> str:
    return f"{value:#.3g} m" if 0.01 <= abs(value) < 1000 else f"{value:.3g} m"


def _centimetres(value: float | None) -> str:
    return "" if value is None else f"{value:g} cm"
