"""The dispatcher with a clock of its own: who is given what, and when."""

from dataclasses import replace

import pytest

from oodil.pipeline.collecting import collect
from oodil.pipeline.data import Unit, UnitResult
from oodil.workers.dispatcher import CollectError, Dispatcher
from tests.fakes import hopper_units


def inline(units: list[Unit]) -> list[UnitResult]:
    """Collect units here."""
    return [collect(unit) for unit in units]


def names(given: list[tuple[str, Unit]]) -> list[tuple[str, int]]:
    """Return who got which group."""
    return [(worker, unit.group) for worker, unit in given]


def dispatcher(count: int, *workers: str) -> Dispatcher:
    """Return a dispatcher with the units of one iteration and some workers."""
    made = Dispatcher(unit_timeout_s=30.0)
    made.submit(hopper_units(0, count))
    for worker in workers:
        made.ready(worker)
    return made


def test_work_is_spread_evenly_and_at_most_two_units_wait_at_a_worker() -> None:
    units = dispatcher(6, "a", "b")
    assert names(units.assign(0.0)) == [("a", 0), ("b", 1), ("a", 2), ("b", 3)]
    assert units.assign(0.5) == []
    units.result("b", inline(hopper_units(0)[1:2])[0], 0.6)
    assert names(units.assign(0.6)) == [("b", 4)]


def test_a_unit_is_late_when_it_takes_far_longer_than_the_slowest_recent_one() -> None:
    units = dispatcher(2, "a", "b")
    assert names(units.assign(0.0)) == [("a", 0), ("b", 1)]
    units.result("b", inline(hopper_units(0)[1:2])[0], 2.0)
    assert units.assign(9.9) == []
    assert names(units.assign(10.1)) == [("b", 0)]
    assert units.assign(10.2) == []


def test_a_silent_worker_is_named_once_and_its_units_go_to_others() -> None:
    units = dispatcher(3, "a")
    assert names(units.assign(0.0)) == [("a", 0), ("a", 1)]
    units.result("a", inline(hopper_units(0)[:1])[0], 20.0)
    assert names(units.assign(20.0)) == [("a", 2)]
    assert units.silent(49.0) == []
    assert units.silent(51.0) == ["a"]
    assert units.silent(90.0) == []
    units.ready("b")
    assert sorted(names(units.assign(90.0))) == [("b", 1), ("b", 2)]


def test_a_failed_unit_returns_to_the_same_worker_only_if_there_is_no_other() -> None:
    units = dispatcher(1, "a")
    units.assign(0.0)
    units.failed("a", (0, 0), "first", 0.1)
    assert names(units.assign(0.1)) == [("a", 0)]
    units.failed("a", (0, 0), "second", 0.2)
    units.ready("b")
    assert names(units.assign(0.2)) == [("b", 0)]
    with pytest.raises(CollectError, match=r"(?s)failed 3 times, last in b.*third"):
        units.failed("b", (0, 0), "third", 0.3)


def test_a_result_that_does_not_fit_is_a_failure_and_the_unit_goes_to_another() -> None:
    units = dispatcher(1, "a", "b")
    (given,) = units.assign(0.0)
    assert given[0] == "a"
    other = replace(hopper_units(0)[0], num_steps=3)
    units.result("a", collect(other), 0.1)
    assert units.dropped["mismatch"] == 1
    assert names(units.assign(0.1)) == [("b", 0)]
    units.result("a", collect(other), 0.2)  # It was not asked again, so this is nobody's failure.
    assert units.assign(0.2) == []
    units.result("b", inline(hopper_units(0)[:1])[0], 0.3)
    assert units.dropped["mismatch"] == 2 and units.dropped["duplicate"] == 0
