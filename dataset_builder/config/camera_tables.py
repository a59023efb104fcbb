"""Schema of the table ``[cameras]`` of scene TOML files, by kind of trajectory."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated

from pydantic import AfterValidator, Strict, ValidationInfo

from dataset_builder.config.specs import DomeSpec, RigSpec, RingSpec, SurveySpec
from dataset_builder.scene.model import to_metres
from rebar_depth_bench.errors import Problem
from rebar_depth_bench.validation import (
    Expected,
    StrictModel,
    field_error,
    number,
    one_of,
    validate_table,
    whole_number,
)

MAX_VIEWS = 10_000
"""Maximum number of views of a config: the index in a view id has four digits."""
_MAX_AZIMUTHS = 3600


def _check_distance(distance: float, info: ValidationInfo[float]) -> float:
    """Check that a camera distance is at least the rig's baseline; ``info.context`` is the unit in metres."""
    distance_m = to_metres(distance, info.context)
    if distance_m < RigSpec.baseline_m:
        found = f"cameras are {distance_m:.4g} m from the aim point"
        expected = f"at least the rig's baseline, {RigSpec.baseline_m} m: is the unit right?"
        raise field_error(found, expected, "conflict")
    return distance


def list_of(expected: str, min_length: int = 1) -> Expected:
    """Return the description of lists of ``min_length`` to 10,000 elements."""
    return Expected(expected, lambda values: min_length <= len(values) <= 10_000)


_Distance = Annotated[float, number(0, expected="a distance above 0, up to 1e9"), AfterValidator(_check_distance)]
_Distances = Annotated[tuple[_Distance, ...], Strict(False), list_of("a list of distances")]
_Elevation = Annotated[float, number(0, 89, "degrees above 0, up to 89")]
_Azimuths = Annotated[int, whole_number(1, _MAX_AZIMUTHS)]


class CamerasTable(StrictModel, extra="ignore"):
    """Keys of the table ``[cameras]`` for all kinds."""

    kind: Annotated[str, one_of("dome", "ring", "survey")]


class DomeTable(CamerasTable, extra="forbid"):
    """Table ``[cameras]`` of a dome."""

    azimuths: _Azimuths
    radii: _Distances
    elevations_deg: Annotated[tuple[_Elevation, ...], Strict(False), list_of("a list of elevations in degrees")]

    def trajectory(self, unit_m: float) -> DomeSpec:
        """Return the trajectory in metres; ``unit_m`` is the file's unit."""
        radii_m = tuple(to_metres(radius, unit_m) for radius in self.radii)
        return DomeSpec(radii_m, self.elevations_deg, self.azimuths)


class RingTable(CamerasTable, extra="forbid"):
    """Table ``[cameras]`` of a ring."""

    azimuths: _Azimuths
    radius: _Distance
    elevation_deg: _Elevation

    def trajectory(self, unit_m: float) -> RingSpec:
        """Return the trajectory in metres; ``unit_m`` is the file's unit."""
        return RingSpec(to_metres(self.radius, unit_m), self.elevation_deg, self.azimuths)


class SurveyTable(CamerasTable, extra="forbid"):
    """Table ``[cameras]`` of a survey; ``distances`` None are those of ``SurveySpec``."""

    distances: _Distances | None = None
    views_per_distance: Annotated[int, whole_number(1, MAX_VIEWS)] = SurveySpec.views_per_distance
    seed: Annotated[int, whole_number(0, 2**31 - 1)] = SurveySpec.seed

    def trajectory(self, unit_m: float) -> SurveySpec:
        """Return the survey without its stations, in metres; ``unit_m`` is the file's unit."""
        distances_m = SurveySpec.distances_m
        if self.distances is not None:
            distances_m = tuple(to_metres(distance, unit_m) for distance in self.distances)
        return SurveySpec(distances_m, self.views_per_distance, self.seed)


AnyCamerasTable = DomeTable | RingTable | SurveyTable
_TABLES: Mapping[str, type[AnyCamerasTable]] = {"dome": DomeTable, "ring": RingTable, "survey": SurveyTable}


def read_cameras(values: object, unit_m: float, problems: list[Problem]) -> AnyCamerasTable | None:
    """Return the table ``[cameras]``, or None after adding its problems to ``problems``."""
    match values:
        case {"kind": str(kind)} if kind in _TABLES:
            return validate_table(_TABLES[kind], values, problems, "cameras", unit_m)
    validate_table(CamerasTable, values, problems, "cameras")
    return None


def camera_conflicts(values: object) -> Iterator[Problem]:
    """Yield the problems that concern several keys of ``[cameras]``; values that are invalid alone are ignored."""
    views = 0
    match values:
        case {"kind": "dome", "radii": [*radii], "elevations_deg": [*elevations], "azimuths": int(azimuths)}:
            views = len(radii) * len(elevations) * azimuths if azimuths <= _MAX_AZIMUTHS else 0
        case {"kind": "survey", **keys}:
            distances = keys.get("distances", SurveySpec.distances_m)
            per_distance = keys.get("views_per_distance", SurveySpec.views_per_distance)
            if isinstance(distances, list | tuple) and isinstance(per_distance, int) and per_distance <= MAX_VIEWS:
                views = len(distances) * per_distance
    if views > MAX_VIEWS:
        yield Problem("conflict", "cameras", f"{views} views requested", f"at most {MAX_VIEWS}")
