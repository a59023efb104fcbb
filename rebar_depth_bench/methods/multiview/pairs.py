"""Which pictures to match with which: those that, by the board's markers, are turned little against each other.

A lattice looks nearly the same after a quarter or half a turn. On 24 views of it, 512 x 288, opposite views match
with up to 74 inliers, where neighbours 15 degrees apart have 85 to 177: no count of inliers keeps them apart at
every size, and COLMAP registers views on the wrong side. Markers carry names, which steel does not.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.aruco import Corners, board_pose
from rebar_depth_bench.board import BoardSpec
from rebar_depth_bench.methods.multiview.similarity import rotation_deg

MOST_TURNED_DEG = 60.0


def plausible_pairs(
    markers: Mapping[str, Corners], board: BoardSpec, K: Float64[ndarray, "3 3"]
) -> list[tuple[str, str]]:
    """Return the pairs of pictures (pinhole, K in pixels) to match; a picture without markers goes with all."""
    poses = {name: board_pose(found, board, K) for name, found in markers.items()}
    kept = []
    for one, other in combinations(sorted(markers), 2):
        first, second = poses[one], poses[other]
        if first is None or second is None or rotation_deg(second[:3, :3] @ first[:3, :3].T) <= MOST_TURNED_DEG:
            kept.append((one, other))
    return kept
