"""The engine on a real Ray cluster of two nodes on this machine: the same bits as without, and one node may die."""

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import ray
from ray.cluster_utils import Cluster

from oodil.experiments import Table
from oodil.orchestrator import execute, open_run
from oodil.pipeline.artifacts import read_artifact
from oodil.pipeline.collecting import InlineRollouts
from oodil.pipeline.errors import ConfigError, UnusableEnvironmentError
from oodil.pipeline.experiment import load_experiment
from oodil.pipeline.loading import load_config
from oodil.pipeline.policy import GaussianPolicy
from oodil.pipeline.stages import stages
from oodil.workers.engine import Outcome
from oodil.workers.local_engine import LocalEngine
from oodil.workers.ray_engine import RayEngine, RayRollouts, connect
from oodil.workers.reports import DONE, Event, Finished, Progress, Started
from tests.fakes import FakeStage, chain, failures, fake_run, hopper_units, lines, wait_until
from tests.flaky import FOLDER_VARIABLE
from tests.runs import MICRO
from tests.tables import SHORT, write_experiment

pytestmark = [pytest.mark.ray, pytest.mark.timeout(300)]

STALLING = "tests.flaky:StallingPendulum-v0"
PENDULUM_POLICY = GaussianPolicy(
    weights=(np.ones((3, 1), np.float32),),
    biases=(np.zeros(1, np.float32),),
    log_std=np.zeros(1, np.float32),
    input_mean=np.zeros(3, np.float32),
    input_scale=np.ones(3, np.float32),
)


@pytest.fixture
def misdeeds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder that tells what simulators do wrong; asked for before the cluster, which inherits where it is."""
    folder = tmp_path / "misdeeds"
    folder.mkdir()
    monkeypatch.setenv(FOLDER_VARIABLE, str(folder))
    return folder


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Cluster]:
    """A cluster of two nodes with one core each."""
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    made.add_node(num_cpus=1)
    monkeypatch.setenv("RAY_ADDRESS", made.address)
    try:
        connect(trusted=False)
        yield made
    finally:
        ray.shutdown()
        made.shutdown()


def test_jobs_go_on_after_whatever_happens_to_them(tmp_path: Path, cluster: Cluster) -> None:
    """One raises in every attempt, one is killed once; neither ends the others, and the rest is as it is inline."""
    inline, on_ray = fake_run(tmp_path / "inline"), fake_run(tmp_path / "ray", max_attempts=3)
    LocalEngine(0).run_jobs(FakeStage(False), inline, ["a"], lambda event: None, lambda: False)
    events: list[Event] = []
    outcome = RayEngine().run_jobs(FakeStage(False), on_ray, ["a", "raises", "killed"], events.append, lambda: False)
    assert outcome.done == ["a", "killed"] and outcome.failed.keys() == {"raises"} and not outcome.stopped
    assert "ArithmeticError: told to, in attempt 1" in outcome.failed["raises"]
    assert lines(on_ray.directory.path / "raises.began_at") == ["0", "2", "2"]
    assert lines(on_ray.directory.path / "killed.began_at") == ["0", "3"]
    failed = failures(events)
    assert [f for f in failed if f[0] == "raises"] == [("raises", 1, True), ("raises", 2, True), ("raises", 3, False)]
    assert [f for f in failed if f[0] == "killed"] == [("killed", 1, True)]
    assert events.count(Event("killed", Started(2))) == events.count(Event("killed", Finished(DONE))) == 1
    expected = inline.job_artifact("jobs", "a").sha256
    assert {on_ray.job_artifact("jobs", job).sha256 for job in ("a", "killed")} == {expected}
    assert read_artifact(on_ray.directory.job("jobs", "raises")) is None


def test_attempts_that_get_further_do_not_use_any_up(tmp_path: Path, cluster: Cluster) -> None:
    run, events = fake_run(tmp_path, max_attempts=2), list[Event]()
    outcome = RayEngine().run_jobs(FakeStage(False), run, ["killed_often"], events.append, lambda: False)
    assert outcome == Outcome(done=["killed_often"])
    assert failures(events) == [("killed_often", attempt, True) for attempt in range(1, 7)]


def test_a_job_that_hangs_goes_on(tmp_path: Path, cluster: Cluster) -> None:
    inline, on_ray = fake_run(tmp_path / "inline"), fake_run(tmp_path / "ray", job_timeout_s=30)
    LocalEngine(0).run_jobs(FakeStage(False), inline, ["a"], lambda event: None, lambda: False)
    events: list[Event] = []
    outcome = RayEngine().run_jobs(FakeStage(False), on_ray, ["hangs"], events.append, lambda: False)
    assert outcome == Outcome(done=["hangs"])
    assert failures(events) == [("hangs", 1, True)]
    assert lines(on_ray.directory.path / "hangs.began_at") == ["0", "3"]
    assert on_ray.job_artifact("jobs", "hangs").sha256 == inline.job_artifact("jobs", "a").sha256


def test_a_learner_on_ray_stops_and_goes_on(tmp_path: Path, cluster: Cluster) -> None:
    stage, whole, stopped = FakeStage(True), fake_run(tmp_path / "whole"), fake_run(tmp_path / "stopped")
    LocalEngine(0).run_jobs(stage, whole, ["a"], lambda event: None, lambda: False)
    noted = stopped.directory.path / "waits.iterations"
    engine = RayEngine()
    outcome = engine.run_jobs(stage, stopped, ["waits", "b"], lambda event: None, lambda: len(lines(noted)) >= 2)
    assert outcome.stopped and "waits" in outcome.not_run and not outcome.failed
    (stopped.directory.path / "go").touch()
    assert engine.run_jobs(stage, stopped, ["waits"], lambda event: None, lambda: False) == Outcome(done=["waits"])
    assert stopped.job_artifact("learner", "waits").sha256 == whole.job_artifact("learner", "a").sha256


def test_units_give_the_same_bits_on_ray(cluster: Cluster, assert_same_bits) -> None:
    assert_same_bits(chain(RayRollouts(unit_timeout_s=60), 3), chain(InlineRollouts(), 3))


def test_a_unit_that_hangs_is_collected_again(misdeeds: Path, cluster: Cluster, assert_same_bits) -> None:
    units = [replace(unit, env_id=STALLING, dynamics=(), policy=PENDULUM_POLICY) for unit in hopper_units(0)]
    inline, on_ray = InlineRollouts(), RayRollouts(unit_timeout_s=20)
    inline.submit(units)
    expected = inline.gather()
    (misdeeds / "stalls").touch()
    on_ray.submit(units)
    assert_same_bits(on_ray.gather(), expected)
    assert not list(misdeeds.iterdir()), "nothing hung"


def test_a_unit_that_raises_says_why(cluster: Cluster) -> None:
    source = RayRollouts(unit_timeout_s=60)
    source.submit(hopper_units(0, count=1, env_id="oodil/Nowhere-v0"))
    with pytest.raises(UnusableEnvironmentError, match="oodil/Nowhere-v0"):
        source.gather()


def test_a_node_dies_in_the_middle_of_a_run(tmp_path: Path, cluster: Cluster) -> None:
    """The whole pipeline, with the second node killed while the cluster jobs run: the same artifacts as inline."""
    config = load_config(MICRO, [])
    runs = {name: open_run(tmp_path / name, config) for name in ("inline", "ray")}
    execute(runs["inline"], stages(config), LocalEngine(0))
    second = cluster.worker_nodes
    checkpoints = runs["ray"].directory.path / "checkpoints" / "imitators"

    def kill() -> None:
        wait_until(lambda: any(checkpoints.glob("*/*")), timeout_s=120)
        cluster.remove_node(next(iter(second)), allow_graceful=False)

    killer = threading.Thread(target=kill)
    killer.start()
    execute(runs["ray"], stages(config), RayEngine())
    killer.join()
    assert len([node for node in ray.nodes() if node["Alive"]]) == 1
    hashes = [[run.artifact(stage.name).sha256 for stage in stages(config)] for run in runs.values()]
    assert hashes[0] == hashes[1]


def test_a_node_dies_in_the_middle_of_a_table(tmp_path: Path, cluster: Cluster) -> None:
    """Whole runs are tasks, and what they share is computed once, wherever they are."""
    longer = [*SHORT, "imitation.gail.total_steps=32_000"]
    file = write_experiment(tmp_path, overrides=longer, methods=["naive_gail"], published={})
    experiment = load_experiment(file)
    # Not beside each other, or the second would take over what the first has finished.
    tables = {name: Table.of(experiment, tmp_path / name / experiment.name) for name in ("inline", "ray")}
    selected = {name: table.select(None, None) for name, table in tables.items()}
    second = cluster.worker_nodes

    def kill() -> None:
        wait_until(lambda: any(tables["ray"].folder.glob("*/checkpoints/naive_gail/*/*")), timeout_s=120)
        cluster.remove_node(next(iter(second)), allow_graceful=False)

    killer = threading.Thread(target=kill)
    tables["inline"].compute(selected["inline"], LocalEngine(0), lambda event: None, lambda: False)
    killer.start()
    outcome = tables["ray"].compute(selected["ray"], RayEngine(), lambda event: None, lambda: False)
    killer.join()
    assert len(outcome.done) == 4
    wait_until(lambda: len([node for node in ray.nodes() if node["Alive"]]) == 1, timeout_s=120)
    inline, on_ray = (table.write_results({}).read_bytes() for table in tables.values())
    assert inline == on_ray


def test_a_cluster_of_several_machines_must_ask_for_a_token(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    """A third node at another address makes it one of several machines."""
    ray.shutdown()
    cluster.add_node(num_cpus=1, node_ip_address="127.0.0.2")
    with pytest.raises(ConfigError, match="RAY_AUTH_MODE=token"):
        connect(trusted=False)
    assert not ray.is_initialized()
    connect(trusted=True)
    ray.shutdown()
    monkeypatch.setenv("RAY_ADDRESS", "ray.lab.example:6379")
    with pytest.raises(ConfigError, match="RAY_AUTH_MODE=token"):
        connect(trusted=False)


def test_a_folder_that_a_node_does_not_see_is_refused(tmp_path: Path, cluster: Cluster) -> None:
    run = fake_run(tmp_path / "gone")
    events: list[Event] = []
    for path in sorted(run.directory.path.rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()
    run.directory.path.rmdir()
    with pytest.raises(ConfigError, match=r"does not see .*gone"):
        RayEngine().run_jobs(FakeStage(False), run, ["a"], events.append, lambda: False)
    assert not [event for event in events if isinstance(event.report, Progress)]
