"""Schema of a dataset: columns of its rows, and entries of its manifest on scenes, cameras, views and sources."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import reduce
from itertools import cycle
from typing import TYPE_CHECKING, Annotated, Any, Self

import pyarrow as pa
from pydantic import (
    AliasPath,
    BeforeValidator,
    ConfigDict,
    Field,
    Strict,
    StringConstraints,
    ValidationInfo,
    field_validator,
    model_validator,
)

from rebar_depth_bench.base.errors import DatasetError, escape_text
from rebar_depth_bench.base.names import NAME_LETTERS, NAME_PATTERN, PATH_PATTERN, SPLITS, VIEW_ID_PATTERN
from rebar_depth_bench.base.validation import (
    Expected,
    StrictModel,
    Triple,
    check_unique,
    field_error,
    number,
    one_of,
    short_repr,
    text,
    three_numbers,
    whole_number,
)
from rebar_depth_bench.geometry.aruco_board import BoardSpec

if TYPE_CHECKING:
    from datasets import Features


EYES = ("left", "right")
CAMERA_SHAPES: Mapping[str, tuple[int, ...]] = {"K": (3, 3), "distortion": (5,), "cam_from_world": (4, 4)}
"""Shapes of the arrays that describe a camera, by kind of column (see ``column_kind``)."""
COLUMNS = (
    "view_id",
    "scene",
    *(f"{eye}_rgb" for eye in EYES),
    "left_preview",  # Before depth, which the viewer of the Hub shows as bytes.
    *(f"{eye}_{kind}" for kind in ("depth", "mask", "bars") for eye in EYES),
    *(f"{eye}_{kind}" for kind in CAMERA_SHAPES for eye in EYES),
    "baseline_m",
)
"""Names of the columns, in order."""
OPTIONAL_COLUMNS = (
    *("left_rgb", "left_mask", "left_bars"),
    *(name for name in COLUMNS if name.startswith("right_") or name == "baseline_m"),
)
"""Columns that may be null in every row of an imported config; K, distortion and pose are NaN instead of null."""


def features() -> Features:
    """Return the ``datasets`` features of the shards' rows, in column order."""
    from datasets import Features, Image  # Takes a second to import, which scoring does not need.

    stored = Features.from_arrow_schema(ROW_SCHEMA)
    return Features(
        {name: Image() if ROW_SCHEMA.field(name).type == _IMAGE_CELL else stored[name] for name in COLUMNS}
    )


COLUMN_DESCRIPTIONS: dict[str, str] = {
    "view_id": "`<config>/<0000>`: the view's index in its full protocol, also when a subset is built; "
    "`<config>/<split>-<scene>-<0000>` in configs of several scenes",
    "scene": "name of the scene, as in `bars.parquet` and `meshes/`",
    "rgb": "lossless 8-bit colour, H x W, WebP; null in every row of a config built without colour",
    "preview": "8-bit colour-mapped depth, for people and the Hub viewer",
    "depth": "lossless float32 planar depth along the optical axis, metres, 0.0 where there is no surface; "
    'TIFF, which `Image(mode="F")` of `datasets` reads too',
    "mask": "1-bit: steel, rim included",
    "bars": "16-bit: the bar's id as in `bars.parquet`, 0 where no steel",
    "K": "3 x 3 pinhole matrix, pixels; pixel centres at integer coordinates",
    "distortion": "k1 k2 p1 p2 k3 (OpenCV), zeros where the grid has none",
    "cam_from_world": "4 x 4 rigid pose: `x_cam = cam_from_world @ x_world`; OpenCV axes, metres",
    "baseline_m": "metres between the two camera centres; along the left one's x axis except on a raw grid",
}
"""Description of each column, by column kind (see ``column_kind``); shown in the dataset card."""


def column_kind(name: str) -> str:
    """Return the kind of a column: its name without the prefix ``left_`` or ``right_``."""
    eye, _, kind = name.partition("_")
    return kind if eye in EYES else name


_IMAGE_CELL = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
_ARROW_TYPES: Mapping[str, pa.DataType] = {
    **dict.fromkeys(("view_id", "scene"), pa.string()),
    **dict.fromkeys(("rgb", "mask", "bars", "preview"), _IMAGE_CELL),
    "depth": pa.binary(),
    **{kind: reduce(pa.list_, reversed(shape), pa.float64()) for kind, shape in CAMERA_SHAPES.items()},
    "baseline_m": pa.float64(),
}
ROW_SCHEMA = pa.schema([(name, _ARROW_TYPES[column_kind(name)]) for name in COLUMNS])
"""Arrow schema of ``features``, without its metadata."""


def validated_columns(columns: Sequence[str] | None) -> tuple[str, ...]:
    """Return the names of columns as a tuple, all of them for None. Raises ``DatasetError`` for unknown names."""
    if columns is None:
        return COLUMNS
    if isinstance(columns, str) or not isinstance(columns, Iterable):
        raise DatasetError(f"columns is {columns!r}, expected a list of column names")
    names = tuple(columns)
    if unknown := [name for name in names if name not in COLUMNS]:
        raise DatasetError(f"no column {', '.join(map(repr, unknown))}, expected some of {', '.join(COLUMNS)}")
    return names


class ManifestTable(StrictModel):
    """Base class of objects in the manifest that may contain further keys, which are ignored."""

    model_config = ConfigDict(extra="ignore")


CENTRE, NEAREST_STEEL = "centre", "nearest steel"
"""Values of ``Trajectory.distance_to``."""
SURVEY = "survey"
"""Kind of a ``Survey``."""
RANDOM_VIEWS = "random views"
"""Kind of ``RandomViews``."""
POSES = "poses"
"""Kind of ``GivenPoses``."""
_SHELLS = ("dome", "ring", "sweep")
"""Kinds of a ``Trajectory``."""
_Views = Annotated[int, whole_number(1, 1_000_000)]
_Distances = Annotated[tuple[Annotated[float, number(0)], ...], Strict(False), Field(min_length=1)]


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
    """Cameras of a config that stand at the ``distances_m`` from points of the steel."""

    kind: Annotated[str, one_of(SURVEY)] = SURVEY
    distances_m: _Distances
    views_per_distance: _Views

    @property
    def views(self) -> int:
        """Number of views of the full trajectory."""
        return len(self.distances_m) * self.views_per_distance


class RandomViews(ManifestTable):
    """Cameras of a config that stand at distances between the two ``distances_m`` from points of the steel."""

    kind: Annotated[str, one_of(RANDOM_VIEWS)] = RANDOM_VIEWS
    distances_m: _Distances
    views: _Views


class GivenPoses(ManifestTable):
    """Cameras of a config whose positions and targets are given."""

    kind: Annotated[str, one_of(POSES)] = POSES
    positions_m: Annotated[tuple[Triple, ...], Strict(False), Field(min_length=1)]
    targets_m: Annotated[tuple[Triple, ...], Strict(False), Field(min_length=1)]

    @model_validator(mode="after")
    def _check_targets(self) -> Self:
        if len(self.targets_m) not in (1, self.views):
            raise field_error(f"got {len(self.targets_m)} targets", f"as many as positions, {self.views}, or one")
        return self

    @property
    def distances_m(self) -> tuple[float, ...]:
        """Distances of the left camera from the targets, metres."""
        return tuple(map(math.dist, self.positions_m, cycle(self.targets_m)))

    @property
    def views(self) -> int:
        """Number of views of the full trajectory."""
        return len(self.positions_m)


AnyTrajectory = Trajectory | Survey | RandomViews | GivenPoses
_BY_KIND: Mapping[str, type[AnyTrajectory]] = {
    **dict.fromkeys(_SHELLS, Trajectory),
    SURVEY: Survey,
    RANDOM_VIEWS: RandomViews,
    POSES: GivenPoses,
}


def trajectory_of(fields: Any) -> AnyTrajectory:
    """Return the trajectory of a scene from its fields in the manifest. Raises the error of an invalid field."""
    if isinstance(fields, AnyTrajectory):
        return fields
    kind = fields.get("kind") if isinstance(fields, Mapping) else None
    if not isinstance(kind, str) or kind not in _BY_KIND:
        raise field_error(f"got {short_repr(fields)}", f"a table whose kind is one of {', '.join(_BY_KIND)}")
    return _BY_KIND[kind].model_validate(fields)


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
    count steel and scored pixels. ``right`` is None in a config without depth of the right camera, and
    ``steel_px`` in a config without masks.
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


class BoardTable(StrictModel):
    """Entry of a board."""

    width_m: _Length
    height_m: _Length
    markers: Annotated[int, one_of(6, 12)]
    marker_side_m: _Length
    dictionary: Name

    @property
    def spec(self) -> BoardSpec:
        """The board."""
        return BoardSpec(**self.model_dump())


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
"""Columns that are absent if the column in the key is absent."""


class SceneRig(ManifestTable):
    """Optics of a scene: pixel grid, baseline in metres, the camera by its name if it has one, and calibration."""

    grid: Annotated[str, one_of("ideal", "raw", "rectified")]
    baseline_m: _Length
    camera: Annotated[str, StringConstraints(max_length=100)] = ""
    calibration: dict[str, Any] | None = None


_Deviation = Annotated[float, number(-1, 1)]


def _is_unit(vector: tuple[float, ...]) -> bool:
    return abs(math.hypot(*vector) - 1) <= 1e-9


class MatRecord(ManifestTable):
    """Deviation of the cover of a mat as built: least and largest, metres, and whether beyond the tolerance."""

    deviation_m: Annotated[tuple[_Deviation, _Deviation], Strict(False)]
    beyond: bool


class FormPlane(ManifestTable):
    """Plane of formwork: a point, and the unit normal towards the side on which the steel is; world, metres."""

    name: Name
    point_m: Annotated[Triple, three_numbers(-1e9, 1e9, "three numbers, [x, y, z]")]
    normal: Annotated[Triple, Expected("three numbers, a vector of length 1", _is_unit)]


class Scene(ManifestTable):
    """Scene of a config, with its cameras, its mesh and its shards, which hold the rows of no other scene.

    ``board`` is the ArUco board under the assembly, or None; ``protocol_views`` is the number of views of the full
    trajectory; ``aim_point_m`` is the point that its cameras aim at, world metres, if they share one; ``bytes`` is
    the size of the shards; ``key`` is the digest of all parameters. ``family`` is the kind of cage of a generated
    scene, otherwise None, and ``mats`` are its parts that deviate together. ``planes`` are the faces of formwork
    that the cover of the steel is measured from. ``assembly``, ``trajectory``, ``rig`` and ``mesh`` are None in a
    config that was imported. ``entry`` is the scene as it was written, with all parameters of the build.
    """

    name: Name
    split: Annotated[str, one_of(*SPLITS)]
    family: Name | None = None
    mats: Annotated[tuple[MatRecord, ...], Strict(False)] = Field((), validation_alias=AliasPath("cage", "mats"))
    planes: Annotated[tuple[FormPlane, ...], Strict(False)] = ()
    assembly: Assembly | None = None
    board: BoardSpec | None
    environment: Annotated[str, StringConstraints(max_length=60)] = ""
    appearance: Appearance = Appearance()
    trajectory: Annotated[AnyTrajectory, BeforeValidator(trajectory_of)] | None = Field(None, alias="protocol")
    protocol_views: Annotated[int, whole_number(1, 1_000_000)]
    rig: SceneRig | None = None
    aim_point_m: Annotated[Triple, three_numbers(-1e9, 1e9, "three numbers, [x, y, z]")] | None = None
    key: Annotated[str, StringConstraints(max_length=200)]
    mesh: RelativePath | None
    shards: Annotated[tuple[RelativePath, ...], Strict(False), Expected("a list of one path or more", bool)]
    bytes: _Count
    entry: dict[str, Any] = Field(repr=False)

    @model_validator(mode="before")
    @classmethod
    def _keep_entry(cls, values: Any) -> Any:
        return {**values, "entry": values} if isinstance(values, Mapping) else values

    @field_validator("board", mode="before")
    @classmethod
    def _make_board(cls, fields: Any) -> BoardSpec | None:
        return None if fields is None else BoardTable.model_validate(fields).spec

    @field_validator("planes")
    @classmethod
    def _check_planes(cls, planes: tuple[FormPlane, ...]) -> tuple[FormPlane, ...]:
        if planes:
            check_unique([plane.name for plane in planes], "plane")
        return planes

    @field_validator("protocol_views")
    @classmethod
    def _check_protocol_views(cls, protocol_views: int, info: ValidationInfo) -> int:
        trajectory = info.data.get("trajectory")
        if trajectory is not None and protocol_views != trajectory.views:
            raise field_error(f"got {protocol_views}", f"the trajectory's {trajectory.views} views", "conflict")
        return protocol_views


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
