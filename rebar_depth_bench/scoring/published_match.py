"""Conditions of the paper's Table I: which configs of a dataset its rows may be shown beside.

Source: "Benchmarking Metric Depth for Construction Perception: Industrial Rebar Scenes with Exact Synthetic Ground
Truth", sections II.A and II.C. The lattice was evaluated on the views of a ZED, rectified.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.data.schema import NEAREST_STEEL, Assembly, Trajectory

_GRID = (720, 1280)
_IDEAL = ("ideal", 0.12)
_ZED_RECTIFIED = ("rectified", 0.119978)


@dataclass(frozen=True)
class PublishedMatch:
    """Scene of Table I that a config shows; ``same_optics`` is False if nothing but the optics differs."""

    scene: str
    same_optics: bool

    def to_dict(self) -> dict[str, Any]:
        """Return the match as a JSON-compatible object."""
        return {"scene": self.scene, "same_optics": self.same_optics}


@dataclass(frozen=True)
class _Conditions:
    """Conditions of a scene; ``optics`` are grid and baseline in metres, ``markers`` are those of the board."""

    assembly: Mapping[str, Any]
    markers: int
    environment: str
    trajectory: Trajectory
    optics: tuple[str, float]


_CONDITIONS: Mapping[str, _Conditions] = {
    "lattice": _Conditions(
        {"kind": "lattice", "extent_m": 0.1, "pitch_m": 0.02, "diameters_m": [0.007, 0.004]},
        6,
        "laboratory",
        Trajectory(
            radii_m=(0.22, 0.3, 0.35, 0.38, 0.4, 0.42, 0.43),
            elevations_deg=(15.0, 27.0, 39.0, 51.0, 63.0, 75.0),
            azimuths=12,
        ),
        _ZED_RECTIFIED,
    ),
    "pile": _Conditions(
        {"kind": "pile", "stirrups": 6, "diameter_m": 0.01, "size_m": [0.28, 0.2], "state": "pile-0"},
        6,
        "laboratory",
        Trajectory(
            radii_m=(0.5, 0.57, 0.59, 0.62, 0.65, 0.67, 0.9),
            elevations_deg=(28.0, 37.0, 46.0, 55.0, 64.0, 73.0),
            azimuths=12,
        ),
        _IDEAL,
    ),
    "pier": _Conditions(
        {
            "kind": "pier",
            "side_m": 4.8,
            "height_m": 6.67,
            "verticals": 96,
            "levels": 45,
            "vertical_diameter_m": 0.032,
            "hoop_diameter_m": 0.016,
            "tie_diameter_m": 0.016,
        },
        0,
        "outdoors",
        Trajectory(
            radii_m=(8.0, 11.0, 13.0, 14.5, 15.5, 16.25, 17.0),
            elevations_deg=(-7.5, -1.0, 7.0, 17.0, 29.0, 44.0),
            azimuths=12,
            distance_to=NEAREST_STEEL,
        ),
        _IDEAL,
    ),
}


def published_match(config: DatasetConfig) -> PublishedMatch | None:
    """Return the scene of Table I whose rows may be shown beside a config, or None.

    Assembly, board, environment, image size and trajectory have to be equal, with all of its views and without
    appearance variants.
    """
    is_complete = len(config.views) == config.scenes[0].protocol_views and config.grid == _GRID
    if config.imported is not None or config.has_splits or not is_complete or config.scene.appearance.variants:
        return None
    scene = config.scene
    markers = scene.board.markers if scene.board else 0
    shown = (scene.assembly, markers, scene.environment, scene.protocol)
    for name, expected in _CONDITIONS.items():
        assembly = Assembly.model_validate(expected.assembly)
        if shown == (assembly, expected.markers, expected.environment, expected.trajectory):
            optics = None if scene.rig is None else (scene.rig.grid, scene.rig.baseline_m)
            return PublishedMatch(name, optics == expected.optics)
    return None
