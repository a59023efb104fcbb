"""Any ONNX depth model as a method, from a short TOML file (``onnx_toml`` shows its keys)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64
from numpy import ndarray

from rebar_depth_bench.digests import files_digest
from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods.method import Method, MethodInfo, Predictor
from rebar_depth_bench.methods.onnx_grid import input_tensor, on_picture, placement
from rebar_depth_bench.methods.onnx_session import OnnxSession, open_session
from rebar_depth_bench.methods.onnx_toml import OnnxSpec, OutputSpec, read_onnx_toml

TRIAL_PX = (1280, 720)
"""Width and height of the black picture that a model answers once before the first view."""
_DIGITS = 16


def onnx_method(path: Path) -> Method:
    """Return the method that a TOML file describes. onnxruntime is imported when it is loaded.

    Its source ends with a digest of the file, the model and the model's external data: predictions of another
    model or other settings are not taken for this one's when a run goes on.

    Raises ``MethodError`` with all that is wrong with the file.
    """
    spec = read_onnx_toml(path)
    canonical = spec.output.meaning.canonical
    info = MethodInfo(
        name=spec.name,
        summary=spec.summary or f"ONNX model {spec.model.name}; its output: {spec.output.meaning.words}",
        columns=("left_rgb", "left_K") if canonical else ("left_rgb",),
        uses_intrinsics=canonical,
        source=f"{spec.source or spec.model.name} (sha256:{_digest(path, spec.model)})",
        licence=spec.licence,
    )
    return Method(info, lambda: _load(spec))


def metres(
    values: Float[ndarray, "*grid"], output: OutputSpec, fx_at_input_px: float = np.nan
) -> Float32[ndarray, "*grid"]:
    """Return planar depth in metres of output values; NaN where the value or the depth is not finite and above 0,
    or the depth lies outside of ``min_m`` to ``max_m``.

    ``fx_at_input_px`` is the focal length of the picture as the model saw it, resized. Depth is v, or 1 / v, times
    fx / focal_canonical where the meaning is canonical (Yin et al., "Metric3D", ICCV 2023, section 3.2), with v
    the value times ``scale``.
    """
    factor = fx_at_input_px / output.focal_canonical_px if output.meaning.canonical else 1.0
    scaled = np.asarray(values, np.float64) * output.scale
    with np.errstate(all="ignore"):
        depth_m = np.asarray(factor / scaled if output.meaning.inverse else factor * scaled)
        single = depth_m.astype(np.float32)
    known = np.isfinite(scaled) & np.isfinite(single) & (single > 0)
    known &= (depth_m >= output.min_m) & (depth_m <= output.max_m)
    return np.where(known, single, np.float32(np.nan))


def _load(spec: OnnxSpec) -> Predictor:
    session = open_session(spec.model, spec.input, spec.output)
    width, height = TRIAL_PX
    # What a model with open sizes really returns shows only when it runs.
    session.run(
        input_tensor(
            spec.input, placement(spec.input, width, height), np.zeros((height, width, 3), dtype=np.uint8)
        )
    )
    return lambda row: _predict(spec, session, row)


def _predict(spec: OnnxSpec, session: OnnxSession, row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
    height, width, _ = row["left_rgb"].shape
    place = placement(spec.input, width, height)
    values = session.run(input_tensor(spec.input, place, row["left_rgb"]))
    fx_at_input_px = row["left_K"][0, 0] * place.across.scale if spec.output.meaning.canonical else np.nan
    # First out goes what is no answer, so that no neighbour is mixed with it.
    answered: Float64[ndarray, "out_h out_w"] = np.where(
        np.isnan(metres(values, spec.output, fx_at_input_px)), np.nan, values
    )
    return metres(on_picture(place, answered, bilinear=spec.output.bilinear), spec.output, fx_at_input_px)


def _digest(path: Path, model: Path) -> str:
    """Return a digest of the TOML file, the model and its external data: what lies beside it under its name."""
    try:
        beside = sorted(one for one in model.parent.iterdir() if one.name.startswith(model.name) and one.is_file())
        return files_digest((path, *beside))[:_DIGITS]
    except OSError as error:
        raise MethodError(f"{error.filename}: cannot be read: {error.strerror}") from None
