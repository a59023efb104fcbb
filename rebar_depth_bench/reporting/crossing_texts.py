"""Texts on the crossings of bars: the reach of a method in words, and what the fits take from the ground truth."""

from __future__ import annotations

from rebar_depth_bench.extended.reach import MIN_CROSSINGS, MIN_REACH_VIEWS, SHARE, Reach
from rebar_depth_bench.scoring.columns import DASH

FITS_NOTE = (
    "The fits take from the ground truth which pixels show which bar, the radius of each bar, and each pixel's "
    "position along the bar. A method that has to find the bars itself can only be worse."
)

REACH_NOTE = (
    f"Bins by the true depth of the tie point. A bin is tested if it has {MIN_CROSSINGS} judged crossings or more "
    f"from {MIN_REACH_VIEWS} views or more; what is not located fails."
)


def reach_text(reach: Reach) -> str:
    """Return a reach in a few words, such as ``at least 0.4 m``."""
    if reach.verdict == "none tested":
        return "none tested"
    if reach.verdict == "not met":
        return f"not met from {reach.bins_tested[0].low_m:g} m on"
    return f"{reach.verdict} {reach.distance_m:g} m"


def reach_interval_text(reach: Reach) -> str:
    """Return the 95 % interval of a reach; its lower end is 0 where no bin is met."""
    return DASH if reach.interval is None else f"{reach.interval[0]:g} to {reach.interval[1]:g}"


def tested_text(reach: Reach) -> str:
    """Return the range of the tested bins that follow each other, metres."""
    return DASH if reach.tested_m is None else f"{reach.tested_m[0]:g} to {reach.tested_m[1]:g}"


def reach_sentence(alignment: str, reach: Reach) -> str:
    """Return the reach under one alignment as a sentence."""
    head = f"{alignment.capitalize()}: {100 * SHARE:g} % of the judged crossings within {reach.limit_mm} mm"
    if reach.verdict == "none tested":
        return f"{head}: none tested."
    informative = reach.interval is not None and reach.interval[0] < reach.interval[1]
    interval = f"95 % interval {reach_interval_text(reach)} m; " if informative else ""
    return f"{head} {reach_text(reach)} ({interval}tested {tested_text(reach)} m)."
