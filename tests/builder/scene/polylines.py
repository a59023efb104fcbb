"""Distances, straight segments and hooks of bars, computed from their axis polylines. World frame, metres."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.model import Assembly
from dataset_builder.scene.shapes.bar_mesh import plain_outer_radius_m
from rebar_depth_bench.data.bars import Bar


def line_m(bar: Bar) -> Float64[ndarray, "n 3"]:
    return np.array(bar.axis_m)


def length_m(bar: Bar) -> float:
    return float(np.linalg.norm(np.diff(line_m(bar), axis=0), axis=1).sum())


def segment_distances_m(a: Float64[ndarray, "n 2 3"], b: Float64[ndarray, "m 2 3"]) -> Float64[ndarray, "n m"]:
    """Return the distances of all pairs of segments: at the stationary point if inside both, else at an end."""
    p, u = a[:, None, 0], (a[:, 1] - a[:, 0])[:, None]
    q, v = b[None, :, 0], (b[:, 1] - b[:, 0])[None]
    between = p - q
    uu, vv, uv = (u * u).sum(-1), (v * v).sum(-1), (u * v).sum(-1)
    up, vp = (u * between).sum(-1), (v * between).sum(-1)
    determinant = uu * vv - uv**2
    skew = determinant > 1e-12 * uu * vv  # For parallel segments, the minimum is reached at an end.
    determinant = np.where(skew, determinant, 1.0)
    s, t = (uv * vp - vv * up) / determinant, (uu * vp - uv * up) / determinant
    inside = skew & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
    crossing = np.where(inside, np.linalg.norm(between + s[..., None] * u - t[..., None] * v, axis=-1), np.inf)
    candidates = [crossing]
    for end in (0.0, 1.0):
        on_b = np.clip((vp + end * uv) / vv, 0, 1)
        candidates.append(np.linalg.norm(between + end * u - on_b[..., None] * v, axis=-1))
        on_a = np.clip((end * uv - up) / uu, 0, 1)
        candidates.append(np.linalg.norm(between + on_a[..., None] * u - end * v, axis=-1))
    return np.asarray(np.min(candidates, axis=0))


def least_gap_m(assembly: Assembly) -> float:
    """Return the smallest gap between two bars of the mesh, in metres; pairs with separate boxes are skipped."""
    lines = [line_m(bar) for bar in assembly.bars]
    segments = [np.stack([line[:-1], line[1:]], axis=1) for line in lines]
    radii = np.array([plain_outer_radius_m(bar.diameter_m) for bar in assembly.bars])
    low = np.array([line.min(axis=0) for line in lines]) - radii[:, None] - 0.005
    high = np.array([line.max(axis=0) for line in lines]) + radii[:, None] + 0.005
    gap_m = np.inf
    for i in range(len(lines)):
        overlaps = ((low[i] <= high[i + 1 :]) & (low[i + 1 :] <= high[i])).all(axis=1)
        near = i + 1 + np.flatnonzero(overlaps)
        if len(near):
            others = np.concatenate([segments[j] for j in near])
            other_radii = np.concatenate([np.full(len(segments[j]), radii[j]) for j in near])
            gap_m = min(gap_m, float((segment_distances_m(segments[i], others) - other_radii).min() - radii[i]))
    return gap_m


def straight_segments_m(bar: Bar) -> Float64[ndarray, "n 2 3"]:
    """Return the straight segments of a bar (over 50 mm; the chords of its arcs are millimetres long)."""
    line = line_m(bar)
    segments = np.stack([line[:-1], line[1:]], axis=1)
    return np.asarray(segments[np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1) > 0.05])


def turns_deg(bar: Bar) -> list[float]:
    """Return the angles between successive straight segments of a bar, degrees."""
    directions = np.diff(straight_segments_m(bar), axis=1)[:, 0]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return [
        round(float(angle), 6) for angle in np.rad2deg(np.arccos((directions[1:] * directions[:-1]).sum(axis=1)))
    ]


def hooks_m(bar: Bar) -> list[Float64[ndarray, "n 2"]]:
    """Return both hooks of a bar in plan: straight end, bend, and 0.3 m of the adjacent straight segment."""
    hooks = []
    for line in (line_m(bar)[:, :2], line_m(bar)[::-1, :2]):
        bend = line[: 2 + int(np.argmax(np.linalg.norm(np.diff(line[1:], axis=0), axis=1) > 0.05))]
        direction = line[len(bend)] - bend[-1]
        hooks.append(np.concatenate([bend, [bend[-1] + 0.3 * direction / np.linalg.norm(direction)]]))
    return hooks


def winding_deg(line: Float64[ndarray, "n 2"], centre: Float64[ndarray, " 2"]) -> float:
    """Return the angle that a plane polyline subtends at ``centre``, degrees."""
    x, y = (line - centre).T
    return float(np.rad2deg(abs(np.diff(np.unwrap(np.arctan2(y, x))).sum())))
