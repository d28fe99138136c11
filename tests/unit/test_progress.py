"""How far a run is and how long it still takes, computed by hand; and what it is expected to cost."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from oodil import estimate
from oodil.estimate import Pace, RunCost, StageCost, run_cost
from oodil.orchestrator import choose
from oodil.pipeline.artifacts import RunDirectory
from oodil.pipeline.loading import load_config
from oodil.pipeline.stage import LEARNING_S, Run
from oodil.terminal.progress import JobProgress, RunProgress
from oodil.terminal.words import duration, eta, figure
from tests.runs import MICRO


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_a_job_that_goes_on_is_timed_from_its_first_report() -> None:
    clock = Clock()
    job = JobProgress(clock)
    assert (job.share, job.rate, job.left_s) == (0.0, None, None)
    job.advance(600, 1000, {})
    clock.now += 0.5
    job.advance(620, 1000, {})
    assert job.rate is None, "half a second says nothing"
    clock.now += 1.5
    job.advance(700, 1000, {"return": 1.0})
    assert job.rate == 50  # 100 in 2 s
    assert job.left_s == 6  # 300 at 50 a second
    assert (job.share, job.first_share) == (0.7, 0.6)


def test_a_run_of_two_stages_by_hand() -> None:
    clock = Clock()
    run = RunProgress({"a": StageCost(0, 30.0, 2), "b": StageCost(0, 70.0, 1)}, clock)
    assert run.share == 0 and run.left_s is None
    run.stage_started("a", 2)
    assert run.left_s == 100  # as expected, because nothing was seen
    run.job_started("one")
    run.job_advanced("one", 0, 10, {})
    clock.now += 10
    run.job_advanced("one", 10, 10, {})
    assert run.share == 0.15  # half of 30 of 100
    # 15 s of expected work took 10; the expectation counts for a tenth of the whole: pace (10 + 10) / (15 + 10) = 0.8
    assert run.left_s == pytest.approx(85 * 0.8)
    run.job_ended("one", is_done=True)
    assert (run.share, run.num_finished, list(run.jobs)) == (0.15, 1, [])
    run.stage_finished()
    assert run.share == 0.3
    run.stage_started("b", 1)
    run.job_advanced("only", 1, 2, {})
    # Half of b was there when its first report came: 65 of 100 are done, 30 of them since the start, in 10 s.
    assert run.share == 0.65
    assert run.left_s == pytest.approx(35 * (10 + 10) / (30 + 10))
    run.job_ended("only", is_done=False)
    assert run.share == 0.3, "a job that is tried again begins anew until it reports"
    run.job_ended("only", is_done=True)
    run.stage_finished()
    assert (run.share, run.left_s, run.stage) == (1.0, 0.0, 2)


def test_jobs_that_differ_count_for_what_they_cost() -> None:
    clock = Clock()
    run = RunProgress({"table": StageCost(0, 100.0, 2, {"long": 0.8, "short": 0.2})}, clock)
    run.stage_started("table", 2)
    run.job_advanced("long", 0, 10, {})
    run.job_advanced("short", 5, 10, {})  # half of it was there
    clock.now += 20
    run.job_ended("short", is_done=True)
    run.job_advanced("long", 5, 10, {})
    assert run.share == pytest.approx(0.6)
    # 50 of the 60 were done since the start, in 20 s: pace (20 + 10) / (50 + 10).
    assert run.left_s == pytest.approx(40 * 0.5)
    assert run.num_finished == 1


def test_reused_stages_and_jobs_that_are_not_there_cost_nothing() -> None:
    run = RunProgress({"a": StageCost(0, 30.0, 1), "b": StageCost(0, 50.0, 5)}, Clock())
    run.stage_reused("a")
    run.stage_started("b", 2)  # two of five clusters: 20 of 50
    run.job_advanced("one", 1, 2, {})
    assert run.share == 0.25
    run.stage_finished()
    assert run.share == 1.0


def test_a_stage_that_nobody_expected_does_no_harm() -> None:
    run = RunProgress({}, Clock())
    run.stage_started("surprise", 3)
    run.job_advanced("one", 1, 2, {})
    assert (run.share, run.left_s) == (0.0, None)
    run.stage_finished()


def test_words() -> None:
    assert [eta(each) for each in (None, 5, 65.4, 3_725, 400_000)] == ["--:--", "0:05", "1:05", "1:02:05", "4 days"]
    assert [duration(each) for each in (4.25, 65, 3_725)] == ["4.2 s", "1 min 05 s", "1 h 02 min"]
    assert [figure(each) for each in (1234.5, 16.333, 0.000123, 1e9)] == ["1,234", "16.33", "0.000123", "1e+09"]


def test_what_a_run_costs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimate, "pace_of", lambda _: Pace(step_s=1e-3, max_episode_steps=1000, slowness=2.0))
    monkeypatch.setattr(estimate, "usable_cores", lambda: 4)
    config = load_config(MICRO, ["clustering.num_clusters=5", "imitation.num_trainings=1"])
    run = Run(config, RunDirectory(tmp_path))
    found: dict[str, Any] = run_cost(run, choose(config), workers=2).stages
    gail = config.transferability.gail
    steps = gail.env_steps
    # Each is measured by 16 episodes.
    assert found["imitators"].env_steps == 5 * (steps + 16_000)
    # Five jobs on two workers: three rounds.
    seconds = (steps + 16_000) * 1e-3 + steps * 2 * LEARNING_S
    assert found["imitators"].seconds == pytest.approx(estimate.START_S + 3 * seconds)
    gail = config.imitation.gail
    steps = gail.env_steps
    # 16 episodes of the imitator that it may go on from; two candidates by 8 each, the policy by 16.
    assert found["imitation"].env_steps == steps + 48_000
    # One learner, whose workers share the work. Its curve is of two points by 2 episodes each, its end of 2 more.
    seconds = (steps + 54_000) * 1e-3 + steps * 2 * LEARNING_S
    assert found["imitation"].seconds == pytest.approx(estimate.START_S + seconds / 2)
    # 3 and 4 demonstrations of 1000 steps, sixteen at a time.
    assert found["demonstrations"].seconds == pytest.approx(estimate.START_S + 16.0)
    assert found["demonstrations"].env_steps == 0


def test_what_a_cost_says() -> None:
    cost = RunCost({"a": StageCost(4_812_345, 300.0, 1), "b": StageCost(0, 70.0, 1)}, 2)
    assert str(cost) == "to do: 4.8 million environment steps, about 6 min"
    assert str(replace(cost, workers=None)) == "to do: 4.8 million environment steps"
    long = replace(cost, stages={"a": StageCost(122_880, 40_000.0, 1)})
    assert str(long) == "to do: 120,000 environment steps, about 11.1 h"
