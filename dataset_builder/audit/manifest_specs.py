"""From the manifest's plain JSON values back to the specs they were written from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from dataset_builder.specs import DomeSpec, ProtocolSpec, RigSpec, RingSpec, SweepSpec
from rebar_depth_bench.board import BoardSpec
from rebar_depth_bench.calibration import Lens, StereoCalibration
from rebar_depth_bench.errors import DatasetError

_Spec = TypeVar("_Spec")
_PROTOCOLS: Mapping[str, Callable[..., ProtocolSpec]] = {"dome": DomeSpec, "ring": RingSpec, "sweep": SweepSpec}


def protocol_spec(config: str, entry: Mapping[str, Any]) -> ProtocolSpec:
    """Return the camera protocol of a config's manifest entry; raise ``DatasetError`` if it holds none."""
    return _read(config, "protocol", entry, _protocol)


def rig_spec(config: str, entry: Mapping[str, Any]) -> RigSpec:
    """Return the rig of a config's manifest entry; raise ``DatasetError`` if it holds none."""
    return _read(config, "rig", entry, _rig)


def board_spec(config: str, entry: Mapping[str, Any]) -> BoardSpec | None:
    """Return the board of a config's scene, None where it has none; raise ``DatasetError`` for a damaged one."""
    return _read(config, "board", entry["scene"], lambda board: None if board is None else BoardSpec(**board))


def _read(config: str, what: str, holder: Mapping[str, Any], maker: Callable[[Any], _Spec]) -> _Spec:
    try:
        return maker(holder[what])
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise DatasetError(
            f"manifest: the {what} of config {config} is {holder.get(what)!r}, expected one this version writes: "
            f"{type(error).__name__}: {error}"
        ) from None


def _protocol(values: Mapping[str, Any]) -> ProtocolSpec:
    return _PROTOCOLS[values["kind"]](**_with_tuples(values))


def _rig(values: Mapping[str, Any]) -> RigSpec:
    calibration = values.get("calibration")
    return RigSpec(**{**values, "calibration": None if calibration is None else _calibration(calibration)})


def _calibration(values: Mapping[str, Any]) -> StereoCalibration:
    lenses = {eye: Lens(**_with_tuples(values[eye])) for eye in ("left", "right")}
    return StereoCalibration(**{**_with_tuples(values), **lenses})


def _with_tuples(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values with JSON's lists as the tuples that specs hold."""
    return {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
