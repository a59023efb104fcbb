"""Similarities between point sets, and angles of rotations: what lays a reconstruction on metres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray


@dataclass(frozen=True, eq=False)
class Similarity:
    """``x -> scale * rotation @ x + translation``."""

    scale: float
    rotation: Float64[ndarray, "3 3"]
    translation: Float64[ndarray, " 3"]

    def points(self, source: Float64[ndarray, "*n 3"]) -> Float64[ndarray, "*n 3"]:
        """Apply it to points."""
        return np.asarray(self.scale * source @ self.rotation.T + self.translation)


def similarity(source: Float64[ndarray, "n 3"], target: Float64[ndarray, "n 3"]) -> Similarity:
    """Return the similarity with ``target ~ scale * rotation @ source + translation``, in least squares.

    For three or more points that are not on one line; those of a plane are fine: of the two rotations and mirrors
    that fit them equally the rotation is taken.
    Source: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991.
    """
    source_middle, target_middle = source.mean(axis=0), target.mean(axis=0)
    centred = source - source_middle
    u, singular, vt = np.linalg.svd((target - target_middle).T @ centred)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u @ np.diag(signs) @ vt
    scale = float(singular @ signs / np.sum(centred**2))
    return Similarity(scale, rotation, target_middle - scale * rotation @ source_middle)


def rotation_deg(rotation: Float64[ndarray, "3 3"]) -> float:
    """Return the angle of a rotation, degrees."""
    skew = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    return float(np.degrees(np.arctan2(np.linalg.norm(skew), np.trace(rotation) - 1)))
