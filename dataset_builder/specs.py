"""Frozen descriptions of everything a build does: assembly, board, cameras, colour.

They are plain values: they pickle to a render process, compare, and go into the manifest through
``dataclasses.asdict``.
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class LatticeSpec:
    """A cube of three orthogonal families of straight ribbed rods (the paper's printed mock-up).

    Rods sit on a ``pitch_m`` grid and alternate between the two diameters, so that neighbours differ.
    """

    kind: str = "lattice"
    extent_m: float = 0.100
    pitch_m: float = 0.020
    diameters_m: tuple[float, float] = (0.007, 0.004)


@dataclass(frozen=True)
class MeshFileSpec:
    """An assembly read from a mesh file; ``sha256`` pins its content, ``unit_m`` is one file unit in metres."""

    path: str
    sha256: str
    unit_m: float
    kind: str = "mesh-file"


@dataclass(frozen=True)
class BoardSpec:
    """An A3 sheet, long side along world x, centred on the origin, with ArUco markers round the assembly."""

    width_m: float = 0.420
    height_m: float = 0.297
    markers: int = 6
    marker_side_m: float = 0.050
    dictionary: str = "DICT_4X4_50"


@dataclass(frozen=True)
class SceneSpec:
    """One scene: the steel, the board it stands on, and the seed of its surface variation."""

    name: str
    assembly: LatticeSpec | MeshFileSpec
    board: BoardSpec
    seed: int = 0


@dataclass(frozen=True)
class DomeSpec:
    """A truncated-sphere dome: shells x elevation rings x azimuths, left camera at ``radii_m`` from the target."""

    radii_m: tuple[float, ...]
    elevations_deg: tuple[float, ...]
    azimuths: int
    kind: str = "dome"


@dataclass(frozen=True)
class RingSpec:
    """One ring of evenly spaced azimuths at a fixed distance and elevation."""

    radius_m: float
    elevation_deg: float
    azimuths: int
    kind: str = "ring"


@dataclass(frozen=True)
class RigSpec:
    """A parallel stereo rig with the ideal pinhole K of its grid."""

    width: int = 1280
    height: int = 720
    baseline_m: float = 0.120


@dataclass(frozen=True)
class ColourSpec:
    """How Cycles renders colour."""

    samples: int = 16
    denoise: bool = True


@dataclass(frozen=True)
class ConfigSpec:
    """One config of the dataset: a scene under one camera protocol and one optics."""

    name: str
    scene: SceneSpec
    protocol: DomeSpec | RingSpec
    rig: RigSpec = field(default_factory=RigSpec)
    colour: ColourSpec = field(default_factory=ColourSpec)
