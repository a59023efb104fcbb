"""Predictions kept view by view while a method runs, so that an interruption costs one view."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from rebar_depth_bench.errors import InputError
from rebar_depth_bench.files import replacing, write_text

_KEY = "key.json"


@dataclass(frozen=True)
class Preparation:
    """What a method that sees a whole config found on the way, plain JSON values, and how long it took.

    ``seconds`` is None where an interrupted run left part of the work done.
    """

    notes: Mapping[str, Any]
    seconds: float | None


@dataclass(frozen=True)
class PredictedViews:
    """A folder with a file per predicted view, each whole or not there."""

    path: Path

    @classmethod
    def open(cls, path: Path, key: Mapping[str, Any]) -> PredictedViews:
        """Open the folder at ``path``, emptied if it was made for another ``key``: what decides the predictions.

        Raises ``InputError`` where it cannot be written.
        """
        wanted = json.dumps(key, sort_keys=True)
        try:
            if (path / _KEY).is_file() and (path / _KEY).read_text() == wanted:
                return cls(path)
            shutil.rmtree(path, ignore_errors=True)
            path.mkdir(parents=True)
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror}") from None
        write_text(path / _KEY, wanted)
        return cls(path)

    def __len__(self) -> int:
        return sum(1 for _ in self.path.glob("*/*.npz"))

    def __contains__(self, view_id: str) -> bool:
        return self._file(view_id).is_file()

    def put(self, view_id: str, depth_m: Float[ndarray, "h w"], seconds: float) -> None:
        """Keep a view's depth and how long it took."""
        with replacing(self._file(view_id)) as temporary, temporary.open("wb") as stream:
            np.savez(stream, depth_m=depth_m, seconds=seconds)

    def get(self, view_id: str) -> tuple[Float[ndarray, "h w"], float]:
        """Return a kept view's depth and seconds."""
        with np.load(self._file(view_id), allow_pickle=False) as kept:
            return kept["depth_m"], float(kept["seconds"])

    def work(self, config: str) -> Path:
        """Return a config's folder for what a method keeps between interruptions, made if it is not there."""
        folder = self.path / f"{config}.work"
        folder.mkdir(exist_ok=True)
        return folder

    def put_preparation(self, config: str, preparation: Preparation) -> None:
        """Keep what preparing a config found."""
        write_text(self._preparation(config), json.dumps(vars(preparation)))

    def get_preparation(self, config: str) -> Preparation | None:
        """Return what preparing a config found, None where it never came to an end."""
        path = self._preparation(config)
        return Preparation(**json.loads(path.read_text())) if path.is_file() else None

    def _file(self, view_id: str) -> Path:
        return self.path / f"{view_id}.npz"

    def _preparation(self, config: str) -> Path:
        return self.path / f"{config}.json"
