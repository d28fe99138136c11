"""Verdicts by source and by cluster."""

import json
from dataclasses import replace

import numpy as np
import pytest

from oodil.pipeline.data import Demonstrations, Episode
from oodil.pipeline.results import Transferability
from oodil.pipeline.runs import separation_metrics
from oodil.pipeline.verdicts import LITTLE, VerdictTable


def four() -> tuple[Transferability, Demonstrations]:
    """Return demonstrations of 6, 1, 1 and 2 transitions: one is kept, one is open, two are not kept."""
    episodes = [Episode(np.zeros((length, 2))) for length in (7, 2, 2, 3)]
    held = replace(
        Demonstrations.of(episodes, "a"), sources=np.array([0, 2, 2, 2], np.int32), source_labels=("a", "none", "")
    )
    found = Transferability(
        scores=np.array([0.4, 0.3, 0.1, 0.1]),
        weights=np.array([0.5, 0.5, 0.0, 0.0]),
        clusters=np.array([3, 3, 1, 1], np.int32),
        intervals=np.array([[0.3, 0.5], [0.1, 0.5], [0.0, 0.2], [0.1, 0.1]]),
        threshold=0.25,
    )
    return found, held


def test_verdicts_are_counted_and_averaged() -> None:
    table = VerdictTable.of(*four())
    first, second = table.by_source  # the source without demonstrations is left out
    assert (first.name, first.demonstrations, first.kept, first.open, first.not_kept) == ("a", 1, 1, 0, 0)
    assert (second.name, second.demonstrations, second.kept, second.open, second.not_kept) == ("unnamed", 3, 0, 1, 2)
    assert second.score == pytest.approx(0.5 / 3)
    assert (second.low, second.high) == pytest.approx((0.2 / 3, 0.8 / 3))
    assert (first.share_before, second.share_before) == pytest.approx((0.6, 0.4))  # 6 of 10 transitions
    assert (first.share, second.share) == pytest.approx((6 / 7, 1 / 7))  # 0.5 x 6 and 0.5 x 1
    assert [row.name for row in table.by_cluster] == ["3", "1"]  # the best first
    assert [row.score for row in table.by_cluster] == pytest.approx([0.35, 0.1])
    assert table.threshold == 0.25
    assert table.effective_number == pytest.approx(2)


def test_nothing_is_reproduced_well_if_what_is_drawn_is_not() -> None:
    found, held = four()
    assert VerdictTable.of(found, held).warning == ""
    poor = replace(found, scores=np.array([0.004, 0.024, 0.002, 0.002]))  # single high scores do not help
    table = VerdictTable.of(poor, held)
    assert table.by_cluster[0].score == pytest.approx(0.014)
    assert table.warning.startswith("Nothing is reproduced well") and f"0.014, below {LITTLE:g}" in table.warning
    mixed = replace(poor, weights=np.array([0.0, 1.0, 0.0, 0.0]))  # what else is in its cluster does not matter
    assert VerdictTable.of(mixed, held).warning == ""
    nothing = replace(poor, weights=np.zeros(4))
    assert VerdictTable.of(nothing, held).warning == "" and VerdictTable.of(nothing, held).drawn_score is None
    without = replace(poor, clusters=np.full(4, -1, np.int32))
    assert VerdictTable.of(without, held).warning == ""
    assert VerdictTable.of(without, held).by_cluster == ()


def test_what_has_no_score_ranks_last_among_marks() -> None:
    found, held = four()
    scores = np.array([0.4, 0.3, np.nan, 0.1])
    told = separation_metrics(np.array([True, False, False, True]), scores, found.weights, held)
    assert told["auroc"] == pytest.approx(3 / 4)  # 0.4 is above 0.3 and 0; 0.1 is above 0
    assert told["share_before"] == pytest.approx(8 / 10)
    assert told["share"] == pytest.approx(6 / 7)
    assert told["share_power_1"] == pytest.approx((0.4 * 6 + 0.1 * 2) / (0.4 * 6 + 0.3 + 0.1 * 2))


def test_a_table_is_json() -> None:
    described = VerdictTable.of(*four()).describe()
    again = json.loads(json.dumps(described, allow_nan=False))
    assert again["by_cluster"][0]["kept"] == 1
    assert again["nothing_reproduced_well"] is False
    assert again["drawn_score"] == pytest.approx(0.35)
    parts = {"by_source", "by_cluster", "threshold", "effective_number", "drawn_score", "nothing_reproduced_well"}
    assert set(again) == parts
