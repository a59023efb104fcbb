"""Camera trajectories of configs as the manifest describes them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field, Strict, ValidationInfo, field_validator

from rebar_depth_bench.data.manifest_table import ManifestTable
from rebar_depth_bench.validation import (
    Expected,
    Triple,
    field_error,
    number,
    one_of,
    short_repr,
    three_numbers,
    whole_number,
)

CENTRE, NEAREST_STEEL = "centre", "nearest steel"
"""Values of ``Trajectory.distance_to``."""
SURVEY = "survey"
"""Kind of the trajectories that are a ``Survey``."""
RANDOM_VIEWS = "random views"
"""Kind of the trajectories that are ``RandomViews``."""
_SHELLS = ("dome", "ring", "sweep")
"""Kinds of the trajectories that are a ``Trajectory``."""
_Views = Annotated[int, whole_number(1, 1_000_000)]
_Distances = Annotated[tuple[Annotated[float, number(0)], ...], Strict(False), Field(min_length=1)]
_Point = Annotated[Triple, three_numbers(-1e9, 1e9, "three numbers, [x, y, z]")]
_Station = Annotated[
    tuple[_Point, _Point], Strict(False), Expected("two points, of the left camera and of the steel aimed at")
]


class Trajectory(ManifestTable):
    """Cameras of a config: shells, rings of a shell, and azimuths of a ring.

    ``radii_m`` are distances from the left camera to ``distance_to``: the centre of the assembly, or the nearest
    point of any bar's surface. A ring has ``radius_m`` instead.
    """

    kind: Annotated[str, one_of(*_SHELLS)] = "dome"
    radii_m: _Distances = (1.0,)
    radius_m: Annotated[float, number(0)] | None = None
    elevations_deg: Annotated[tuple[float, ...], Strict(False), Field(min_length=1)] = (0.0,)
    azimuths: _Views
    distance_to: Annotated[str, one_of(CENTRE, NEAREST_STEEL)] = CENTRE

    @property
    def distances_m(self) -> tuple[float, ...]:
        """Distances of the shells, metres."""
        return self.radii_m if self.radius_m is None else (self.radius_m,)

    @property
    def views(self) -> int:
        """Number of views of the full trajectory."""
        return len(self.radii_m) * len(self.elevations_deg) * self.azimuths


class Survey(ManifestTable):
    """Cameras of a config that stand at the ``distances_m`` from points of the steel.

    ``stations`` are the centre of the left camera and the point aimed at of each view, world metres, in order.
    """

    kind: Annotated[str, one_of(SURVEY)] = SURVEY
    distances_m: _Distances
    views_per_distance: _Views
    stations: Annotated[tuple[_Station, ...], Strict(False)]

    @field_validator("stations")
    @classmethod
    def _check_stations(cls, stations: tuple[_Station, ...], info: ValidationInfo) -> tuple[_Station, ...]:
        if {"distances_m", "views_per_distance"} <= info.data.keys():
            views = len(info.data["distances_m"]) * info.data["views_per_distance"]
            if len(stations) != views:
                raise field_error(f"got {len(stations)} stations", f"{views}: one for each view", "conflict")
        return stations

    @property
    def views(self) -> int:
        """Number of views of the full trajectory."""
        return len(self.stations)


class RandomViews(ManifestTable):
    """Cameras of a config that stand at distances between the two ``distances_m`` from points of the steel."""

    kind: Annotated[str, one_of(RANDOM_VIEWS)] = RANDOM_VIEWS
    distances_m: _Distances
    views: _Views


AnyTrajectory = Trajectory | Survey | RandomViews
_BY_KIND: Mapping[str, type[AnyTrajectory]] = {
    **dict.fromkeys(_SHELLS, Trajectory),
    SURVEY: Survey,
    RANDOM_VIEWS: RandomViews,
}


def trajectory_of(fields: Any) -> AnyTrajectory:
    """Return the trajectory of a scene in the manifest; raise the error of a field if it is not valid."""
    if isinstance(fields, AnyTrajectory):
        return fields
    kind = fields.get("kind") if isinstance(fields, Mapping) else None
    if not isinstance(kind, str) or kind not in _BY_KIND:
        raise field_error(f"got {short_repr(fields)}", f"a table whose kind is one of {', '.join(_BY_KIND)}")
    return _BY_KIND[kind].model_validate(fields)
