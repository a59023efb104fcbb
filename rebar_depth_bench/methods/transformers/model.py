"""Monocular depth models of ``transformers``, named by their checkpoint: ``hf:ORG/NAME`` or ``hf:FOLDER``.

Depth is brought to the left grid with the interpolation of each model's own post-processing: bilinear for Depth
Pro, bicubic for the others. Between a bar and its background, interpolation produces depths that lie on neither
surface, as these models do for every user.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from rebar_depth_bench.errors import MethodError, exception_summary
from rebar_depth_bench.methods.base import Method, MethodInfo, Predictor
from rebar_depth_bench.methods.transformers.checkpoints import (
    Checkpoint,
    ensure_weights,
    find_checkpoint,
    read_preprocessor_config,
)
from rebar_depth_bench.methods.transformers.families import OutputKind, family_of, network_output_to_depth_m

HF_PREFIX = "hf:"
DEPTH_PRO_CHECKPOINT = "apple/DepthPro-hf"
_WITHOUT_LIBRARY_PROCESSOR = ("depth_pro",)


def hf_method(name_or_path: str) -> Method:
    """Return the method of a checkpoint: ``ORG/NAME`` on the Hub, or a folder written by ``save_pretrained``.

    ``config.json`` is read (and downloaded from the Hub if necessary) immediately because it determines whether
    the output is metric or relative; weights are downloaded by ``load``. Downloads are announced on standard
    error.

    Raises ``MethodError`` if there is no such checkpoint or its model type is not supported.
    """
    checkpoint = find_checkpoint(name_or_path)
    family = family_of(checkpoint.config, str(checkpoint.folder / "config.json"))
    output = family.output(checkpoint.config)
    info = MethodInfo(
        name=f"{HF_PREFIX}{checkpoint.name}",
        summary=f"{family.name} from one picture: {output.value}; weights {checkpoint.version}",
        columns=_columns(output),
        uses_intrinsics=output is OutputKind.CANONICAL,
        source=f"transformers, {checkpoint.name}",
        licence="that of the checkpoint",
    )
    return Method(info, lambda: load_predictor(checkpoint))


def load_predictor(checkpoint: Checkpoint) -> Predictor:
    """Return the predictor of a checkpoint, on the GPU if torch finds one.

    Raises ``MethodError`` if torch, ``transformers`` or weights are missing, or if the weights are incomplete.
    """
    family = family_of(checkpoint.config, str(checkpoint.folder / "config.json"))
    torch, transformers = _import_packages()
    ensure_weights(checkpoint)
    from rebar_depth_bench.methods.transformers.families import PROCESSING_FACTORIES

    model_type = checkpoint.config["model_type"]
    settings = read_preprocessor_config(checkpoint)
    processor = None if model_type in _WITHOUT_LIBRARY_PROCESSOR else _load_processor(transformers, checkpoint)
    try:
        processing = PROCESSING_FACTORIES[model_type](settings, processor)
    except KeyError as error:
        raise MethodError(f"{checkpoint.name}: preprocessor_config.json has no {error}") from None
    model = _load_network(transformers, checkpoint).to("cuda" if torch.cuda.is_available() else "cpu")
    output = family.output(checkpoint.config)

    def predict(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
        rgb = row["left_rgb"]
        with torch.inference_mode():
            raw_output = model(pixel_values=processing.to_network_input(rgb).to(model.device)).predicted_depth[0]
            values = processing.to_left_grid(raw_output.float().cpu(), rgb.shape[:2])
        return network_output_to_depth_m(output, np.asarray(values.numpy()), row.get("left_K"))

    return predict


def _columns(output: OutputKind) -> tuple[str, ...]:
    return ("left_rgb", "left_K") if output is OutputKind.CANONICAL else ("left_rgb",)


def _import_packages() -> tuple[Any, Any]:
    """Return the modules torch and ``transformers``, which are optional dependencies.

    Raises ``MethodError`` if one is not installed.
    """
    try:
        return importlib.import_module("torch"), importlib.import_module("transformers")
    except ImportError as error:
        raise MethodError(
            f"monocular models need torch and transformers ({error}): pip install 'rebar-depth-bench[models]'"
        ) from None


def _load_processor(transformers: Any, checkpoint: Checkpoint) -> Any:
    """Return the library's image processor with the Pillow backend.

    This backend gives the same results with and without torchvision.
    """
    return _translate_load_errors(
        checkpoint,
        lambda: transformers.AutoImageProcessor.from_pretrained(checkpoint.folder, backend="pil"),
    )


def _load_network(transformers: Any, checkpoint: Checkpoint) -> Any:
    """Return the network in evaluation mode.

    Raises ``MethodError`` if weights are missing, which ``transformers`` itself would leave at random values.
    """
    model, loading_info = _translate_load_errors(
        checkpoint,
        lambda: transformers.AutoModelForDepthEstimation.from_pretrained(
            checkpoint.folder, dtype="float32", output_loading_info=True, local_files_only=True
        ),
    )
    missing = sorted(loading_info["missing_keys"])
    if missing:
        raise MethodError(
            f"{checkpoint.name}: the weights lack {len(missing)} of the network's tensors, first {missing[0]}, "
            "expected all of them"
        )
    if getattr(model, "use_fov_model", False):
        model.use_fov_model = False  # The field-of-view head estimates the focal length, which is known here.
    return model.eval()


def _translate_load_errors(checkpoint: Checkpoint, load: Callable[[], Any]) -> Any:
    """Return ``load()``. Raises ``MethodError`` for any exception."""
    try:
        return load()
    except Exception as error:  # Readers of damaged files raise various types.
        raise MethodError(f"{checkpoint.name}: cannot be loaded: {exception_summary(error)}") from error


DEPTH_PRO = Method(
    MethodInfo(
        name="depth-pro",
        summary=f"Depth Pro from one picture: {OutputKind.CANONICAL.value}, as in the paper; "
        "own weights: hf:FOLDER",
        columns=_columns(OutputKind.CANONICAL),
        uses_intrinsics=True,
        source=f"transformers, {DEPTH_PRO_CHECKPOINT}",
        licence="Apple's own; it comes with the weights",
        untested_note="not tested with the real weights: they were not available",
    ),
    lambda: load_predictor(find_checkpoint(DEPTH_PRO_CHECKPOINT)),
)
"""Depth Pro as in the paper; loading takes the weights from the Hub or its cache."""


def depth_pro_method() -> Method:
    """Return Depth Pro as in the paper, with the commit of its weights in the summary.

    Raises like ``hf_method``.
    """
    method = hf_method(DEPTH_PRO_CHECKPOINT)
    return replace(method, info=replace(DEPTH_PRO.info, summary=method.info.summary))
