"""What a run prints about its scores."""

import json
from pathlib import Path

import numpy as np
import pytest

from oodil.pipeline.results import ScoreHistory, Transferability
from oodil.pipeline.runs import RunResults
from oodil.pipeline.stage import Run
from oodil.terminal import print_status, print_summary
from tests.synthetic import SMALL, Writer, full_run, new_run


def score(run: Run, scores: float) -> None:
    """Give all demonstrations of a run the same score."""
    writer, count = Writer(run, 2), sum(SMALL["counts"])
    values, members = np.full(count, scores), np.arange(count)
    history = {0: ScoreHistory(members, np.array([0, 1]), np.zeros((2, count)))}
    band = np.stack((values - 0.01, values + 0.01), axis=1)
    found = Transferability(values, values / values.sum(), writer.labels, band, 0.5 * scores, history=history)
    writer.write("transferability", found.files())


def printed(results: RunResults, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> str:
    """Return what the status says on 80 columns; a table that is wider would be cut."""
    monkeypatch.setenv("COLUMNS", "80")
    print_status(results)
    text = capsys.readouterr().out
    assert all(len(line) <= 80 for line in text.splitlines() if str(results.path) not in line)
    return text


def test_verdicts_are_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    marks = {"heavy [and] very much longer than a column": True, "light": False}
    results = RunResults(full_run(tmp_path, marks, (300, 400), 2))
    text = printed(results, capsys, monkeypatch)
    words = " ".join(text.split())
    assert "1: cannot be told from the imitator's own fresh episodes; 0: nothing of it is reproduced." in words
    assert "the whole interval reaches 0.200" in words
    assert "K suggested by the embedding" in words
    assert "Nothing is reproduced well" not in words
    found = results.verdicts()
    for row in (*found.by_source, *found.by_cluster):
        line = next(line for line in text.splitlines() if f"{row.score:.3f} [{row.low:.3f}, {row.high:.3f}]" in line)
        assert line.startswith(row.name[:15])
        assert line.split()[-3:] == [f"{row.share_before:.1%}", "->", f"{row.share:.1%}"]
    print_summary(results, tmp_path / "report.html")
    assert "score and interval" in capsys.readouterr().out


def test_a_run_that_reproduces_nothing_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = full_run(tmp_path, **SMALL)
    score(run, 0.015)
    text = " ".join(printed(RunResults(run), capsys, monkeypatch).split())
    assert "Nothing is reproduced well: the demonstrations that are drawn" in text
    assert "a mean score of only 0.015, below 0.02." in text
    score(run, 0.15)
    assert "Nothing is reproduced well" not in printed(RunResults(run), capsys, monkeypatch)


def test_nothing_is_printed_of_scores_that_are_not_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = new_run(tmp_path, SMALL["marks"], SMALL["counts"])
    assert "score and interval" not in printed(RunResults(run), capsys, monkeypatch)


def test_the_status_as_json_holds_the_verdicts(tmp_path: Path) -> None:
    results = RunResults(full_run(tmp_path, **SMALL))
    described = json.loads(json.dumps(results.describe(), allow_nan=False))["results"]["verdicts"]
    assert list(described) == ["transferability"]  # the marks say nothing that is read
    assert [row["name"] for row in described["transferability"]["by_source"]] == ["heavy", "light"]
