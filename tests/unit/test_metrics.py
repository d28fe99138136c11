"""Metrics files: what is in them, how long they get, and what a resumed or killed job makes of them."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import oodil
from oodil.pipeline import metrics
from oodil.pipeline.metrics import Logger, Metrics, read_metrics
from tests.runs import MICRO

LOGGER = """
import json, os, sys

class Run:
    def __init__(self, options):
        self.say("init", options)
    def say(self, what, values):
        with open(os.environ["LOGGED"], "a") as file:
            print(json.dumps([os.getpid(), what, values]), file=file)
    def log(self, figures, step):
        self.say("log", {"step": step} | figures)
    def finish(self):
        self.say("finish", {})

def init(**options):
    return Run(options)
"""
"""A module of wandb's interface that keeps what it is told. The real ones bring thirty packages each."""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "metrics" / "stage" / "job.jsonl"


def write(path: Path, steps: range, total: int = 10**9, **figures: float) -> None:
    with Metrics(path) as written:
        for step in steps:
            written.write(step, total, {"loss": float(step), **figures})


def test_a_line_has_step_total_rate_and_every_figure(path: Path) -> None:
    with Metrics(path) as written:
        written.write(10, 100, {"loss": 0.5})
        written.write(20, 100, {"loss": float("nan"), "return": 7.0, "step": -1.0})
    first, second = (json.loads(line) for line in path.read_text().splitlines())
    assert first == {"step": 10, "total": 100, "rate": None, "loss": 0.5}
    assert second.pop("rate") > 0
    assert second == {"step": 20, "total": 100, "loss": None, "return": 7.0}
    columns = read_metrics(path)
    assert list(columns) == ["step", "total", "rate", "loss", "return"]
    np.testing.assert_array_equal(columns["step"], [10, 20])
    np.testing.assert_array_equal(columns["loss"], [0.5, np.nan])
    np.testing.assert_array_equal(columns["return"], [np.nan, 7])


def test_a_job_that_reports_nothing_has_no_file(path: Path) -> None:
    Metrics(path).close()
    assert not path.exists()
    assert read_metrics(path) == {}


def test_a_full_file_keeps_every_second_line(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics, "MAX_LINES", 8)
    write(path, range(1, 9))
    assert read_metrics(path)["step"].tolist() == [2, 4, 6, 8]
    write(path, range(1, 12))
    assert read_metrics(path)["step"].tolist() == [2, 4, 6, 8, 10]
    write(path, range(1, 101), total=100)
    # Eight at 8, doubled four times: every sixteenth, with the last.
    assert read_metrics(path)["step"].tolist() == [16, 32, 48, 64, 80, 96, 100]


def test_a_resumed_job_goes_on_where_it_resumed(path: Path) -> None:
    write(path, range(1, 7))
    write(path, range(4, 9), late=1.0)
    columns = read_metrics(path)
    assert columns["step"].tolist() == list(range(1, 9))
    np.testing.assert_array_equal(columns["late"], [np.nan] * 3 + [1.0] * 5)


@pytest.mark.parametrize("broken", [b'{"step": 4, "lo', b'{"step": 4}', b"[1]\n", b'{"step": null}\n', b"\xff\n"])
def test_a_broken_last_line_is_left_out(path: Path, broken: bytes) -> None:
    write(path, range(1, 4))
    with open(path, "ab") as file:
        file.write(broken)
    assert read_metrics(path)["step"].tolist() == [1, 2, 3]
    write(path, range(4, 6))
    assert read_metrics(path)["step"].tolist() == [1, 2, 3, 4, 5]


def test_tensorboard_shows_the_same(path: Path, tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    for steps in (range(1, 6), range(4, 8)):
        with Metrics(path, tmp_path / "events") as written:
            for step in steps:
                written.write(step, 7, {"loss": step / 4})
    shown = EventAccumulator(str(tmp_path / "events")).Reload().Scalars("loss")
    assert [(event.step, event.value) for event in shown] == [(step, step / 4) for step in range(1, 8)]


def test_nothing_of_tensorboard_is_loaded_before_a_job_reports(path: Path) -> None:
    code = "import sys, oodil.pipeline.metrics, oodil.workers.job; print('tensorboard' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "False\n"


def test_without_tensorboard_the_file_is_there_all_the_same(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "tensorboard.summary.writer.event_file_writer", None)
    with Metrics(path, tmp_path / "events") as written:
        written.write(1, 2, {})
    assert read_metrics(path)["step"].tolist() == [1]
    assert not (tmp_path / "events").exists()


@pytest.fixture
def logged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Put loggers on the path, for child processes, too; return the file of what they are told."""
    folder = tmp_path / "loggers"
    folder.mkdir()
    for name in ("wandb", "trackio"):
        (folder / f"{name}.py").write_text(LOGGER)
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("PYTHONPATH", str(folder), prepend=os.pathsep)
    monkeypatch.setenv("LOGGED", str(tmp_path / "logged"))
    monkeypatch.delenv("WANDB_MODE", raising=False)
    yield tmp_path / "logged"
    for name in ("wandb", "trackio"):
        sys.modules.pop(name, None)


def told(path: Path) -> list[tuple[int, str, dict[str, Any]]]:
    return [tuple(json.loads(line)) for line in path.read_text().splitlines()]


@pytest.mark.parametrize("module", ["wandb", "trackio"])
def test_a_logger_is_told_the_same_and_stays_off_the_network(
    path: Path, tmp_path: Path, logged: Path, module: str
) -> None:
    with Metrics(path, logger=Logger(module, "oodil", "micro-seed0", "imitation/imitation", tmp_path)) as written:
        assert module not in sys.modules
        for step in (10, 20):
            written.write(step, 20, {"loss": step / 4})
    (_, begun, options), *lines, (_, ended, _) = told(logged)
    assert (begun, ended) == ("init", "finish")
    assert [options.pop(name) for name in ("project", "group", "name")] == [
        "oodil",
        "micro-seed0",
        "imitation/imitation",
    ]
    assert options["mode"] == "offline" if module == "wandb" else options == {"embed": False}
    assert [(line["step"], line["loss"]) for _, _, line in lines] == [(10, 2.5), (20, 5.0)]


@pytest.mark.slow
def test_a_job_logs_from_its_own_process_and_to_the_same_bits(
    tmp_path: Path, logged: Path, undisturbed: dict[str, str]
) -> None:
    run = oodil.run(MICRO, ["runtime.logger=trackio"], workers=1, until="clustering", run_dir=tmp_path / "run")
    stages = run.describe()["stages"]
    assert all(stages[name]["sha256"] == undisturbed[name] for name in ("demonstrations", "clustering"))
    begun = [(process, options["name"]) for process, what, options in told(logged) if what == "init"]
    assert "clustering/clustering" in {name for _, name in begun}
    assert os.getpid() not in {process for process, _ in begun}


def test_a_logger_that_is_not_there_is_refused_before_any_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics, "find_spec", lambda module: None)
    with pytest.raises(oodil.OodilError, match=r"runtime\.logger: wandb is not installed; pip install wandb"):
        oodil.run(MICRO, ["runtime.logger=wandb"], run_dir=tmp_path / "run")
    assert not (tmp_path / "run").exists()
