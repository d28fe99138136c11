"""Rollout workers that die, hang, raise, repeat themselves or belong to somebody else."""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import oodil.pipeline.collecting
from oodil.pipeline.collecting import InlineRollouts, collect
from oodil.pipeline.data import Unit, UnitResult
from oodil.pipeline.errors import UnusableEnvironmentError
from oodil.pipeline.stage import JobStoppedError
from oodil.pipeline.versions import collecting_versions
from oodil.workers import rollout_worker, zmq_rollouts
from oodil.workers.channels import Dealer, private_endpoint
from oodil.workers.dispatcher import UNITS_PER_WORKER, CollectError
from oodil.workers.messages import (
    Header,
    Message,
    Ready,
    Refused,
    ResultMessage,
    UnitFailure,
    UnitMessage,
    decode,
    encode,
)
from oodil.workers.reports import Event, Failed, Started
from oodil.workers.supervisor import Supervisor
from oodil.workers.zmq_rollouts import ZmqRollouts
from tests.fakes import chain, children, hopper_units, wait_until

pytestmark = pytest.mark.timeout(120)

RUN = "the run"
SameBits = Callable[[object, object], None]


class Threads:
    """Rollout workers in threads of this process; they are like the real ones but for being cheap to start."""

    def __init__(self, endpoint: str, count: int) -> None:
        self._stop = threading.Event()
        self._threads = [threading.Thread(target=self._run, args=(endpoint, f"thread.{i}")) for i in range(count)]
        for thread in self._threads:
            thread.start()

    def _run(self, endpoint: str, identity: str) -> None:
        rollout_worker.main(_Link(identity, self._stop.is_set), endpoint, RUN)  # type: ignore[arg-type]

    def close(self) -> None:
        """End them."""
        self._stop.set()
        for thread in self._threads:
            thread.join()


class _Link:
    def __init__(self, identity: str, should_stop: Callable[[], bool]) -> None:
        self.identity = identity
        self.should_stop = should_stop


class Puppet:
    """A rollout worker that does what the test says."""

    def __init__(self, endpoint: str, name: str) -> None:
        self.name = name
        self._dealer = Dealer(endpoint, name)

    def header(self, **changes: str) -> Header:
        """Return the header of an honest answer, but for some changes."""
        return replace(Header(RUN, "learner.1", self.name, 0), **changes)  # type: ignore[arg-type]

    def ready(self, versions: str = "") -> None:
        """Say that there is nothing to do."""
        self._dealer.send(encode(Ready(self.header(incarnation=""), versions or collecting_versions())))

    def next_message(self) -> Message:
        """Return what the learner sends next."""
        frames = self._dealer.receive(30.0)
        assert frames is not None
        return decode(frames)

    def next_unit(self) -> Unit:
        """Return the next unit that the learner sends."""
        message = self.next_message()
        assert isinstance(message, UnitMessage)
        return message.unit

    def send(self, result: UnitResult, **changes: str) -> None:
        """Send a result."""
        self._dealer.send(encode(ResultMessage(self.header(**changes), result)))

    def fail(self, unit: Unit) -> None:
        """Say that a unit raised."""
        self._dealer.send(
            encode(UnitFailure(self.header(), unit.iteration, unit.group, "Traceback: the simulator broke"))
        )

    def send_raw(self, frames: list[bytes]) -> None:
        """Send anything."""
        self._dealer.send(frames)

    def close(self) -> None:
        """Leave."""
        self._dealer.close()


@pytest.fixture
def endpoint(tmp_path: Path) -> Iterator[str]:
    """Give an endpoint that is removed afterwards."""
    with private_endpoint(tmp_path) as name:
        yield name


@pytest.fixture
def source(endpoint: str) -> Iterator[ZmqRollouts]:
    """Give a source whose deadline no test waits for."""
    rollouts = ZmqRollouts(endpoint, RUN, "learner.1", unit_timeout_s=1000.0)
    yield rollouts
    rollouts.close()


@pytest.fixture(autouse=True)
def one_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let threads of this process take turns: the simulators of a process are not made for more than one."""
    lock = threading.Lock()

    def collect_alone(unit: Unit) -> UnitResult:
        with lock:
            return collect(unit)

    monkeypatch.setattr(rollout_worker, "collect", collect_alone)
    monkeypatch.setattr(oodil.pipeline.collecting, "collect", collect_alone)


def inline(units: list[Unit]) -> list[UnitResult]:
    """Return what the units give, collected here."""
    rollouts = InlineRollouts()
    rollouts.submit(units)
    return rollouts.gather()


@pytest.mark.parametrize("count", [1, 3])
def test_workers_give_the_same_bits_as_no_workers(
    source: ZmqRollouts, endpoint: str, count: int, assert_same_bits: SameBits
) -> None:
    workers = Threads(endpoint, count)
    try:
        assert_same_bits(chain(source, 4), chain(InlineRollouts(), 4))
        assert source.dropped == {}
    finally:
        workers.close()


def test_workers_begin_episodes_where_they_are_to(
    source: ZmqRollouts, endpoint: str, assert_same_bits: SameBits
) -> None:
    starts = np.array([[0, 1.25, *[0] * 9, 0.125], [1, 1.25, *[0] * 10]], np.float32)
    units = [replace(unit, starts=starts) for unit in hopper_units(0, num_steps=60)]
    workers = Threads(endpoint, 2)
    try:
        source.submit(units)
        assert_same_bits(source.gather(), inline(units))
    finally:
        workers.close()


def test_a_group_goes_on_while_others_are_not_there(
    source: ZmqRollouts, endpoint: str, assert_same_bits: SameBits
) -> None:
    first, second = hopper_units(0, count=2), hopper_units(1, count=2)
    puppet = Puppet(endpoint, "puppet.1")
    results: list[UnitResult] = []
    source.submit(first)
    gathering = threading.Thread(target=lambda: results.extend(source.gather(lambda got: [second[got.group]])))
    gathering.start()
    try:
        puppet.ready()
        assert [puppet.next_unit().group, puppet.next_unit().group] == [0, 1]
        puppet.send(inline(first)[1])
        ahead = puppet.next_unit()
        assert (ahead.iteration, ahead.group) == (1, 1)
        puppet.send(inline(second)[1])
        wait_until(lambda: list(source._dispatcher._units) == [(0, 0)])
        assert gathering.is_alive()
        puppet.send(inline(first)[0])
        gathering.join(30.0)
        assert_same_bits(results, inline(first))
        assert (puppet.next_unit().group, source.dropped) == (0, {})
        puppet.send(inline(second)[0])
        assert_same_bits(source.gather(), inline(second))
    finally:
        puppet.close()
        source.close()


def test_a_unit_that_is_submitted_twice_is_refused(source: ZmqRollouts) -> None:
    source.submit(hopper_units(0))
    with pytest.raises(ValueError, match=r"\(0, 1\) was submitted twice"):
        source.submit(hopper_units(0)[1:])


def test_only_the_first_honest_result_counts(source: ZmqRollouts, endpoint: str, assert_same_bits: SameBits) -> None:
    units = hopper_units(5, count=2)
    honest = inline(units)
    forged = inline([replace(unit, policy=hopper_units(0)[0].policy) for unit in units])
    puppet, stranger = Puppet(endpoint, "puppet.1"), Puppet(endpoint, "stranger.1")
    try:
        source.submit(units)
        puppet.ready()
        assert [puppet.next_unit().group, puppet.next_unit().group] == [0, 1]
        puppet.send(forged[0], run_id="another run")
        puppet.send(forged[0], incarnation="learner.0")
        puppet.send(forged[0], sender="somebody.1")
        puppet.send(replace(forged[0], iteration=4))
        puppet.send(replace(forged[0], group=7))
        puppet.send(replace(forged[0], rollout=replace(forged[0].rollout, policy_version=4)))
        puppet.send(inline(hopper_units(5, count=1, num_steps=7))[0])
        puppet.send_raw([b"no message", b""])
        puppet.send_raw([b""])
        puppet.send(honest[0])
        puppet.send(forged[0])
        # What one sender sends stays in order; the stranger's result might overtake.
        wait_until(lambda: source.dropped.get("duplicate") == 3)
        stranger.send(forged[0])
        wait_until(lambda: source.dropped.get("duplicate") == 4)
        puppet.send(honest[1])
        assert_same_bits(source.gather(), honest)
        expected = {"foreign": 1, "stale": 1, "bad": 3, "mismatch": 2, "duplicate": 4}
        assert source.dropped == expected
    finally:
        puppet.close()
        stranger.close()


def test_late_units_go_to_a_worker_with_nothing_to_do(
    source: ZmqRollouts, endpoint: str, assert_same_bits: SameBits
) -> None:
    units = hopper_units(0)
    hoarder = Puppet(endpoint, "hoarder.1")
    source.submit(units)
    hoarder.ready()
    held = [hoarder.next_unit() for _ in range(UNITS_PER_WORKER)]
    workers = Threads(endpoint, 1)
    try:
        assert_same_bits(source.gather(), inline(units))
        hoarder.send(oodil.pipeline.collecting.collect(held[0]))
        wait_until(lambda: source.dropped == {"duplicate": 1})
    finally:
        workers.close()
        hoarder.close()


def test_a_unit_that_fails_once_is_given_to_another_worker(
    source: ZmqRollouts, endpoint: str, assert_same_bits: SameBits
) -> None:
    units = hopper_units(0, count=1)
    first, second = Puppet(endpoint, "first.1"), Puppet(endpoint, "second.1")
    try:
        first.ready()
        source.submit(units)
        unit = first.next_unit()
        second.ready()
        wait_until(lambda: len(source._dispatcher._workers) == 2)
        first.fail(unit)
        second.send(oodil.pipeline.collecting.collect(second.next_unit()))
        assert_same_bits(source.gather(), inline(units))
    finally:
        first.close()
        second.close()


def test_a_unit_that_always_fails_raises_with_the_workers_traceback(source: ZmqRollouts, endpoint: str) -> None:
    workers = Threads(endpoint, 2)
    try:
        # A policy that sees fewer dimensions than the environment has.
        units = hopper_units(0, count=2, env_id="oodil/Walker2d-v0")
        source.submit([replace(unit, dynamics=()) for unit in units])
        with pytest.raises(CollectError, match=r"(?s)failed 3 times.*Traceback.*Error"):
            source.gather()
    finally:
        workers.close()


def test_a_unit_whose_environment_cannot_be_is_not_tried_again(source: ZmqRollouts, endpoint: str) -> None:
    workers = Threads(endpoint, 2)
    try:
        source.submit(hopper_units(0, count=2, env_id="oodil/Unicorn-v0"))
        with pytest.raises(UnusableEnvironmentError, match="oodil/Unicorn-v0"):
            source.gather()
    finally:
        workers.close()


def test_a_stop_ends_the_wait_only_when_nobody_answers(
    endpoint: str, monkeypatch: pytest.MonkeyPatch, assert_same_bits: SameBits
) -> None:
    rollouts = ZmqRollouts(endpoint, RUN, "learner.1", 1000.0, should_stop=lambda: True)
    workers = Threads(endpoint, 1)
    try:
        rollouts.submit(hopper_units(0))
        assert_same_bits(rollouts.gather(), inline(hopper_units(0)))
        workers.close()
        monkeypatch.setattr(zmq_rollouts, "_STOP_PATIENCE_S", 0.3)
        rollouts.submit(hopper_units(1))
        with pytest.raises(JobStoppedError):
            rollouts.gather()
    finally:
        workers.close()
        rollouts.close()
        rollouts.close()


@pytest.mark.parametrize("is_killed", [True, False])
def test_a_worker_process_that_dies_or_hangs_is_replaced_and_changes_nothing(
    tmp_path: Path, endpoint: str, is_killed: bool, assert_same_bits: SameBits
) -> None:
    units = hopper_units(0)
    arguments = {"endpoint": endpoint, "run_id": RUN}
    silent: list[str] = []
    events: list[Event] = []
    rollouts = ZmqRollouts(endpoint, RUN, "learner.1", unit_timeout_s=5.0, report_silent=silent.append)
    results: list[UnitResult] = []
    gathering = threading.Thread(target=lambda: results.extend(rollouts.gather()), daemon=True)
    with Supervisor(tmp_path, "test") as supervisor:
        try:
            supervisor.start("worker", rollout_worker.main, arguments)
            supervisor.poll(0.0)
            wait_until(lambda: bool(rollouts._dispatcher._workers))
            (process,) = children()
            # Suspended first, so that it certainly holds units which it will never answer.
            os.kill(process.pid, signal.SIGSTOP)
            rollouts.submit(units)
            wait_until(lambda: bool(rollouts._dispatcher._last_given()))
            if is_killed:
                os.kill(process.pid, signal.SIGKILL)
            gathering.start()

            def is_gathered() -> bool:
                while silent:
                    supervisor.kill(silent.pop())
                for event in supervisor.poll(0.05):
                    events.append(event)
                    if isinstance(event.report, Failed):
                        supervisor.start("worker", rollout_worker.main, arguments)
                return not gathering.is_alive()

            wait_until(is_gathered, 60.0)
        finally:
            rollouts.close()
    assert_same_bits(results, inline(units))
    failed, again = events[0].report, events[1].report
    assert isinstance(failed, Failed) and failed.reason.startswith("killed by SIGKILL")
    assert again == Started(2)


def test_a_worker_with_other_libraries_is_refused_with_the_reason(endpoint: str, source: ZmqRollouts) -> None:
    source.submit(hopper_units(0))
    other = Puppet(endpoint, "other")
    other.ready(versions="mujoco 3.0.0")
    answer = other.next_message()
    assert isinstance(answer, Refused)
    assert "mujoco 3.0.0" in answer.reason and collecting_versions() in answer.reason
    assert source.dropped["versions"] == 1
    other.close()
