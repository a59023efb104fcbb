"""Training of a small depth network on generated cages, its export to ONNX, and its score beside references.

    SIZE="--width 320 --height 180 --quality preview"
    rebar-build --out ROOT --config cages --split train --scenes 32 --views-per-scene 6 $SIZE
    rebar-build --out ROOT --config cages --split validation --scenes 8 --views-per-scene 3 $SIZE
    rebar-build --out ROOT --config cages --split test --scenes 24 --views-per-scene 3 $SIZE
    rebar-build --out ROOT --config lattice pile pier --views 24 $SIZE
    OMP_NUM_THREADS=1 python examples/finetune.py ROOT --out finetuned --crop 144 256

It needs ``pip install '.[torch,onnx,methods]' onnx`` and torch 2.5 or later, and uses only the public interface
(``docs/api.md``) and the manifest (``docs/formats.md``). ``finetuned/`` then holds the weights of the last epoch
(``checkpoint.pt``), the network as ``finetuned.onnx`` with ``finetuned.toml``, which
``rebar-bench predict finetuned/finetuned.toml --data ROOT`` takes, and an archive ``METHOD-CONFIG-SPLIT.zip`` for
each row of the table that is printed.

**What the network predicts.** An image shows the ratio of bar diameter to distance, times the focal length: it
cannot tell a long focal length from a short distance. The network therefore predicts canonical depth, the depth
that a camera of ``FOCAL_PX`` would need for the same image, and the TOML file says so (Yin et al., "Metric3D",
ICCV 2023, section 3.2). Crops and flips do not change it. The output is a logarithm, so that relative errors
count alike at 0.3 m and 8 m.

**What it is trained for.** The loss is the mean absolute error of the logarithm on steel, averaged over images as
the protocol does, plus ``FRAME_WEIGHT`` times that of all pixels with a surface. For a logarithmic error e, the
rank error of a pixel is 1 - exp(-|e|). Both images of each stereo pair are used, and no other data or weights.

**What it prints.** After each epoch, the errors on the training views and, if the folder has it, on the split
``validation``, which ``rdb.Evaluator`` computes; at the end, the table of the exported network on the configs
``TARGETS`` that the folder has, beside two references. ``constant`` predicts one canonical depth at every pixel,
the median of the training views: what can be known without looking at an image. SGBM uses both images.

The same command continues an interrupted training after its last complete epoch, with the result that an
uninterrupted one has. The same ``--seed``, ``--epochs``, ``--batch`` and ``--crop`` give the same weights on the
same machine with the same number of threads and the same version of torch.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import torch
from datasets import Dataset
from torch import Tensor, nn
from torch.nn import functional

import rebar_depth_bench as rdb

CONFIG = "cages"
TARGETS = ((CONFIG, "validation"), (CONFIG, "test"), ("lattice", "test"), ("pile", "test"), ("pier", "test"))
"""Configs and splits that are scored, if the folder has them."""
NUMBERS = {
    "rank error": "rank_error",
    "AbsRel": "native.abs_rel",
    "AbsRel scaled": "scaled.abs_rel",
    "plane, scaled": "reference.scaled_constant.abs_rel",
    "within 5 mm": "within_mm.5",
    "coverage": "coverage",
}
"""Numbers of the printed table by their headings; "plane, scaled" is a plane at one depth after scaling."""
FOCAL_PX = 200.0
"""Focal length of the canonical camera, pixels of the images that the network is trained on."""
MEAN, STD = 0.5, 0.25
"""Normalisation of colour, in units of white."""
CHANNELS = (8, 16, 32, 64, 96, 128)
"""Channels at half, quarter, ... resolution: 620,000 parameters."""
FRAME_WEIGHT = 0.3
"""Weight of all surfaces: the ground and the horizon show how far the steel is."""
LEARNING_RATE, WEIGHT_DECAY, WARM_UP = 2e-3, 1e-2, 0.05
"""Peak of the learning rate, which rises over the share ``WARM_UP`` of the training and falls as a cosine."""
GAINS = (0.6, 1.5)
"""Range of the random factors of brightness in training."""


KEYS = ("rgb", "depth", "mask", "K")
COLUMNS = [
    *("view_id", "baseline_m"),
    *(f"{eye}_{kind}" for eye in ("left", "right") for kind in (*KEYS, "cam_from_world")),
]
"""Keys of a batch that are trained with, and the columns of its rows."""


def _convolution(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, padding=1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU()
    )


class DepthNet(nn.Module):
    """U-Net for images of any size: normalised colour B x 3 x H x W to log canonical depth B x 1 x H x W.

    Each resolution is reached by a convolution with stride 2, and the finest one, at which depth is computed, is
    half of the image's, which takes a quarter of the time. Features of the coarser one are enlarged to the nearest
    neighbour, which keeps the edges of bars, and added to those of the finer one. The coarsest features also give
    a smooth depth of the scene, to which the finer ones add details.
    """

    def __init__(self) -> None:
        super().__init__()
        self.stem = _convolution(3, CHANNELS[0], 2)
        steps = list(itertools.pairwise(CHANNELS))
        self.down = nn.ModuleList(
            nn.Sequential(_convolution(fine, coarse, 2), _convolution(coarse, coarse)) for fine, coarse in steps
        )
        self.narrow = nn.ModuleList(nn.Conv2d(coarse, fine, 1) for fine, coarse in steps)
        self.merge = nn.ModuleList(_convolution(fine, fine) for fine, _ in steps)
        self.scene = nn.Conv2d(CHANNELS[-1], 1, 1)
        self.details = nn.Conv2d(CHANNELS[0], 1, 3, padding=1)

    def forward(self, image: Tensor) -> Tensor:
        """Return the logarithm of canonical depth in metres."""
        levels = [self.stem(image)]
        for down in self.down:
            levels.append(down(levels[-1]))
        features = levels.pop()
        scene = functional.interpolate(self.scene(features), size=levels[0].shape[-2:], mode="bilinear")
        for narrow, merge in zip(reversed(self.narrow), reversed(self.merge), strict=True):
            finer = levels.pop()
            features = merge(finer + functional.interpolate(narrow(features), size=finer.shape[-2:]))
        return functional.interpolate(scene + self.details(features), size=image.shape[-2:])


class _Exported(nn.Module):
    """Network whose output is canonical depth in metres, as the TOML file describes."""

    def __init__(self, net: DepthNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, image: Tensor) -> Tensor:
        log_depth: Tensor = self.net(image)
        return log_depth.exp()


@dataclass
class Training:
    """State of a training: network, optimiser, complete epochs, and the seconds that they took.

    ``plan`` holds what determines the weights: training continues a checkpoint of the same plan only.
    """

    plan: dict[str, Any]
    net: DepthNet
    optimiser: torch.optim.Optimizer
    epoch: int = 0
    seconds: float = 0.0

    @classmethod
    def start(cls, plan: dict[str, Any]) -> Training:
        """Return a training with random weights of the seed."""
        torch.manual_seed(plan["seed"])
        # Channels last are a third faster on a CPU.
        net: DepthNet = DepthNet().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        optimiser = torch.optim.AdamW(net.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY)
        return cls(plan, net, optimiser)

    @classmethod
    def open(cls, path: Path, plan: dict[str, Any]) -> Training:
        """Return the training of a checkpoint, or a new one. Raises ``InputError`` if it is of another plan."""
        training = cls.start(plan)
        if path.exists():
            try:
                saved = torch.load(path, weights_only=True)
            except Exception as error:  # torch raises many types, which depend on the damage.
                raise rdb.InputError(
                    f"{path}: cannot be read ({type(error).__name__}); delete it to start over"
                ) from None
            if saved["plan"] != plan:
                changed = [name for name in plan if saved["plan"].get(name) != plan[name]]
                raise rdb.InputError(f"{path}: was trained with other {', '.join(changed)}; choose another --out")
            training.net.load_state_dict(saved["net"])
            training.optimiser.load_state_dict(saved["optimiser"])
            training.epoch, training.seconds = saved["epoch"], saved["seconds"]
        return training

    def save(self, path: Path) -> None:
        """Write the checkpoint atomically."""
        saved = {"net": self.net.state_dict(), "optimiser": self.optimiser.state_dict()}
        temporary = path.with_suffix(".partial")
        torch.save({"plan": self.plan, "epoch": self.epoch, "seconds": self.seconds, **saved}, temporary)
        temporary.replace(path)


def images(batch: dict[str, Any]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return colour (0 to 1), log canonical depth, and masks of steel and of all surfaces of both eyes.

    All are float32, B x C x H x W with C = 3 or 1, where B is twice the number of pairs.
    """
    rgb, depth_m, steel, K = (torch.cat([batch[f"{eye}{key}"] for eye in ("", "right_")]) for key in KEYS)
    is_surface = depth_m > 0
    factor = (FOCAL_PX / K[:, 0, 0]).float()[:, None, None, None]
    target = torch.where(is_surface, depth_m * factor, torch.ones_like(depth_m)).log()
    return rgb.float() / 255, target, (steel & is_surface).float(), is_surface.float()


def image_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Return the mean over the images that have masked pixels of the mean over these pixels."""
    pixels = mask.sum((1, 2, 3))
    means = (values * mask).sum((1, 2, 3)) / pixels.clamp(min=1)
    return means.sum() / (pixels > 0).sum().clamp(min=1)


def train_epoch(training: Training, batches: Sequence[dict[str, Any]] | Any) -> tuple[float, float]:
    """Train one epoch, and return the mean errors of the logarithm on steel and on all surfaces."""
    random = torch.Generator().manual_seed(training.plan["seed"] + training.epoch)
    sums = [0.0, 0.0]
    for step, batch in enumerate(batches):
        share = (training.epoch + step / len(batches)) / training.plan["epochs"]
        for group in training.optimiser.param_groups:
            group["lr"] = LEARNING_RATE * min(share / WARM_UP + 0.01, 0.5 + 0.5 * math.cos(math.pi * share))
        rgb, target, steel, surface = images(batch)
        low, high = GAINS
        gain = low + (high - low) * torch.rand(len(rgb), 1, 1, 1, generator=random)
        error = (training.net((rgb * gain).clamp(max=1).sub(MEAN).div(STD)) - target).abs()
        steel_error, frame_error = image_mean(error, steel), image_mean(error, surface)
        training.optimiser.zero_grad()
        (steel_error + FRAME_WEIGHT * frame_error).backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(training.net.parameters(), 1.0)
        training.optimiser.step()
        sums = [sums[0] + steel_error.item(), sums[1] + frame_error.item()]
    return sums[0] / len(batches), sums[1] / len(batches)


def validate(net: DepthNet, evaluator: rdb.Evaluator, batch_size: int) -> str:
    """Return the errors of the depth that a network predicts for the views of an evaluator, as text."""
    evaluator.reset()
    net.eval()
    with torch.inference_mode():
        for batch in rdb.torch_loader(evaluator.dataset, batch_size):
            factor = (batch["K"][:, 0, 0] / FOCAL_PX)[:, None, None, None]
            canonical_m = net(batch["rgb"].float().div(255).sub(MEAN).div(STD)).exp()
            evaluator.update(batch["view_id"], canonical_m * factor)
    net.train()
    metrics = evaluator.compute().metrics
    rank_error, abs_rel = metrics[f"{CONFIG}/rank_error"], metrics[f"{CONFIG}/native/abs_rel"]
    return f"; validation: rank error {rank_error:.4f}, AbsRel {abs_rel:.4f}"


def train(options: argparse.Namespace, views: Dataset, checkpoint: Path) -> DepthNet:
    """Return the network, trained for ``--epochs``; print the errors of each epoch."""
    evaluator = None
    if has_views(options.root, CONFIG, "validation"):
        evaluator = rdb.Evaluator(options.root, CONFIG, split="validation")
    plan = {name: getattr(options, name) for name in ("seed", "epochs", "crop", "batch")}
    plan |= {"views": list(views["view_id"]), "channels": list(CHANNELS), "torch": str(torch.__version__)}
    training = Training.open(checkpoint, plan)
    start = time.monotonic() - training.seconds
    while training.epoch < options.epochs:
        # A loader of its own for each epoch: order and crops do not depend on interruptions.
        loader = rdb.torch_loader(
            views,
            options.batch,
            options.workers,
            shuffle=True,
            stereo=True,
            crop=options.crop,
            flip=True,
            seed=options.seed * 100_000 + training.epoch,
        )
        steel, frame = train_epoch(training, loader)
        training.epoch, training.seconds = training.epoch + 1, time.monotonic() - start
        training.save(checkpoint)
        validation = validate(training.net, evaluator, options.batch) if evaluator else ""
        left_s = training.seconds * (options.epochs / training.epoch - 1)
        notice(
            f"epoch {training.epoch} of {options.epochs}: mean error of log depth {steel:.3f} on steel, "
            f"{frame:.3f} on all surfaces{validation}; {timedelta(seconds=round(left_s))} left"
        )
    return training.net


def has_views(root: str, config: str, split: str) -> bool:
    """Return whether the manifest of a dataset folder has views of a split of a config; print if it has not.

    ``rdb.load`` raises ``DatasetError`` for a damaged split as well as for a missing one.
    """
    configs = json.loads((Path(root) / "manifest.json").read_text())["configs"]
    found = config in configs and any(scene["split"] == split for scene in configs[config]["scenes"])
    if not found:
        notice(f"{config}, {split}: left out, since {root} has no such views")
    return found


def notice(message: str) -> None:
    """Print a message to standard error."""
    print(message, file=sys.stderr, flush=True)


def export(net: DepthNet, out: Path, width: int, height: int) -> Path:
    """Write ``finetuned.onnx`` for images of any size, and ``finetuned.toml``, whose path is returned."""
    sides = {2: "height", 3: "width"}
    temporary = out / "finetuned.partial"
    with warnings.catch_warnings():
        # This exporter is deprecated, but the new one needs onnxscript.
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(
            _Exported(net).eval(),
            (torch.zeros(1, 3, height, width),),
            str(temporary),
            dynamo=False,
            input_names=["image"],
            output_names=["canonical_depth"],
            dynamic_axes={"image": sides, "canonical_depth": sides},
        )
    temporary.replace(out / "finetuned.onnx")
    temporary.write_text(
        f"""model = "finetuned.onnx"
name = "finetuned"
summary = "small U-Net trained on generated cages"
source = "examples/finetune.py of rebar-depth-bench"
licence = "CC-BY-4.0"

[input]
longest_side = {width}
resize = "stretch"
range = 1
mean = [{MEAN}, {MEAN}, {MEAN}]
std = [{STD}, {STD}, {STD}]

[output]
meaning = "canonical-depth"
focal_canonical_px = {FOCAL_PX:g}
""",
    )
    return temporary.replace(out / "finetuned.toml")


def median_canonical_m(views: Dataset) -> float:
    """Return the median canonical depth of steel of the training views: the median over views of their medians."""
    medians = []
    for row in views.select_columns(["left_depth", "left_mask", "left_K"]):
        is_steel = row["left_mask"] & (row["left_depth"] > 0)
        if is_steel.any():
            medians.append(np.median(row["left_depth"][is_steel]) * FOCAL_PX / row["left_K"][0, 0])
    return float(np.median(medians))


def score_rows(root: str, toml: Path, constant_m: float) -> Iterator[Sequence[str]]:
    """Yield the rows of the table: for each config of the folder, those of the network, the constant and SGBM."""

    def constant(row: dict[str, Any]) -> np.ndarray:
        height, width, _ = row["left_rgb"].shape
        return np.full((height, width), constant_m * row["left_K"][0, 0] / FOCAL_PX)

    declared = {"method": "constant", "inputs": "rgb+K", "uses_ground_truth": False}
    methods: dict[str, tuple[Any, dict[str, Any]]] = {
        "finetuned": (str(toml), {}),
        "constant": (constant, declared),
        "sgbm": ("sgbm", {}),
    }
    for config, split in TARGETS:
        if not has_views(root, config, split):
            continue
        for name, (model, options) in methods.items():
            archive = toml.parent / f"{name}-{config}-{split}.zip"
            result = rdb.evaluate(model, root, config=config, split=split, archive=archive, **options)
            table = result.tables[config]
            yield (
                f"{config}, {split}",
                name,
                str(table.views),
                *(f"{table[place]:.4f}" for place in NUMBERS.values()),
            )


def run(options: argparse.Namespace) -> None:
    """Train, export, predict and score; print the table as Markdown."""
    if not Path(options.root).is_dir():
        raise rdb.InputError(f"{options.root}: is not a folder, expected a local dataset folder")
    views = rdb.load(options.root, CONFIG, split="train", columns=COLUMNS)
    if missing := [name for name, cell in views[0].items() if cell is None]:
        raise rdb.InputError(
            f"{options.root}: the config {CONFIG} has no {', '.join(missing)}, which training needs"
        )
    options.out.mkdir(parents=True, exist_ok=True)
    net = train(options, views, options.out / "checkpoint.pt")
    height, width, _ = views[0]["left_rgb"].shape
    toml = export(net, options.out, width, height)
    print(f"| config | method | views | {' | '.join(NUMBERS)} |")
    print("|---" * (3 + len(NUMBERS)) + "|")
    for row in score_rows(options.root, toml, median_canonical_m(views)):
        print(f"| {' | '.join(row)} |", flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the example and return its exit status."""
    parser = argparse.ArgumentParser(description="train a small depth network on the config cages and score it")
    parser.add_argument("root", metavar="ROOT", help="dataset folder with the split train of cages")
    parser.add_argument("--out", type=Path, default=Path("finetuned"), metavar="FOLDER", help="default: finetuned")
    parser.add_argument("--epochs", type=int, default=120, help="number of passes over the views (default: 120)")
    parser.add_argument("--crop", type=int, nargs=2, metavar=("HEIGHT", "WIDTH"), help="size of random crops")
    parser.add_argument("--batch", type=int, default=4, help="stereo pairs in a batch (default: 4)")
    parser.add_argument("--workers", type=int, default=1, help="processes that load views (default: 1)")
    parser.add_argument("--seed", type=int, default=0, help="seed of weights, order, crops and flips (default: 0)")
    options = parser.parse_args(arguments)
    if min(options.epochs, options.batch) < 1 or options.workers < 0:
        parser.error("--epochs and --batch must be 1 or more, --workers 0 or more")
    try:
        run(options)
    except rdb.RebarDepthError as error:
        notice(f"error: {error}")
        return 2 if isinstance(error, rdb.InputError) else 1
    except KeyboardInterrupt:
        notice("interrupted; the same command continues after the last epoch")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
