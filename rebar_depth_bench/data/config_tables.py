"""Tables of a config's entry in the manifest: scenes, rig, views, references, and how data were imported."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import ConfigDict, Field, Strict, StringConstraints, ValidationInfo, field_validator, model_validator

from rebar_depth_bench.data.columns import OPTIONAL_COLUMNS
from rebar_depth_bench.data.manifest_table import ManifestTable
from rebar_depth_bench.data.trajectory import AnyTrajectory, trajectory_of
from rebar_depth_bench.errors import escape_text
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.names import NAME_LETTERS, NAME_PATTERN, PATH_PATTERN, SPLITS, VIEW_ID_PATTERN
from rebar_depth_bench.validation import (
    Expected,
    StrictModel,
    Triple,
    check_unique,
    field_error,
    number,
    one_of,
    text,
    three_numbers,
    whole_number,
)

DIGEST_PATTERN = "sha256:[0-9a-f]{64}"
Name = Annotated[str, StringConstraints(pattern=f"^{NAME_PATTERN}$"), Expected(f"a name of {NAME_LETTERS}")]
RelativePath = Annotated[
    str,
    StringConstraints(pattern=f"^{PATH_PATTERN}$"),
    Expected(f"a path in the folder, whose parts are {NAME_LETTERS}"),
]
_ViewId = Annotated[str, StringConstraints(pattern=f"^{VIEW_ID_PATTERN}$")]
# Views have no ``Expected``, which is called from pydantic: a folder has thousands.
Sha256 = Annotated[str, StringConstraints(pattern="^[0-9a-f]{64}$")]
Digest = Annotated[str, StringConstraints(pattern=f"^{DIGEST_PATTERN}$"), Expected("sha256: and 64 hex digits")]
_Side = Annotated[int, whole_number(1, 16384)]
_Length = Annotated[float, number(0, 10)]
_Count = Annotated[int, Expected("a whole number from 0", lambda count: count >= 0)]
_Error = Annotated[float, Expected("a number from 0 to 1e+09", lambda error: 0 <= error <= 1e9)]
"""Error of a reference; it is 0 where a view has one scored pixel."""


class ViewRecord(StrictModel):
    """Manifest entry of one view.

    ``left`` and ``right`` are the hex SHA-256 digests of the cameras' ground truth; ``steel_px`` and ``scored_px``
    count steel and scored pixels. ``right`` is None in a config without depth of the right camera, ``steel_px``
    in one without masks.
    """

    view_id: _ViewId
    left: Sha256
    right: Sha256 | None
    steel_px: Annotated[int, Field(ge=0)] | None
    scored_px: Annotated[int, Field(ge=0)]


class ImageLight(ManifestTable):
    """Panorama that lights a scene, by the name of its image."""

    image: Annotated[str, text(200)]


class Appearance(ManifestTable):
    """Names of the appearance variants of a scene, and its panorama if it has one."""

    variants: Annotated[tuple[Name, ...], Strict(False)] = ()
    image_light: ImageLight | None = None


class Assembly(ManifestTable):
    """Steel of a scene: its kind, the file if it comes from one, and all other parameters as in the manifest."""

    model_config = ConfigDict(extra="allow")

    kind: Annotated[str, text(60)]
    path: Annotated[str, text(1000)] | None = None
    sha256: Annotated[str, text(64)] | None = None


class Colour(ManifestTable):
    """Samples per pixel of rendered colour, everywhere and around the steel; None in an imported config."""

    samples: _Count | None = None
    steel_samples: _Count | None = None


class _BoardTable(StrictModel):
    width_m: _Length
    height_m: _Length
    markers: Annotated[int, one_of(6, 12)]
    marker_side_m: _Length
    dictionary: Name


class Imported(ManifestTable):
    """How the data of a config were measured, if they were not rendered.

    ``truth_sigma_m`` is the standard deviation of the ground truth's depth, metres, as its authors state it.
    ``absent_columns`` are null in every row. Without ``has_poses``, the world frame of a view is its left camera.
    """

    truth_sigma_m: Annotated[float, number(1e-9, 10)]
    absent_columns: Annotated[tuple[str, ...], Strict(False)] = ()
    has_poses: bool = True
    description: Annotated[str, StringConstraints(max_length=1000)] = ""
    source: Annotated[str, StringConstraints(max_length=1000)] = ""
    licence: Annotated[str, StringConstraints(max_length=200)] = ""

    @field_validator("absent_columns")
    @classmethod
    def _check_absent(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        absent = set(names)
        if unknown := sorted(absent - set(OPTIONAL_COLUMNS)):
            raise field_error(f"got {escape_text(unknown[0])}", f"some of {', '.join(OPTIONAL_COLUMNS)}")
        for needed, columns in _NEEDED.items():
            if needed in absent and (present := sorted(columns - absent)):
                found = f"{needed} is absent and {present[0]} is not"
                raise field_error(found, f"{present[0]} to be absent as well", "conflict")
        return names


_NEEDED = {
    "left_mask": {"left_bars"},
    "right_mask": {"right_bars"},
    "right_depth": {"right_mask", "right_bars"},
    "right_K": {name for name in OPTIONAL_COLUMNS if name.startswith("right_") or name == "baseline_m"},
}
"""Columns that cannot be present without the column that is the key."""


class SceneRig(ManifestTable):
    """Optics of a scene: pixel grid, baseline in metres, and the camera by its name if it has one."""

    grid: Annotated[str, one_of("ideal", "raw", "rectified")]
    baseline_m: _Length
    camera: Annotated[str, StringConstraints(max_length=100)] = ""


class Scene(ManifestTable):
    """Scene of a config, with its cameras, its mesh and its shards, which hold the rows of no other scene.

    ``board`` is the ArUco board under the assembly, or None; ``protocol_views`` is the number of views of the full
    trajectory; ``aim_point_m`` is the point that its cameras aim at, world metres, if they share one; ``bytes`` is
    the size of the shards; ``key`` is the digest of all parameters. ``family`` is the kind of cage of a generated
    scene, otherwise None. ``assembly``, ``protocol``, ``rig`` and ``mesh`` are None in a config that was imported.
    ``entry`` is the scene as it was written, with all parameters of the build.
    """

    name: Name
    split: Annotated[str, one_of(*SPLITS)]
    family: Name | None = None
    assembly: Assembly | None = None
    board: BoardSpec | None
    environment: Annotated[str, StringConstraints(max_length=60)] = ""
    appearance: Appearance = Appearance()
    protocol: AnyTrajectory | None = None
    protocol_views: Annotated[int, whole_number(1, 1_000_000)]
    rig: SceneRig | None = None
    aim_point_m: Annotated[Triple, three_numbers(-1e9, 1e9, "three numbers, [x, y, z]")] | None = None
    key: Annotated[str, StringConstraints(max_length=200)]
    mesh: RelativePath | None
    shards: Annotated[tuple[RelativePath, ...], Strict(False)]
    bytes: _Count
    entry: dict[str, Any] = Field(repr=False)

    @model_validator(mode="before")
    @classmethod
    def _keep_entry(cls, values: Any) -> Any:
        return {**values, "entry": values} if isinstance(values, Mapping) else values

    @field_validator("board", mode="before")
    @classmethod
    def _make_board(cls, fields: Any) -> BoardSpec | None:
        return None if fields is None else BoardSpec(**_BoardTable.model_validate(fields).model_dump())

    @field_validator("protocol", mode="before")
    @classmethod
    def _make_protocol(cls, fields: Any) -> AnyTrajectory | None:
        return None if fields is None else trajectory_of(fields)

    @field_validator("protocol_views")
    @classmethod
    def _check_protocol_views(cls, protocol_views: int, info: ValidationInfo) -> int:
        trajectory = info.data.get("protocol")
        if trajectory is not None and protocol_views != trajectory.views:
            raise field_error(f"got {protocol_views}", f"the trajectory's {trajectory.views} views", "conflict")
        return protocol_views

    @field_validator("shards")
    @classmethod
    def _check_shards(cls, shards: tuple[str, ...]) -> tuple[str, ...]:
        check_unique(shards, "shard")
        return shards


class Rig(ManifestTable):
    """Image size of a stereo rig, pixels."""

    width: _Side
    height: _Side


class ReferenceRecord(ManifestTable):
    """AbsRel and RMSE (cm) of a reference, means over the views; None where undefined."""

    abs_rel: _Error | None
    rmse_cm: _Error | None


class References(ManifestTable):
    """Reference errors of a config, as in the tables of results."""

    constant: ReferenceRecord
    one_pixel: ReferenceRecord
