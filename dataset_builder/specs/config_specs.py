"""Frozen specification dataclasses of a config: assembly, scene, trajectory, rig and colour.

Specs are plain values. They are pickled to render processes, compared with ``==``, and written to the manifest
with ``dataclasses.asdict``: field names and defaults are part of the dataset format.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import radians, tan

from dataset_builder.specs.file_specs import CageFileSpec, MeshFileSpec
from rebar_depth_bench.base.names import TEST_SPLIT, scene_prefix, view_id
from rebar_depth_bench.captures.calibration import StereoCalibration
from rebar_depth_bench.data.schema import CENTRE, POSES, RANDOM_VIEWS, SURVEY
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.geometry.cameras import NOMINAL_FOCAL_PX, NOMINAL_WIDTH


@dataclass(frozen=True)
class LatticeSpec:
    """Cubic lattice of three orthogonal sets of straight ribbed rods (the printed mock-up of the paper).

    The rods lie on a grid of ``pitch_m`` and alternate between the two diameters, so that neighbours differ.
    """

    kind: str = "lattice"
    extent_m: float = 0.100
    pitch_m: float = 0.020
    diameters_m: tuple[float, float] = (0.007, 0.004)


@dataclass(frozen=True)
class PileSpec:
    """Pile of stirrups with overlapping hooks; ``state`` names the stored resting poses.

    ``size_m`` is the outside size of a hoop for the nominal diameter, long side first.
    """

    kind: str = "pile"
    stirrups: int = 6
    diameter_m: float = 0.010
    size_m: tuple[float, float] = (0.280, 0.200)
    state: str = "pile-0"


@dataclass(frozen=True)
class PierSpec:
    """Square pier cage of 231 bars: verticals, and two lapped half hoops and one tie per level."""

    kind: str = "pier"
    side_m: float = 4.80
    height_m: float = 6.67
    verticals: int = 96
    levels: int = 45
    vertical_diameter_m: float = 0.032
    hoop_diameter_m: float = 0.016
    tie_diameter_m: float = 0.016


CAGES_VERSION = 2
"""Version of the generator of cages: it changes when the same seed gives another cage."""


@dataclass(frozen=True)
class GeneratedCageSpec:
    """Reinforcement cage from the generator (``scene.cages``): cage ``number`` of a split, from a seed.

    ``family`` restricts the draw; ``version`` is that of the generator, with which the same numbers give the same
    cage.
    """

    split: str
    number: int
    seed: int = 0
    family: str | None = None
    version: int = CAGES_VERSION
    kind: str = "generated-cage"


AssemblySpec = LatticeSpec | PileSpec | PierSpec | CageFileSpec | MeshFileSpec | GeneratedCageSpec


@dataclass(frozen=True)
class AppearanceSpec:
    """Appearance variants of a scene, as names of ``variants.registry.VARIANTS``.

    The standard configs, like the scenes of the paper, have none.
    """

    variants: tuple[str, ...] = ()


@dataclass(frozen=True)
class FormSpec:
    """Form of a scene file: a sheet of plywood behind its face, whose middle is ``point_m``; world, metres.

    The unit vector ``normal`` is towards the steel. The sides of the face are ``size_m``, the first of them along
    the unit vector ``along``.
    """

    name: str
    point_m: Point
    normal: Point
    along: Point
    size_m: tuple[float, float]


@dataclass(frozen=True)
class SceneSpec:
    """Scene: assembly, ArUco board (None: no board), environment, seed of its surface variation, and forms.

    ``environment`` is a name of ``scene.environments.surroundings.SURROUNDINGS``.
    """

    name: str
    assembly: AssemblySpec
    board: BoardSpec | None
    environment: str = "laboratory"
    appearance: AppearanceSpec = field(default_factory=AppearanceSpec)
    seed: int = 0
    forms: tuple[FormSpec, ...] = ()


@dataclass(frozen=True)
class DomeSpec:
    """Truncated-sphere dome of views: shells x elevation rings x azimuths.

    ``distance_to`` states what ``radii_m`` are the distances to, always from the centre of the left camera:
    ``centre`` is the target, the middle of the assembly; ``nearest steel`` is the nearest point of any bar's
    surface, in any direction. In both cases elevations and azimuths are the directions from the target.
    """

    radii_m: tuple[float, ...]
    elevations_deg: tuple[float, ...]
    azimuths: int
    distance_to: str = CENTRE
    kind: str = "dome"


@dataclass(frozen=True)
class RingSpec:
    """Ring of views at evenly spaced azimuths, with a fixed distance and elevation."""

    radius_m: float
    elevation_deg: float
    azimuths: int
    kind: str = "ring"


@dataclass(frozen=True)
class DistanceSweepSpec:
    """Distance sweep: the same viewing directions at each of ``radii_m``, so that only the distance changes."""

    radii_m: tuple[float, ...]
    elevation_deg: float
    azimuths: int
    kind: str = "sweep"


Point = tuple[float, float, float]
Station = tuple[Point, Point]
"""Place of a survey view: the centre of the left camera and the point that the rig is aimed at, world metres."""


@dataclass(frozen=True)
class SurveySpec:
    """Survey of large steel: views at each of ``distances_m`` from points that are spread over the visible steel.

    The distances are those of the left camera from the point of a bar's surface that the rig is aimed at.
    ``stations`` are the places of the views in order, to the micrometre: they follow from the other fields and the
    assembly (``cameras.camera_placement``), and are stored so that every machine uses the same ones.
    """

    distances_m: tuple[float, ...] = (0.5, 0.75, 1.0, 1.5)
    views_per_distance: int = 126
    seed: int = 0
    stations: tuple[Station, ...] = ()
    kind: str = SURVEY


RolledStation = tuple[Point, Point, float]
"""Place of a random view: a ``Station``, and the roll of the rig about its axis, degrees clockwise."""


@dataclass(frozen=True)
class RandomViewsSpec:
    """Random views of steel: cameras at distances between the two ``distances_m`` from points of the steel.

    ``stations`` are the places of the views in order. They follow from the other fields, the assembly and the rig
    (``cameras.camera_placement``), each view from its own number, so that the views of a longer list begin with
    those of a shorter one.
    """

    views: int
    distances_m: tuple[float, float] = (0.25, 8.0)
    seed: int = 0
    stations: tuple[RolledStation, ...] = ()
    kind: str = RANDOM_VIEWS


@dataclass(frozen=True)
class PosesSpec:
    """Given poses, world metres: the left camera stands at each position and its axis passes through its target.

    One target may be that of all positions. ``up`` points up in the images.
    """

    positions_m: tuple[Point, ...]
    targets_m: tuple[Point, ...]
    up: Point = (0.0, 0.0, 1.0)
    kind: str = POSES


TrajectorySpec = DomeSpec | RingSpec | DistanceSweepSpec | SurveySpec | RandomViewsSpec | PosesSpec


@dataclass(frozen=True)
class RigSpec:
    """Stereo rig and the pixel grid of its images; ``width`` and ``height`` in pixels.

    Without a ``calibration`` the rig is a pair of parallel ideal pinholes, ``baseline_m`` apart (``grid`` is
    ``ideal``). With a calibration, ``grid`` is ``raw`` for the distorted images, ``rectified`` for the rectified
    pair, or ``ideal`` if it has two parallel pinholes; ``baseline_m`` must equal the baseline of the calibration.
    The width decides the focal length; images of another aspect ratio have fewer or more rows on both sides.
    """

    width: int = 1280
    height: int = 720
    baseline_m: float = 0.120
    calibration: StereoCalibration | None = None
    grid: str = "ideal"


@dataclass(frozen=True)
class FocalRigSpec(RigSpec):
    """Ideal rig with the ``focal_px`` of a named ``camera``, in pixels of an image 1280 pixels wide."""

    camera: str = ""
    focal_px: float = NOMINAL_FOCAL_PX


def focal_of_view_px(horizontal_deg: float, width: int = NOMINAL_WIDTH) -> float:
    """Return the focal length that shows ``horizontal_deg`` in an image ``width`` pixels wide."""
    return width / 2 / tan(radians(horizontal_deg) / 2)


def _rig(camera: str, baseline_m: float, focal_px: float, height: int = RigSpec.height) -> FocalRigSpec:
    return FocalRigSpec(height=height, baseline_m=baseline_m, camera=camera, focal_px=round(focal_px, 1))


_RIGS = (
    _rig("Stereolabs ZED", 0.120, NOMINAL_FOCAL_PX),  # HD720; the rig of the paper.
    _rig("Luxonis OAK-D", 0.075, 882.5, height=800),  # Luxonis, "Configuring stereo depth": focal length at 800P.
    _rig("Luxonis OAK-D Pro", 0.075, focal_of_view_px(80.0), height=800),  # Luxonis' page of it: 80 x 55 degrees.
    # D405: product page, 87 x 58 degrees, 1280 x 720; DigiKey's forum, topic 50822, eyes 9 mm off the middle.
    _rig("Intel RealSense D405", 0.018, focal_of_view_px(87.0)),
    _rig("Intel RealSense D415", 0.055, focal_of_view_px(65.0)),
    _rig("Intel RealSense D435", 0.050, focal_of_view_px(87.0)),
    _rig("Intel RealSense D455", 0.095, focal_of_view_px(87.0)),
)
STEREO_CAMERAS: Mapping[str, FocalRigSpec] = {rig.camera: rig for rig in _RIGS}
"""Rigs of stereo cameras that can be bought, by name.

Sizes and fields of view are those of the pair of cameras that depth is computed from, as their makers state them.
They model this geometry only, not lenses, projector, depth engine or noise.
"""


CPU = "cpu"
GPU_TYPES = ("optix", "cuda", "hip", "oneapi", "metal")
"""Types of GPU devices, as Cycles names them in capitals; the best one first."""
LENS_DEVICES = (CPU, "optix")
"""Types of devices on which Blender 4.5 renders custom cameras, which the raw grid needs."""


@dataclass(frozen=True)
class ColourSpec:
    """Colour rendering with Cycles: samples per pixel, and the denoiser's prefilter of albedo and normals.

    Pixels in the box around the steel of a picture have ``steel_samples``, the others ``samples``. Sampling is
    uniform if both are equal. ``device`` is ``CPU`` or one of ``GPU_TYPES``: the bytes of images depend on it.
    """

    samples: int = 4
    steel_samples: int = 24
    prefilter: str = "FAST"
    device: str = CPU


QUALITIES: Mapping[str, ColourSpec] = {
    "preview": ColourSpec(samples=2, steel_samples=8),
    "standard": ColourSpec(),
    "high": ColourSpec(samples=6, steel_samples=44),
}
"""Presets by name, chosen by measurement (``python -m benchmarks.colour``)."""

DEFAULT_QUALITY = "standard"

STEEL_FIRST, UNIFORM = "steel-first", "uniform"
SAMPLINGS = (STEEL_FIRST, UNIFORM)


def colour_spec(sampling: str | None = None, quality: str | None = None, samples: int | None = None) -> ColourSpec:
    """Return the colour settings that the options select; None is an option that is not given.

    ``samples`` are those of steel pixels, by default those of ``quality``. With uniform sampling, which is the
    default if ``samples`` are given, all other pixels have as many.
    """
    preset = QUALITIES[quality or DEFAULT_QUALITY]
    steel_samples = preset.steel_samples if samples is None else samples
    is_uniform = (sampling or (STEEL_FIRST if samples is None else UNIFORM)) == UNIFORM
    return replace(
        preset,
        samples=steel_samples if is_uniform else min(preset.samples, steel_samples),
        steel_samples=steel_samples,
    )


@dataclass(frozen=True)
class ConfigSpec:
    """Config of the dataset: a scene, a camera trajectory (``protocol``), a rig, and colour settings or None."""

    name: str
    scene: SceneSpec
    protocol: TrajectorySpec
    rig: RigSpec = field(default_factory=RigSpec)
    colour: ColourSpec | None = field(default_factory=ColourSpec)

    @property
    def label(self) -> str:
        """Name in messages and of staging folders."""
        return self.name

    @property
    def scene_prefix(self) -> str:
        """Part of the view ids between config and index."""
        return ""

    def view_id(self, index: int) -> str:
        """Return the id of a view from its index in the full trajectory."""
        return view_id(self.name, index, self.scene_prefix)


@dataclass(frozen=True)
class SceneConfigSpec(ConfigSpec):
    """One scene of a config that has several, in one of its splits."""

    split: str = TEST_SPLIT

    @property
    def label(self) -> str:
        """Name in messages and of staging folders: config and scene."""
        return f"{self.name}-{self.scene.name}"

    @property
    def scene_prefix(self) -> str:
        """Part of the view ids between config and index: split and scene."""
        return scene_prefix(self.split, self.scene.name)
