"""Tables of a config's entry in the manifest: scenes, rig, views, references, and how data were imported."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, Strict, StringConstraints, field_validator

from rebar_depth_bench.data.columns import OPTIONAL_COLUMNS
from rebar_depth_bench.data.manifest_table import ManifestTable
from rebar_depth_bench.errors import escape_text
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.paths import NAME_LETTERS, NAME_PATTERN, PATH_PATTERN, VIEW_ID_PATTERN
from rebar_depth_bench.validation import (
    Expected,
    StrictModel,
    check_unique,
    field_error,
    number,
    one_of,
    whole_number,
)
from rebar_depth_bench.view_ids import SPLITS, TEST_SPLIT

SCENE_FILES = ("mesh", "shards")
"""Keys of a scene that the entry of a config of one scene has beside the scene."""
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


class Appearance(ManifestTable):
    """Names of the appearance variants of a scene."""

    variants: Annotated[tuple[Name, ...], Strict(False)] = ()


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


class Scene(ManifestTable):
    """Scene of a config, with its mesh and its shards, which hold the rows of no other scene.

    ``board`` is the ArUco board under the assembly, or None; ``mesh`` is None in a config that was imported.
    ``family`` is the kind of cage in a config of generated scenes, otherwise None.
    """

    name: Name
    split: Annotated[str, one_of(*SPLITS)] = TEST_SPLIT
    family: Name | None = None
    board: BoardSpec | None
    appearance: Appearance = Appearance()
    mesh: RelativePath | None
    shards: Annotated[tuple[RelativePath, ...], Strict(False)]

    @field_validator("board", mode="before")
    @classmethod
    def _make_board(cls, fields: Any) -> BoardSpec | None:
        return None if fields is None else BoardSpec(**_BoardTable.model_validate(fields).model_dump())

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
