"""Files of a FoundationStereo installation: a clone of its repository, a checkpoint and its settings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rebar_depth_bench.errors import MethodError, exception_summary
from rebar_depth_bench.limits import TOML_BYTES
from rebar_depth_bench.methods.monocular.third_party import import_package
from rebar_depth_bench.reading import MAX_NESTING, read_file
from rebar_depth_bench.validation import short_repr

NAME = "foundation-stereo"
CODE_FILE, SETTINGS_FILE, CHECKPOINT_FILE = "core/foundation_stereo.py", "cfg.yaml", "model_best_bp2.pth"
WEIGHTS_FOLDER = Path("pretrained_models", "23-51-11")
INSTALL_HINT = (
    "git clone https://github.com/NVlabs/FoundationStereo, put the folder 23-51-11 linked in its readme (Google "
    f"Drive) into FoundationStereo/{WEIGHTS_FOLDER.parent}, install its requirements, and pass the clone as "
    f"{NAME}:FoundationStereo"
)


@dataclass(frozen=True)
class Installation:
    """Folders of a FoundationStereo installation.

    ``clone`` is a clone of the repository, ``weights`` a folder with a checkpoint and its ``cfg.yaml``.
    """

    clone: Path
    weights: Path


class Settings(dict[str, Any]):
    """Dictionary with attribute access, which is all that the network requires of its settings."""

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(f"{SETTINGS_FILE} has no {name}") from None


def find_installation(folder: Path) -> Installation:
    """Return the clone and weights folders for a folder given by the user.

    Raises ``MethodError`` if code, checkpoint or settings are missing.
    """
    weights = folder if (folder / CHECKPOINT_FILE).is_file() else folder / WEIGHTS_FOLDER
    start = folder.resolve()
    clone = next((candidate for candidate in (start, *start.parents) if (candidate / CODE_FILE).is_file()), None)
    if not folder.is_dir() or clone is None:
        raise MethodError(
            f"{NAME}:{folder}: no clone of FoundationStereo with {CODE_FILE}; to install it: {INSTALL_HINT}"
        )
    for name in (CHECKPOINT_FILE, SETTINGS_FILE):
        if not (weights / name).is_file():
            raise MethodError(f"{NAME}:{folder}: no {name} in {weights}; to install it: {INSTALL_HINT}")
    return Installation(clone, weights)


def read_settings(installation: Installation) -> Settings:
    """Return the network's settings. Raises ``MethodError`` if they or the end of its cost volume are invalid."""
    yaml = import_package("yaml", NAME, "pip install pyyaml")
    path = installation.weights / SETTINGS_FILE
    settings = _read_yaml(yaml, path)
    settings.setdefault("vit_size", "vitl")
    volume_px = settings.get("max_disp")
    if type(volume_px) is not int or volume_px <= 0:
        raise MethodError(
            f"{path}: max_disp is {short_repr(volume_px)}, expected the end of the cost volume, whole pixels"
        )
    return settings


def _read_yaml(yaml: Any, path: Path) -> Settings:
    """Return the content of a YAML file. Raises ``MethodError`` if it is no plain mapping.

    Aliases let a small file grow without bounds; the settings of the network have none.
    """
    text = read_file(path, TOML_BYTES, "a YAML file", MethodError)
    starts = (yaml.FlowSequenceStartToken, yaml.FlowMappingStartToken, yaml.BlockMappingStartToken)
    ends = (yaml.FlowSequenceEndToken, yaml.FlowMappingEndToken, yaml.BlockEndToken)
    depth = 0
    try:
        for token in yaml.scan(text):
            depth += isinstance(token, (*starts, yaml.BlockSequenceStartToken)) - isinstance(token, ends)
            if isinstance(token, yaml.AliasToken) or depth > MAX_NESTING:
                raise MethodError(
                    f"{path}: has an alias or more than {MAX_NESTING} levels, expected plain settings"
                )
        values = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError) as error:
        raise MethodError(f"{path}: cannot be read as YAML: {exception_summary(error)}") from None
    if not isinstance(values, dict):
        raise MethodError(f"{path}: is {type(values).__name__}, expected a mapping")
    return Settings(values)
