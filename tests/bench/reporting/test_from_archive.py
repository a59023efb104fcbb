"""HTML report of an archive scored on the tiny rendered dataset."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest

from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.data import codecs
from rebar_depth_bench.diagnosis.corrections import MAX_VIEWS
from rebar_depth_bench.reporting.html.page import write_report
from rebar_depth_bench.scoring.evaluation import open_evaluation, score_evaluation


def test_report_embeds_requested_views_worst_first(
    tiny_root: Path, tiny_truth: dict[str, np.ndarray], archive_of: Callable[..., Path], tmp_path: Path
) -> None:
    factors = 1.1 + 0.05 * np.random.default_rng(3).permutation(len(tiny_truth))
    archive = archive_of(
        {view: depth_m * factor for (view, depth_m), factor in zip(tiny_truth.items(), factors, strict=True)}
    )
    with open_evaluation(archive, tiny_root) as evaluation:
        result = score_evaluation(evaluation)
        worst_first = [view.view_id for view in sorted(result.views, key=attrgetter("rank_error"), reverse=True)]
        page = tmp_path / "page.html"
        write_report(result, evaluation, page, views_shown=3)
        text = page.read_text(encoding="utf-8")
        assert re.findall(r"<h3>(lattice/\d+)</h3>", text) == [*worst_first[:2], worst_first[-1]]
        assert f"3 of {len(tiny_truth)} views of <b>lattice</b>" in text
        write_report(result, evaluation, page, views_shown=0)
        assert "<article" not in page.read_text(encoding="utf-8")
        with pytest.raises(InputError, match="views to show: -1"):
            write_report(result, evaluation, page, views_shown=-1)


def test_views_are_decoded_once_for_diagnosis_and_report(
    tiny_root: Path,
    tiny_truth: dict[str, np.ndarray],
    archive_of: Callable[..., Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    archive = archive_of({view: 1.1 * depth_m for view, depth_m in tiny_truth.items()})
    decoded: Counter[bytes] = Counter()
    decode = codecs.decode

    def count(kind: str, content: bytes, grid: tuple[int, int]) -> np.ndarray:
        decoded[content] += kind == "depth"
        return decode(kind, content, grid)

    with open_evaluation(archive, tiny_root) as evaluation:
        result = score_evaluation(evaluation)
        monkeypatch.setattr(codecs, "decode", count)
        write_report(result, evaluation, tmp_path / "page.html", views_shown=1)
    diagnosed = min(len(tiny_truth), MAX_VIEWS)
    assert set(decoded.values()) <= {0, 1}
    assert 2 * diagnosed <= sum(decoded.values()) <= 2 * diagnosed + 1, "both eyes, and the view that is shown"
