"""Catalog of the named configs, and the build request that modifies them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from dataset_builder.cameras.rigs import resized, sized_rig, zed_rig
from dataset_builder.catalog.cages_config import CAGES, MAX_SCENES, MAX_VIEWS_PER_SCENE, CagesRequest, cage_scenes
from dataset_builder.scene.environments.surroundings import check_suitable
from dataset_builder.scene.model import Note
from dataset_builder.scene.variants.registry import VARIANTS, check_variants
from dataset_builder.specs.config_specs import (
    CPU,
    GPU_TYPES,
    LENS_DEVICES,
    AppearanceSpec,
    AssemblySpec,
    ColourSpec,
    ConfigSpec,
    DistanceSweepSpec,
    DomeSpec,
    LatticeSpec,
    PierSpec,
    PileSpec,
    RigSpec,
    RingSpec,
    SceneSpec,
)
from dataset_builder.specs.file_specs import MeshFileSpec
from dataset_builder.user_files.scene_schema import SCENE_NAME
from rebar_depth_bench.base.errors import InputError, Problem
from rebar_depth_bench.base.names import SPLITS
from rebar_depth_bench.captures.calibration import scaled_calibration
from rebar_depth_bench.data.schema import NEAREST_STEEL
from rebar_depth_bench.geometry.aruco_board import BoardSpec

if TYPE_CHECKING:
    from dataset_builder.scene.assemblies.cage import Cage

LATTICE_DOME = DomeSpec(
    radii_m=(0.22, 0.30, 0.35, 0.38, 0.40, 0.42, 0.43),
    elevations_deg=(15.0, 27.0, 39.0, 51.0, 63.0, 75.0),
    azimuths=12,
)
"""The 504 views of the paper at 0.22-0.43 m.

The distances are to the middle of the lattice; its steel is 0.14-0.37 m from the left camera at the nearest, at
depths of 0.13-0.49 m. The far shells are spaced more closely, so that steel covers 6.9 % of the frame on average.
"""
PILE_DOME = DomeSpec(
    radii_m=(0.50, 0.57, 0.59, 0.62, 0.65, 0.67, 0.90),
    elevations_deg=(28.0, 37.0, 46.0, 55.0, 64.0, 73.0),
    azimuths=12,
)
"""The 504 views of the paper at 0.50-0.90 m, above the objects on the bench.

The distances are to the middle of the pile, whose steel is at depths of 0.32-1.05 m. Steel covers 5.7 % of the
frame on average.
"""
PIER_DOME = DomeSpec(
    radii_m=(8.0, 11.0, 13.0, 14.5, 15.5, 16.25, 17.0),
    elevations_deg=(-7.5, -1.0, 7.0, 17.0, 29.0, 44.0),
    azimuths=12,
    distance_to=NEAREST_STEEL,
)
"""The 504 views of the paper at 8-17 m from the nearest steel, at the heights of a person, a mast and a drone.

The paper does not say what its distances are to. Its masks cover 4.5-7.2 % of the frame: here steel covers 5.2 %
on average (10.9 % on the nearest shell, 3.1 % on the farthest), at depths of 7.4-26.3 m. With the same distances
to the middle of the cage it would cover 9 %, from a depth of 3.3 m. ``python -m benchmarks.steel_coverage ROOT``
measures these numbers of all domes in a folder.
"""
LATTICE_RING = RingSpec(radius_m=0.325, elevation_deg=35.0, azimuths=100)


def geometric_sweep(nearest_m: float, farthest_m: float, elevation_deg: float) -> DistanceSweepSpec:
    """Return a sweep of 96 views: 8 directions at each of 12 distances.

    The distances form a geometric sequence and are rounded to the millimetre.
    """
    steps = 11
    ratio = farthest_m / nearest_m
    radii_m = tuple(round(nearest_m * ratio ** (step / steps), 3) for step in range(steps + 1))
    return DistanceSweepSpec(radii_m, elevation_deg, azimuths=8)


def _lattice_scene(markers: int = 6, name: str = "lattice") -> SceneSpec:
    return SceneSpec(name=name, assembly=LatticeSpec(), board=BoardSpec(markers=markers))


def _pile_scene() -> SceneSpec:
    return SceneSpec("pile", PileSpec(), BoardSpec())


def _pier_scene() -> SceneSpec:
    return SceneSpec("pier", PierSpec(), None, "outdoors")


CONFIGS: Mapping[str, Callable[[], ConfigSpec]] = {
    "lattice": lambda: ConfigSpec("lattice", _lattice_scene(), LATTICE_DOME),
    "lattice-orbit": lambda: ConfigSpec("lattice-orbit", _lattice_scene(), LATTICE_RING),
    "lattice-zed": lambda: ConfigSpec("lattice-zed", _lattice_scene(), LATTICE_DOME, zed_rig()),
    "lattice-zed-raw": lambda: ConfigSpec("lattice-zed-raw", _lattice_scene(), LATTICE_DOME, zed_rig(grid="raw")),
    "lattice-12": lambda: ConfigSpec("lattice-12", _lattice_scene(12, "lattice-12"), LATTICE_DOME),
    "lattice-zed-12": lambda: ConfigSpec(
        "lattice-zed-12", _lattice_scene(12, "lattice-12"), LATTICE_DOME, zed_rig()
    ),
    "pile": lambda: ConfigSpec("pile", _pile_scene(), PILE_DOME),
    "pier": lambda: ConfigSpec("pier", _pier_scene(), PIER_DOME),
}
"""Factories of the eight standard configs, which are built by default."""

SWEEPS: Mapping[str, Callable[[], ConfigSpec]] = {
    "lattice-distance": lambda: ConfigSpec("lattice-distance", _lattice_scene(), geometric_sweep(0.22, 1.6, 40.0)),
    "pile-distance": lambda: ConfigSpec("pile-distance", _pile_scene(), geometric_sweep(0.50, 2.2, 45.0)),
    "pier-distance": lambda: ConfigSpec("pier-distance", _pier_scene(), geometric_sweep(5.0, 17.0, 7.0)),
}
"""Factories of the distance sweeps for ``examples/paper/distance.py``; built only if named.

A sweep starts where the steel fills the frame. It ends at the limit of the laboratory, or where bars become too
thin to have interior pixels.
"""
_KNOWN = {**CONFIGS, **SWEEPS}
LATTICE_CONFIGS = tuple(name for name in CONFIGS if name.startswith("lattice"))
"""Names of the configs in which ``--mesh`` replaces the rods."""
ZED_CONFIGS = tuple(name for name in CONFIGS if "zed" in name)
"""Names of the configs of the calibrated ZED, whose rig ``--rig`` does not replace."""


@dataclass(frozen=True)
class BuildRequest:
    """Request to ``rebar-build``: configs, number of views, image size (pixels) and colour quality.

    ``views`` is the number of views per config, spread evenly over the trajectory; None selects all views.
    ``colour`` None builds no colour. ``mesh`` replaces the rods of the lattice. ``variants`` are names of
    ``VARIANTS``; they are appended to the names of configs and scenes. ``scenes`` are the configs
    of user scene files. ``rig`` replaces the rig of all configs, whose cameras keep their stations; ``rig_name``
    is appended to their names. Images have the size of the rig; of ``width`` and ``height``, one alone keeps its
    aspect ratio. ``cages`` are the scenes of the config of that name, if it is among the ``configs``.
    ``overwrite`` are the names of configs whose finished views may be replaced. ``cages_read`` has what was read
    already from files of the ``scenes``, by their specs.
    """

    configs: tuple[str, ...] = tuple(CONFIGS)
    views: int | None = None
    width: int | None = None
    height: int | None = None
    colour: ColourSpec | None = field(default_factory=ColourSpec)
    seed: int = 0
    mesh: MeshFileSpec | None = None
    variants: tuple[str, ...] = ()
    scenes: tuple[ConfigSpec, ...] = ()
    rig: RigSpec | None = None
    rig_name: str = ""
    cages: CagesRequest | None = None
    overwrite: tuple[str, ...] = ()
    cages_read: Mapping[AssemblySpec, Cage] = field(default_factory=dict)

    def config_specs(self) -> list[ConfigSpec]:
        """Return the specs of all requested configs.

        Raises ``InputError`` that names every value that is out of range or unknown, or cannot be combined with
        ``cages``; and ``InputError`` for invalid variants and duplicate config names, if ``mesh`` is combined with
        a config that is not a lattice, and if the device of ``colour`` cannot render a config.
        """
        if problems := [*self._problems()]:
            raise InputError.from_problems("build request", problems)
        check_variants(self.variants)
        specs = [self._with_request(spec) for spec in self._given_specs()]
        for spec in specs:
            check_suitable(spec.scene.environment, self.variants)
        self._check_lenses(specs)
        built = [spec.name for spec in specs]
        duplicates = sorted({name for name in built if built.count(name) > 1})
        if duplicates:
            raise InputError(
                f"more than one config is named {', '.join(duplicates)}, expected unique names: rename the scene"
            )
        scenes = [*specs]
        if self._cages is not None:
            size = sized_rig(RigSpec(), self.width, self.height)
            scenes += cage_scenes(self._cages, self.seed, size.width, size.height, self.colour)
        names = {spec.name for spec in scenes}
        if unknown := [name for name in self.overwrite if name not in names]:
            expected = f"one of the configs that are built: {', '.join(sorted(names))}"
            problem = Problem("unknown", "--overwrite", f"got {unknown[0]!r}", expected)
            raise InputError.from_problems("build request", [problem])
        return scenes

    def notes(self, specs: Iterable[ConfigSpec]) -> list[Note]:
        """Return notes on the calibrations of built ``specs``, and on rows of images that are added or cropped."""
        notes = []
        for given, spec in zip(self._given_specs(), specs, strict=False):  # Scenes of cages are last.
            rig = self.rig or given.rig
            notes += [Note(spec.name, "rig", text) for text in (rig.calibration.notes if rig.calibration else ())]
            rows = spec.rig.height - sized_rig(rig, self.width, None).height
            if self.width is not None and self.height is not None and rows:
                found = f"{abs(rows)} rows are {'added' if rows > 0 else 'cropped'}, half of them at the top"
                notes.append(Note(spec.name, "size", f"images of {self.width} x {self.height} pixels: {found}"))
        return notes

    def _given_specs(self) -> list[ConfigSpec]:
        """Return the named configs of one scene, and the scenes of files, before the request modifies them."""
        return [*(_KNOWN[name]() for name in dict.fromkeys(self.configs) if name != CAGES), *self.scenes]

    @property
    def _cages(self) -> CagesRequest | None:
        """Request for the scenes of ``cages``, or None if they are not requested."""
        return (self.cages or CagesRequest()) if CAGES in self.configs else None

    def _problems(self) -> Iterator[Problem]:
        """Yield the problems of single options, and of those that cannot be combined with ``cages``."""
        colour, cages = self.colour, self._cages
        limits: Sequence[tuple[str, int | None, int, int]] = (
            ("--views", self.views, 1, 1_000_000),
            ("--width", self.width, 16, 8192),
            ("--height", self.height, 16, 8192),
            ("--samples", None if colour is None else colour.steel_samples, 1, 65_536),
            ("--seed", self.seed, 0, 2**31 - 1),
            ("--scenes", None if cages is None else cages.scenes, 1, MAX_SCENES),
            ("--views-per-scene", None if cages is None else cages.views_per_scene, 1, MAX_VIEWS_PER_SCENE),
        )
        for name, value, low, high in limits:
            if value is not None and not low <= value <= high:
                yield Problem("invalid", name, f"got {value}", f"{low} to {high}")
        choices: Sequence[tuple[str, Iterable[str], Sequence[str]]] = (
            ("--config", dict.fromkeys(self.configs), (*_KNOWN, CAGES)),
            ("--device", () if colour is None else (colour.device,), (CPU, *GPU_TYPES)),
            ("--split", () if cages is None else (cages.split,), SPLITS),
        )
        for name, chosen, known in choices:
            for text in chosen:
                if text not in known:
                    yield Problem("unknown", name, f"got {text!r}", f"one of {', '.join(known)}")
        # Each scene of cages draws its own variants, and takes no mesh.
        alone = {"--mesh": self.mesh, "--variant": self.variants, "--views": self.views, "--rig": self.rig}
        for name, given in alone.items():
            if cages is not None and given:
                yield Problem("conflict", name, f"is combined with --config {CAGES}", "only one of them")
        if self.rig is not None and (calibrated := [name for name in self.configs if name in ZED_CONFIGS]):
            expected = "configs without a calibration of their own, such as lattice"
            yield Problem("conflict", "--rig", f"is combined with --config {' '.join(calibrated)}", expected)

    def _check_lenses(self, specs: Sequence[ConfigSpec]) -> None:
        """Raise ``InputError`` if the device cannot render the lenses of a config."""
        raw = [spec.name for spec in specs if spec.rig.grid == "raw"]
        if raw and self.colour is not None and self.colour.device not in LENS_DEVICES:
            raise InputError(
                f"{', '.join(raw)}: cannot be rendered with --device {self.colour.device}, expected "
                f"{' or '.join(LENS_DEVICES)}: Cycles has no lenses with distortion on others; "
                "build the other configs separately, named with --config"
            )

    def _with_request(self, spec: ConfigSpec) -> ConfigSpec:
        # In a fixed order, so that equal sets of variants give equal names.
        variants = tuple(name for name in VARIANTS if name in self.variants)
        suffix = "".join(f"-{name}" for name in variants)
        scene = replace(
            spec.scene,
            name=spec.scene.name + suffix,
            assembly=self._assembly(spec),
            appearance=AppearanceSpec(variants),
            seed=self.seed,
        )
        name = f"{spec.name}-{self.rig_name}" if self.rig is not None else spec.name
        if name != spec.name and (name in _KNOWN or not SCENE_NAME.accept(name)):
            raise InputError(
                f"--rig: a config would be named {name!r}, expected {SCENE_NAME.text}: rename the file"
            )
        rig = sized_rig(self.rig or spec.rig, self.width, self.height)
        if not 16 <= min(rig.width, rig.height) <= max(rig.width, rig.height) <= 8192:
            found = f"the images of {name} would have {rig.width} x {rig.height} pixels"
            raise InputError(f"{found}, expected 16 to 8192 each: give --width and --height")
        if rig.grid == "raw" and rig.calibration is not None:
            scaled_calibration(resized(rig.calibration, rig.width, rig.height), name, None, None)
        return replace(spec, name=name + suffix, scene=scene, rig=rig, colour=self.colour)

    def _assembly(self, spec: ConfigSpec) -> AssemblySpec:
        if self.mesh is None:
            return spec.scene.assembly
        if not isinstance(spec.scene.assembly, LatticeSpec):
            raise InputError(f"--mesh replaces the rods of a lattice, but config {spec.name} is not a lattice")
        return self.mesh
