"""Camera trajectories of configs as the manifest describes them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field, Strict, ValidationInfo, field_validator

from rebar_depth_bench.data.manifest_table import ManifestTable
from rebar_depth_bench.validation import Expected, Triple, field_error, number, one_of, three_numbers, whole_number

CENTRE, NEAREST_STEEL = "centre", "nearest steel"
"""Values of ``Trajectory.distance_to``."""
SURVEY = "survey"
"""Kind of the trajectories that are a ``Survey``."""
RANDOM_VIEWS = "random views"
"""Kind of the trajectories that are ``RandomViews``."""
_Distance = Annotated[float, number(0)]
_Point = Annotated[Triple, three_numbers(-1e9, 1e9, "three numbers, [x, y, z]")]
_Station = Annotated[
    tuple[_Point, _Point], Strict(False), Expected("two points, of the left camera and of the steel aimed at")
]


class Trajectory(ManifestTable):
    """Cameras of a config: shells, rings of a shell, and azimuths of a ring.

    ``radii_m`` are distances from the left camera to ``distance_to``: the centre of the assembly, as in all
    folders without this key, or the nearest point of any bar's surface.
    """

    radii_m: Annotated[tuple[_Distance, ...], Strict(False), Field(min_length=1)] = (1.0,)
    elevations_deg: Annotated[tuple[float, ...], Strict(False), Field(min_length=1)] = (0.0,)
    azimuths: Annotated[int, whole_number(1, 1_000_000)]
    distance_to: Annotated[str, one_of(CENTRE, NEAREST_STEEL)] = CENTRE

    @property
    def views(self) -> int:
        """Number of views of the full trajectory."""
        return len(self.radii_m) * len(self.elevations_deg) * self.azimuths


class Survey(ManifestTable):
    """Cameras of a config that stand at the ``distances_m`` from points of the steel.

    ``stations`` are the centre of the left camera and the point aimed at of each view, world metres, in order.
    """

    distances_m: Annotated[tuple[_Distance, ...], Strict(False), Field(min_length=1)]
    views_per_distance: Annotated[int, whole_number(1, 1_000_000)]
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


def trajectory_of(fields: Any) -> Trajectory | Survey:
    """Return the trajectory of an entry of the manifest; raise ``ValidationError`` if it is not valid."""
    if isinstance(fields, Trajectory | Survey):
        return fields
    is_survey = isinstance(fields, Mapping) and fields.get("kind") == SURVEY
    return (Survey if is_survey else Trajectory).model_validate(fields)
