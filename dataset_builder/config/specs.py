"""Frozen descriptions of everything a build does: assembly, board, cameras, colour.

They are plain values: they pickle to a render process, compare, and go into the manifest through
``dataclasses.asdict``.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.geometry.stereo_calibration import StereoCalibration


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
class PileSpec:
    """Overlapping-hook stirrups that fell in a heap; ``state`` names the stored poses they came to rest in.

    ``size_m`` is a hoop's outside size, long side first, by the nominal diameter.
    """

    kind: str = "pile"
    stirrups: int = 6
    diameter_m: float = 0.010
    size_m: tuple[float, float] = (0.280, 0.200)
    state: str = "pile-0"


@dataclass(frozen=True)
class PierSpec:
    """A square pier cage of 231 bars: verticals, two lapped half hoops a level, and a tie a level."""

    kind: str = "pier"
    side_m: float = 4.80
    height_m: float = 6.67
    verticals: int = 96
    levels: int = 45
    vertical_diameter_m: float = 0.032
    hoop_diameter_m: float = 0.016
    tie_diameter_m: float = 0.016


@dataclass(frozen=True)
class CageFileSpec:
    """An assembly read bar by bar from a TOML or IFC file; ``sha256`` pins its content."""

    path: str
    sha256: str
    kind: str = "cage-file"


@dataclass(frozen=True)
class MeshFileSpec:
    """An assembly read from a mesh file; ``sha256`` pins its content, ``unit_m`` is one file unit in metres."""

    path: str
    sha256: str
    unit_m: float
    kind: str = "mesh-file"


AssemblySpec = LatticeSpec | PileSpec | PierSpec | CageFileSpec | MeshFileSpec


@dataclass(frozen=True)
class AppearanceSpec:
    """What the paper's scenes leave out: names of ``appearance.VARIANTS``, none in the standard configs."""

    variants: tuple[str, ...] = ()


@dataclass(frozen=True)
class SceneSpec:
    """One scene: the steel, what it stands on and in, and the seed of its surface variation.

    ``environment`` is a name of ``blender.environments.ENVIRONMENTS``: ``laboratory`` or ``outdoors``.
    """

    name: str
    assembly: AssemblySpec
    board: BoardSpec | None
    environment: str = "laboratory"
    appearance: AppearanceSpec = field(default_factory=AppearanceSpec)
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
class SweepSpec:
    """A sweep of distances: the same directions at each of ``radii_m``, so that distance alone changes."""

    radii_m: tuple[float, ...]
    elevation_deg: float
    azimuths: int
    kind: str = "sweep"


ProtocolSpec = DomeSpec | RingSpec | SweepSpec


@dataclass(frozen=True)
class RigSpec:
    """A stereo rig and the grid it is seen on.

    Without a ``calibration`` it is two parallel ideal pinholes, ``baseline_m`` apart. With one, ``grid`` tells
    whether the images are the ``raw`` distorted ones or the ``rectified`` pair; ``baseline_m`` is then the
    calibration's.
    """

    width: int = 1280
    height: int = 720
    baseline_m: float = 0.120
    calibration: StereoCalibration | None = None
    grid: str = "ideal"


@dataclass(frozen=True)
class ColourSpec:
    """How Cycles renders colour; ``prefilter`` is how OIDN treats its albedo and normal guides."""

    samples: int = 16
    denoise: bool = True
    prefilter: str = "FAST"


@dataclass(frozen=True)
class ConfigSpec:
    """One config of the dataset: a scene under one camera protocol and one optics."""

    name: str
    scene: SceneSpec
    protocol: ProtocolSpec
    rig: RigSpec = field(default_factory=RigSpec)
    colour: ColourSpec = field(default_factory=ColourSpec)
