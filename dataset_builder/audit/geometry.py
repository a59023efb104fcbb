"""Checks against known geometry: bar axes, the board at z = 0, planes of formwork, specs of generated cages.

No reference depends on the ray caster that produced the depth. The distance from an axis is computed here on its
own (``polyline_distance_m``), on purpose not by the functions that place cameras and make meshes: errors of theirs
would not show.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt16
from numpy import ndarray

from dataset_builder.audit.checks import AuditedConfig, AuditedView, Check
from dataset_builder.cameras.camera_placement import RANDOM_RULES
from dataset_builder.scene.mesh_ply import read_mesh_ply
from dataset_builder.scene.shapes.bar_mesh import outer_radius_m
from dataset_builder.scene.shapes.capsules import Clearances
from dataset_builder.specs.config_specs import CAGES_VERSION, RandomViewsSpec
from dataset_builder.specs.manifest_specs import cage_spec, trajectory_spec
from dataset_builder.user_files.make_assembly import assembly_bars
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.data.manifest import DatasetConfig

MAX_AXIS_RATIO = 1.2
"""Largest distance of a rib's surface from the bar axis, in nominal radii."""
MAX_BOARD_ERROR_M = 1e-6
"""Largest distance of a visible board point from z = 0, metres."""
_MAX_BEND_TURN_DEG = 15.0
"""Largest turn between two chords of one bend, degrees; a larger turn is a sharp corner."""
_CHUNK = 4096
_BOARD_EDGE_MARGIN_M = 0.001
_ON_BOARD_TOLERANCE_M = 1e-4
_MAX_OCCLUDED_SHARE = 0.5
_IN_PLANE_M = 1e-5
"""Largest distance of a face's corners from a plane of formwork."""
_AXIS_TOLERANCE_M = 1e-9
"""Largest difference of a coordinate from that of the generator, which differs by this much between machines."""


@dataclass(frozen=True)
class BoardError:
    """Distances from z = 0 of the non-steel pixels whose points lie over the board's rectangle.

    ``pixels`` is their number, ``off_m`` the largest distance, ``below_m`` the largest distance below the plane,
    ``near_m`` the largest distance among the points within 0.1 mm of the plane, and ``off_plane`` the number of
    points farther away.
    """

    pixels: int = 0
    off_m: float = 0.0
    below_m: float = 0.0
    near_m: float = 0.0
    off_plane: int = 0


def max_axis_distance_ratio(config: AuditedConfig, view: AuditedView) -> float:
    """Return the largest distance of a steel pixel of both eyes from its bar's axis, in nominal radii.

    It is 1 on the lateral surface up to the height of the ribs, and less on an end cap. The sagitta of a bend's
    chords is subtracted, so that the same bound holds for every bar. Bars without a known axis are left out.
    """
    ratios = [
        float(((distance_m - bend_sagitta_m(np.array(bar.axis_m))) / (bar.diameter_m / 2)).max())
        for eye in view.eyes.values()
        for bar, distance_m in axis_distances_m(eye.points_m, eye.bars, config.bars_with_known_axis)
    ]
    return float(np.max(ratios, initial=0.0))


def axis_distances_m(
    points_m: Float64[ndarray, "*n 3"], bar_ids: UInt16[ndarray, "*n"], bars: Iterable[Bar]
) -> Iterator[tuple[Bar, Float64[ndarray, " m"]]]:
    """Yield each of the bars that occurs in ``bar_ids``, and the distances of its points from its axis, metres."""
    on_bar = bar_ids > 0
    points_m, bar_ids = points_m[on_bar], bar_ids[on_bar]
    found = set(np.unique(bar_ids).tolist())
    for bar in bars:
        if bar.bar_id in found:
            yield bar, polyline_distance_m(points_m[bar_ids == bar.bar_id], np.array(bar.axis_m))


def bend_sagitta_m(axis_m: Float64[ndarray, "k 3"]) -> float:
    """Return the largest distance between a polyline's chords and the arcs they approximate, metres.

    Chords of length c that meet at the angle a approximate an arc of sagitta c/2 tan(a/4). The shorter of the two
    segments is taken as the chord, because straight legs are longer. Corners of 15 degrees or more are not arcs.
    The result is 0 for a straight bar.
    """
    chords = np.diff(axis_m, axis=0)
    lengths = np.linalg.norm(chords, axis=1)
    if len(lengths) < 2:
        return 0.0
    directions = chords / lengths[:, None]
    turn_rad = np.arccos(np.clip((directions[:-1] * directions[1:]).sum(axis=1), -1.0, 1.0))
    sagitta_m = np.minimum(lengths[:-1], lengths[1:]) / 2 * np.tan(turn_rad / 4)
    return float(sagitta_m[turn_rad < np.deg2rad(_MAX_BEND_TURN_DEG)].max(initial=0.0))


def polyline_distance_m(
    points_m: Float64[ndarray, "n 3"], axis_m: Float64[ndarray, "k 3"]
) -> Float64[ndarray, " n"]:
    """Return the distance of each point from a polyline, ends included, metres.

    Squared distances are expanded so that matrix products compute them. Coordinates are relative to the polyline's
    first vertex, which keeps the cancellation of the expansion negligible.
    """
    start_m, along = axis_m[:-1] - axis_m[0], np.diff(axis_m, axis=0)
    length_square = (along * along).sum(axis=1)
    start_along = (start_m * along).sum(axis=1)
    distances_m = [np.zeros(0)]
    for first in range(0, len(points_m), _CHUNK):
        chunk_m = points_m[first : first + _CHUNK] - axis_m[0]
        from_start = (
            chunk_m @ along.T - start_along
        )  # (p - a) . d for each point p and each segment of start a and vector d
        squared_distance = (chunk_m * chunk_m).sum(axis=1, keepdims=True) - 2 * chunk_m @ start_m.T
        squared_distance += (start_m * start_m).sum(axis=1)
        fraction = np.clip(from_start / length_square, 0.0, 1.0)
        squared_distance += fraction * (fraction * length_square - 2 * from_start)
        distances_m.append(np.sqrt(np.maximum(squared_distance.min(axis=1), 0.0)))
    return np.concatenate(distances_m)


def axis_verdict(config: AuditedConfig, ratios: Sequence[float]) -> Check:
    """Return the check of the largest axis distance of all views; bars with estimated axes are left out."""
    name, largest = "steel distance from the bar axis", max(ratios, default=0.0)
    measured = f"at most {largest:.3f} radii"
    if not config.bars_with_known_axis:
        return Check.skip(name, "the bar axes are estimated")
    problem = f"a steel pixel is {largest:.3f} nominal radii away from its bar's axis"
    return Check(name, measured, f"{MAX_AXIS_RATIO} radii", (problem,) if largest > MAX_AXIS_RATIO else ())


def board_error(config: AuditedConfig, view: AuditedView) -> BoardError:
    """Return the board error of both eyes of a view, all zeros for a scene without a board.

    A margin of 1 mm inside the rectangle's edge is left out, because the sheet has sides.
    """
    if config.board is None:
        return BoardError()
    half_m = np.array([config.board.width_m, config.board.height_m]) / 2 - _BOARD_EDGE_MARGIN_M
    heights_m = []
    for eye in view.eyes.values():
        inside = (np.abs(eye.points_m[..., :2]) < half_m).all(axis=-1)
        heights_m.append(eye.points_m[inside & ~eye.mask & (eye.depth_m > 0)][:, 2])
    board_z_m = np.concatenate(heights_m)
    off_m = np.abs(board_z_m)
    on_board = off_m < _ON_BOARD_TOLERANCE_M
    return BoardError(
        pixels=len(board_z_m),
        off_m=float(off_m.max(initial=0.0)),
        below_m=float((-board_z_m).max(initial=0.0)),
        near_m=float(off_m[on_board].max(initial=0.0)),
        off_plane=int(np.count_nonzero(~on_board)),
    )


def board_verdict(config: AuditedConfig, errors: Sequence[BoardError]) -> Check:
    """Return the check of the board's points against z = 0.

    Props of a scene may stand on the board. In such a scene no point may lie below the plane, at least half of the
    points must lie within 0.1 mm of it, and those must lie on it within ``MAX_BOARD_ERROR_M``.
    """
    name = "board at z = 0"
    if config.board is None:
        return Check.skip(name, "no board in this scene")
    pixels = sum(error.pixels for error in errors)
    if not pixels:
        return Check.skip(name, "no view sees the board")
    bound = f"{MAX_BOARD_ERROR_M * 1e6:g} um"
    if not config.has_props:
        off_m = max(error.off_m for error in errors)
        return Check(name, f"at most {off_m * 1e6:.3f} um", bound, tuple(_plane_problems(off_m)))
    share, near_m = sum(error.off_plane for error in errors) / pixels, max(error.near_m for error in errors)
    measured = f"at most {near_m * 1e6:.3f} um, {share:.1%} occluded by objects on the board"
    problems = [*_plane_problems(max(near_m, *(error.below_m for error in errors)))]
    if share > _MAX_OCCLUDED_SHARE:
        problems.append(
            f"{share:.1%} of the board's pixels are occluded, expected less than {_MAX_OCCLUDED_SHARE:.0%}"
        )
    return Check(name, measured, bound, tuple(problems))


def _plane_problems(off_m: float) -> Iterator[str]:
    if off_m > MAX_BOARD_ERROR_M:
        yield f"a board pixel is {off_m * 1e6:.3f} um away from z = 0"


def planes_check(scene: DatasetConfig, mesh: Path) -> Check:
    """Return the check that a face of the stored mesh, not of steel, lies in each plane of formwork of a scene."""
    name, planes = "planes of formwork", scene.scene.planes
    if not planes:
        return Check.skip(name, "no planes in this scene")
    stored = read_mesh_ply(mesh)
    corners_m = stored.vertices_m[stored.faces[stored.face_bar_id == 0]]
    normals = np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0])
    problems = []
    for plane in planes:
        off_m = np.abs((corners_m - plane.point_m) @ plane.normal).max(axis=1)
        if not ((off_m <= _IN_PLANE_M) & (normals @ plane.normal > 0)).any():
            problems.append(f"no face of the mesh lies in plane {plane.name}")
    return Check(name, f"{len(planes)} planes", f"faces within {_IN_PLANE_M * 1e6:g} um", tuple(problems))


def cage_checks(scene: DatasetConfig, bars: Sequence[Bar]) -> Iterator[Check]:
    """Yield the checks of one generated scene that need no images; ``bars`` are those of ``bars.parquet``."""
    yield _bars_check(scene, bars)
    yield _gap_check(bars)
    yield _steel_check(scene)
    yield _clearance_check(scene, bars)


def _bars_check(scene: DatasetConfig, bars: Sequence[Bar]) -> Check:
    """Return the check of the bars against those that the generator makes from the parameters in the manifest."""
    name = "bars and their designs"
    spec = cage_spec(scene)
    if spec.version != CAGES_VERSION:
        return Check.skip(name, f"made by version {spec.version} of the generator, this is {CAGES_VERSION}")
    expected = assembly_bars(spec)
    if [_identity(bar) for bar in bars] != [_identity(bar) for bar in expected]:
        problem = f"{len(bars)} bars differ from the {len(expected)} of the generator in number, role or diameter"
        return Check(name, "other bars", "those of the generator", (problem,))
    off_m = max(
        float(np.abs(np.subtract(getattr(bar, line), getattr(wanted, line))).max(initial=0.0))
        for bar, wanted in zip(bars, expected, strict=True)
        for line in ("axis_m", "nominal_axis_m")
    )
    problems = () if off_m <= _AXIS_TOLERANCE_M else (f"axes are {off_m:.2e} m off those of the generator",)
    return Check(name, f"{len(bars)} bars: at most {off_m:.1e} m off", f"{_AXIS_TOLERANCE_M:g} m", problems)


def _identity(bar: Bar) -> tuple[int, str, float, int, int]:
    return bar.bar_id, bar.role, bar.diameter_m, len(bar.axis_m), len(bar.nominal_axis_m)


def _gap_check(bars: Sequence[Bar]) -> Check:
    """Return the check that no two bars touch, ribs included."""
    lines, radii = [np.array(bar.axis_m) for bar in bars], [outer_radius_m(bar.diameter_m) for bar in bars]
    clearances = Clearances(lines, radii)
    least_m = min(
        clearances.least_m(line, radius, i) for i, (line, radius) in enumerate(zip(lines, radii, strict=True))
    )
    problems = () if least_m > 0 else (f"two bars penetrate each other by {-least_m * 1000:.2f} mm",)
    return Check("gaps of bars", f"{least_m * 1000:.2f} mm or more", "above 0 mm", problems)


def _steel_check(scene: DatasetConfig) -> Check:
    """Return the check that every view shows steel in its left image, as the manifest counts it."""
    without = [view.view_id for view in scene.views if not view.steel_px]
    least = min((view.steel_px or 0) for view in scene.views) / (scene.rig.width * scene.rig.height)
    problems = tuple(f"{view_id} shows no steel" for view_id in without)
    return Check("steel in every view", f"{least:.1%} of the frame or more", "above 0", problems)


def _clearance_check(scene: DatasetConfig, bars: Sequence[Bar]) -> Check:
    """Return the check that the left cameras of random views are clear of all bars."""
    name, views = "cameras clear of steel", trajectory_spec(scene)
    if not isinstance(views, RandomViewsSpec):
        return Check.skip(name, "no random views")
    centres_m = np.array([centre_m for centre_m, *_ in views.stations])
    nearest_m = min(
        float((polyline_distance_m(centres_m, np.array(bar.axis_m)) - outer_radius_m(bar.diameter_m)).min())
        for bar in bars
    )
    bound_m = RANDOM_RULES.clearance_m(views.distances_m[0])
    problems = () if nearest_m >= bound_m else (f"a camera is {nearest_m:.3f} m from steel",)
    return Check(name, f"{nearest_m:.2f} m or more", f"{bound_m:g} m", problems)
