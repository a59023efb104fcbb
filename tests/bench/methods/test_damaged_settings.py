"""Damaged settings of checkpoints: ``config.json``, ``preprocessor_config.json`` and ``cfg.yaml``."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

pytest.importorskip("torch")
pytest.importorskip("transformers")

from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.methods import find_method
from rebar_depth_bench.methods.transformers import hf_method
from tests.bench.methods import stand_in_models as stand_ins
from tests.bench.methods.predictors import load_predictor
from tests.bench.methods.tiny_depth_models import save_checkpoint

NO_OBJECT = {
    "empty": b"",
    "text": b"{",
    "list": b"[]",
    "number": b"1",
    "null": b"null",
    "not UTF-8": b'{"model_type": "\xff"}',
    "deep": b'{"x": ' + b"[" * 100_000 + b"]" * 100_000 + b"}",
    "long integer": b'{"x": ' + b"9" * 5000 + b"}",
    "not a number": b'{"x": NaN}',
    "twice": b'{"model_type": "dpt", "model_type": "glpn"}',
    "surrogate": rb'{"x": "\ud800"}',
}


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_checkpoint(tmp_path_factory.mktemp("damaged") / "checkpoint", "dpt")


@pytest.mark.parametrize("content", NO_OBJECT.values(), ids=NO_OBJECT)
@pytest.mark.parametrize("name", ["config.json", "preprocessor_config.json"])
def test_damaged_settings_of_transformers_raise(name: str, content: bytes, checkpoint: Path) -> None:
    good = (checkpoint / name).read_bytes()
    (checkpoint / name).write_bytes(content)
    try:
        with pytest.raises(MethodError) as caught:
            hf_method(str(checkpoint)).load()
    finally:
        (checkpoint / name).write_bytes(good)
    assert str(caught.value).startswith(f"{checkpoint / name}: ")
    assert caught.value.problems


@pytest.mark.parametrize("content", NO_OBJECT.values(), ids=NO_OBJECT)
def test_damaged_preset_raises(content: bytes, tmp_path: Path) -> None:
    folder = stand_ins.da3_weights(tmp_path / "theirs")
    (folder / "config.json").write_bytes(content)
    with pytest.raises(MethodError) as caught:
        find_method(f"depth-anything-3:{folder}")
    assert caught.value.problems


@pytest.mark.parametrize("value", ['["x"]', '{"a": 1}', "7", '"' + "x" * 10_000 + '"', r'"\u001b[31m"'])
@pytest.mark.parametrize("prefix", ["hf", "depth-anything-3"])
def test_wrong_model_name_is_shown_shortened(prefix: str, value: str, tmp_path: Path) -> None:
    folder = stand_ins.da3_weights(tmp_path / "theirs")
    (folder / "config.json").write_text(f'{{"model_type": {value}, "model_name": {value}}}')
    with pytest.raises(MethodError, match="expected") as caught:
        find_method(f"{prefix}:{folder}")
    assert len(str(caught.value)) < 600
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("backbone", ["[]", '["x"]', '"dinov2"', "3", "null"])
def test_backbone_of_wrong_type_is_not_dinov2(backbone: str, tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(f'{{"model_type": "dpt", "backbone_config": {backbone}}}')
    assert "up to scale" in find_method(f"hf:{tmp_path}").info.summary


@pytest.mark.parametrize("prefix", ["hf", "depth-anything-3"])
def test_named_pipe_and_large_file_are_refused(
    prefix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = stand_ins.da3_weights(tmp_path / "theirs")
    (folder / "config.json").write_text(f'{{"x": "{"x" * 1000}"}}')
    monkeypatch.setenv("REBAR_MAX_JSON_BYTES", "1000")
    with pytest.raises(MethodError, match=r"at most 1000 bytes|REBAR_MAX_JSON_BYTES"):
        find_method(f"{prefix}:{folder}")
    (folder / "config.json").unlink()
    os.mkfifo(folder / "config.json")
    with pytest.raises(MethodError, match=r"named pipe|no config\.json"):
        find_method(f"{prefix}:{folder}")


YAML = {
    "alias": b"a: &a 1\nb: *a\n",
    "alias bomb": b"a: &a [x, x]\n"
    + b"".join(b"%c: &%c [*%c, *%c]\n" % (i, i, i - 1, i - 1) for i in range(98, 122)),
    "merge bomb": b"a: &a {x: 1}\n"
    + b"".join(b"%c: &%c {<<: [*%c, *%c]}\n" % (i, i, i - 1, i - 1) for i in range(98, 122)),
    "object": b"!!python/object/apply:os.system ['true']",
    "object in a mapping": b"a: !!python/object/apply:os.system ['true']",
    "list": b"- 1\n",
    "empty": b"",
    "text": b"max_disp",
    "syntax": b"{",
    "deep": b"a: " + b"[" * 5000 + b"]" * 5000,
    "deep blocks": b"".join(b" " * level + b"a:\n" for level in range(500)),
    "control": b"a: \x00",
    "not UTF-8": b"a: \xff\xff",
    "year": b"a: 9999-99-99",
}


@pytest.mark.parametrize("content", YAML.values(), ids=YAML)
def test_damaged_yaml_raises(content: bytes, tmp_path: Path) -> None:
    folder = stand_ins.stereo_clone(tmp_path / "theirs")
    path = folder / "pretrained_models" / "23-51-11" / "cfg.yaml"
    path.write_bytes(content)
    with pytest.raises(MethodError) as caught:
        load_predictor(f"foundation-stereo:{folder}")
    assert str(path) in str(caught.value)
