"""How often something is tried: the ledger of attempts, without any process."""

import pytest

from oodil.pipeline.config import RuntimeConfig
from oodil.pipeline.errors import DataError, UnfinishedError
from oodil.workers.engine import Attempts, JobLedger, Outcome
from oodil.workers.reports import DONE, STOPPED, AttemptFailed, Event, Finished, Progress, Started, failure


def test_pauses_double_up_to_a_limit() -> None:
    attempts = Attempts(9, 0.5)
    assert [attempts.failed("") for _ in range(9)] == [0.5, 1.0, 2.0, 4.0, 8.0, 10.0, 10.0, 10.0, None]


def test_pauses_stay_finite() -> None:
    attempts = Attempts(10_000, 1.0)
    assert {attempts.failed("") for _ in range(5000)} == {1.0, 2.0, 4.0, 8.0, 10.0}


@pytest.mark.parametrize(
    ("reached", "tried_again"),
    [
        ([5, 5, 5], [True, True, False]),
        ([0, 0, 0], [True, True, False]),
        ([1, 2, 3, 4, 5, 6], [True] * 6),
        # Less far, as far, further, and then two that get no further than that.
        ([5, 3, 6, 6, 2], [True, True, True, True, False]),
    ],
)
def test_only_attempts_that_get_no_further_are_used_up(reached: list[int], tried_again: list[bool]) -> None:
    attempts = Attempts(3, 0.0)
    found = []
    for done in reached:
        attempts.begin()
        attempts.reached(10 - done)
        found.append(attempts.failed("") is not None)
    assert found == tried_again


def test_the_pause_is_short_again_after_progress() -> None:
    attempts = Attempts(3, 1.0)
    assert [attempts.failed("first"), attempts.failed("second")] == [1.0, 2.0]
    attempts.reached(9)
    assert attempts.failed("third") == 1.0
    assert attempts.first_reason == "first"


def test_the_ledger_tells_everything_and_keeps_the_first_reason() -> None:
    events: list[Event] = []
    ledger = JobLedger(["b", "a", "c"], RuntimeConfig(max_attempts=2, restart_delay_s=0.5), events.append)
    ledger.begin("a")
    ledger.finished("a", DONE)
    ledger.begin("b")
    ledger.report("b", Progress(1, 2, {}))
    assert ledger.failed("b", "first") == 0.5
    ledger.begin("b")
    assert ledger.failed("b", "second") is None
    assert events == [
        Event("a", Started(1)),
        Event("a", Finished(DONE)),
        Event("b", Started(1)),
        Event("b", Progress(1, 2, {})),
        Event("b", AttemptFailed(1, "first", True)),
        Event("b", Started(2)),
        Event("b", AttemptFailed(2, "second", False)),
    ]
    assert ledger.outcome() == Outcome(done=["a"], failed={"b": "first"}, not_run=["c"])


def test_after_a_stop_nothing_is_tried_again_and_nothing_has_failed() -> None:
    ledger = JobLedger(["a", "b"], RuntimeConfig(), lambda event: None)
    ledger.begin("a")
    ledger.begin("b")
    ledger.finished("b", STOPPED)
    assert ledger.failed("a", "killed") is None
    assert ledger.outcome() == Outcome(not_run=["a", "b"], stopped=True)


def test_an_attempt_that_has_less_left_got_further_though_it_counts_anew() -> None:
    """What earlier attempts have finished is no part of what a run of a table reports."""
    ledger = JobLedger(["run"], RuntimeConfig(max_attempts=2), lambda event: None)
    for done, total in ((900, 1000), (10, 50), (5, 20)):
        ledger.begin("run")
        ledger.report("run", Progress(done, total, {}))
        assert ledger.failed("run", "killed") is not None
    ledger.begin("run")
    ledger.report("run", Progress(0, 20, {}))
    assert ledger.failed("run", "killed") is None


def test_what_cannot_be_used_is_not_tried_again() -> None:
    ledger = JobLedger(["a", "b"], RuntimeConfig(), lambda event: None)
    for job, error in (("a", DataError("a.npz: holds no states")), ("b", ArithmeticError("told to"))):
        ledger.begin(job)
        failed = failure(error)
        assert (ledger.failed(job, failed.reason, failed.is_final) is None) == (job == "a")
    assert ledger.outcome().failed == {"a": "a.npz: holds no states"} and ledger.outcome().is_final
    assert failure(UnfinishedError("both", "table", {}, is_final=True)).is_final
    assert not failure(UnfinishedError("both", "table", {})).is_final
