"""Monocular depth models of ``transformers``, by the name of a checkpoint: ``hf:ORG/NAME`` or ``hf:FOLDER``.

Depth comes back on the left grid by the interpolation of each model's own post-processing: bilinear for Depth Pro,
bicubic for the others. Between a bar and what is behind it that invents depths, as these models do for every user.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods.base import Method, MethodInfo, Predictor
from rebar_depth_bench.methods.huggingface.checkpoints import Checkpoint, complete, find_checkpoint, preprocessor
from rebar_depth_bench.methods.huggingface.families import Output, depth_m, family_of

PREFIX = "hf:"
DEPTH_PRO_CHECKPOINT = "apple/DepthPro-hf"
_PRE_PROCESSED_HERE = ("depth_pro",)


def hf_method(name_or_path: str) -> Method:
    """Return the method that runs a checkpoint: ``ORG/NAME`` on the Hub, or a folder of ``save_pretrained``.

    Its ``config.json`` is read (and, from the Hub, fetched) at once, for it says whether the output is metres or
    up to scale; weights are fetched by ``load``. What is fetched is said on standard error first.

    Raises ``MethodError`` for what is no checkpoint, or of a model that cannot be run here.
    """
    checkpoint = find_checkpoint(name_or_path)
    family = family_of(checkpoint.config, checkpoint.name)
    output = family.output(checkpoint.config)
    info = MethodInfo(
        name=f"{PREFIX}{checkpoint.name}",
        summary=f"{family.name} from one picture: {output.value}; weights {checkpoint.version}",
        columns=_columns(output),
        uses_intrinsics=output is Output.CANONICAL,
        source=f"transformers, {checkpoint.name}",
        licence="that of the checkpoint",
    )
    return Method(info, lambda: load_predictor(checkpoint))


def load_predictor(checkpoint: Checkpoint) -> Predictor:
    """Load a checkpoint's network, on the GPU if torch sees one.

    Raises ``MethodError`` where torch, ``transformers`` or weights are missing, or do not fill the network.
    """
    family = family_of(checkpoint.config, checkpoint.name)
    torch, transformers = _packages()
    complete(checkpoint)
    from rebar_depth_bench.methods.huggingface.families import PREPARATIONS

    kind = checkpoint.config["model_type"]
    settings = preprocessor(checkpoint)
    processor = None if kind in _PRE_PROCESSED_HERE else _processor(transformers, checkpoint)
    try:
        prepare = PREPARATIONS[kind](settings, processor)
    except KeyError as error:
        raise MethodError(f"{checkpoint.name}: preprocessor_config.json has no {error}") from None
    model = _network(transformers, checkpoint).to("cuda" if torch.cuda.is_available() else "cpu")
    output = family.output(checkpoint.config)

    def run(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
        rgb = row["left_rgb"]
        with torch.inference_mode():
            found = model(pixel_values=prepare.pixels(rgb).to(model.device)).predicted_depth[0]
            values = prepare.on_left_grid(found.float().cpu(), rgb.shape[:2])
        return depth_m(output, np.asarray(values.numpy()), row.get("left_K"))

    return run


def _columns(output: Output) -> tuple[str, ...]:
    return ("left_rgb", "left_K") if output is Output.CANONICAL else ("left_rgb",)


def _packages() -> tuple[Any, Any]:
    """Return torch and ``transformers``, untyped: they are imported nowhere else, and need not be installed."""
    try:
        return importlib.import_module("torch"), importlib.import_module("transformers")
    except ImportError as error:
        raise MethodError(
            f"monocular models need torch and transformers ({error}): pip install 'rebar-depth-bench[models]'"
        ) from None


def _processor(transformers: Any, checkpoint: Checkpoint) -> Any:
    """Return the library's pre-processing, its Pillow kind: the same everywhere, with torchvision or without."""
    return _loaded(
        checkpoint,
        lambda: transformers.AutoImageProcessor.from_pretrained(checkpoint.folder, backend="pil"),
    )


def _network(transformers: Any, checkpoint: Checkpoint) -> Any:
    """Return the network, every weight filled: ``transformers`` itself leaves missing ones at random values."""
    model, told = _loaded(
        checkpoint,
        lambda: transformers.AutoModelForDepthEstimation.from_pretrained(
            checkpoint.folder, dtype="float32", output_loading_info=True, local_files_only=True
        ),
    )
    missing = sorted(told["missing_keys"])
    if missing:
        raise MethodError(
            f"{checkpoint.name}: the weights lack {len(missing)} of the network's tensors, first {missing[0]}, "
            "expected all of them"
        )
    if getattr(model, "use_fov_model", False):
        model.use_fov_model = False  # it guesses the focal length, which is given
    return model.eval()


def _loaded(checkpoint: Checkpoint, load: Callable[[], Any]) -> Any:
    try:
        return load()
    except Exception as error:  # damaged files raise whatever reads them
        first = (str(error).strip().splitlines() or [""])[0]
        raise MethodError(f"{checkpoint.name}: cannot be loaded: {type(error).__name__}: {first}") from error


DEPTH_PRO = Method(
    MethodInfo(
        name="depth-pro",
        summary=f"Depth Pro from one picture: {Output.CANONICAL.value}, as in the paper; own weights: hf:FOLDER",
        columns=_columns(Output.CANONICAL),
        uses_intrinsics=True,
        source=f"transformers, {DEPTH_PRO_CHECKPOINT}",
        licence="Apple's own; it comes with the weights",
        unexercised="never run with its real weights where this was written: they were not to be had",
    ),
    lambda: load_predictor(find_checkpoint(DEPTH_PRO_CHECKPOINT)),
)
"""The paper's Depth Pro. Its weights come from the Hub, or its cache, when it is loaded."""


def depth_pro_method() -> Method:
    """Return the paper's Depth Pro with the commit of its weights in the summary; raises as ``hf_method`` does."""
    found = hf_method(DEPTH_PRO_CHECKPOINT)
    return replace(found, info=replace(DEPTH_PRO.info, summary=found.info.summary))
