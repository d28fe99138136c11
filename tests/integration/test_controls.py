"""Controls of the transferability itself.

With real training in a gravity that is not the demonstrators': what no physics can do comes out far below what an
expert did, and a robot that does nothing and falls weighs almost nothing. With a known imitator: of what follows a
failure nothing is reproduced.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from oodil.orchestrator import execute
from oodil.pipeline.algorithms.weights import sampling_mass
from oodil.pipeline.artifacts import RunDirectory, write_artifact
from oodil.pipeline.data import Demonstrations, Episode
from oodil.pipeline.datasets import encode_demonstrations
from oodil.pipeline.environments import make_batch
from oodil.pipeline.evaluation import distance_of, run_episodes
from oodil.pipeline.loading import parse_config
from oodil.pipeline.policy import GaussianPolicy
from oodil.pipeline.results import (
    Assignment,
    CollectedDemonstrations,
    Imitator,
    ScoreHistory,
    TrainedImitators,
    Transferability,
)
from oodil.pipeline.seeding import numpy_rng
from oodil.pipeline.stage import Run
from oodil.pipeline.stages.experts import load_expert
from oodil.pipeline.stages.imitation import ImitationStage
from oodil.pipeline.stages.imitators import ClusterJob, ImitatorsStage
from oodil.pipeline.stages.transferability import TransferabilityStage
from oodil.workers.local_engine import LocalEngine
from tests.runs import ROOT

pytestmark = pytest.mark.timeout(1200)

DEMONSTRATOR = {"gravity": 9.8}
IMITATOR = {"gravity": 12.0}
COUNT = 10
GENUINE, REVERSED, IDLE = np.split(np.arange(3 * COUNT), 3)
"""Which demonstrations are the expert's, which those read backwards, and which do nothing."""
CLUSTERS = np.repeat(np.array([0, 0, 1], np.int32), COUNT)
"""The expert's and the reversed ones share a cluster: nothing but the reading can tell them apart."""
BUDGET = 350_000


def demonstrations() -> Demonstrations:
    """Return the expert's, the same in reverse, and those of a robot that takes no action and falls."""
    expert, _ = load_expert(ROOT / "configs" / "experts" / "hopper-gravity-9.8")
    idle = replace(
        expert,
        weights=tuple(np.zeros_like(w) for w in expert.weights),
        biases=tuple(np.zeros_like(b) for b in expert.biases),
    )
    parts = []
    # As the demonstrations of a run, the expert's are of sampled actions and full length; the idle robot takes none.
    for policy, label, falls in ((expert, "expert", False), (idle, "does nothing", True)):
        simulators = make_batch("oodil/Hopper-v0", DEMONSTRATOR, 2 * COUNT)
        episodes = run_episodes(simulators, policy, numpy_rng((0,)), stochastic=not falls)
        wanted = [episode for episode in episodes if episode.terminated == falls][:COUNT]
        parts.append(Demonstrations.of(wanted, label))
        if not falls:
            parts.append(Demonstrations.of([Episode(episode.states[::-1].copy()) for episode in wanted], "reversed"))
    return Demonstrations.joined(parts)


def prepared(
    path: Path,
    shown: Demonstrations,
    clusters: NDArray[np.int32],
    environment: dict[str, Any],
    seed: int = 0,
    budget: int = 1,
    **settings: Any,
) -> Run:
    """Return a run whose demonstrations and clusters are known."""
    path.mkdir()
    file = path / "demonstrations.safetensors"
    file.write_bytes(encode_demonstrations(shown, environment["id"]))
    values = {
        "name": "controls",
        "seed": seed,
        "environment": environment,
        "demonstrations": {"file": str(file)},
        "transferability": {"gail": {"total_steps": budget}, **settings},
        "imitation": {"gail": {"total_steps": 1}},
    }
    run = Run(parse_config(values, "controls"), RunDirectory(path / "run"))
    run.directory.path.mkdir()
    run.directory.config.write_text(run.config.model_dump_json())
    collected = CollectedDemonstrations(shown, (), environment["id"])
    write_artifact(run.directory.stage("demonstrations"), {}, collected.files())
    assignment = Assignment(clusters, np.zeros((len(shown), 2), np.float32))
    write_artifact(run.directory.stage("clustering"), {}, assignment.files())
    return run


def weighted(path: Path, seed: int, budget: int = BUDGET) -> tuple[Demonstrations, Transferability]:
    """Train the imitators of both clusters and read them."""
    shown = demonstrations()
    run = prepared(path, shown, CLUSTERS, {"id": "oodil/Hopper-v0", "dynamics": IMITATOR}, seed, budget)
    weighting = TransferabilityStage()
    execute(run, [ImitatorsStage(), weighting], LocalEngine(2))
    return shown, weighting.load(run)


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> tuple[Demonstrations, Transferability]:
    """The demonstrations and what one run says of them."""
    return weighted(tmp_path_factory.mktemp("controls") / "seed-0", seed=0)


def test_what_is_read_backwards_is_told_from_what_was_done(found: tuple[Demonstrations, Transferability]) -> None:
    """Same cluster, same states, same imitator; only the order of the states is against all dynamics."""
    scores = found[1].scores
    assert scores[REVERSED].mean() <= scores[GENUINE].mean() / 2.5, scores
    assert scores[REVERSED].max() < scores[GENUINE].min() / 2, scores
    assert set(found[1].verdicts[GENUINE]) == {"kept"}
    assert "kept" not in found[1].verdicts[REVERSED]


def test_doing_nothing_weighs_next_to_nothing(found: tuple[Demonstrations, Transferability]) -> None:
    shown, transferability = found
    scores = transferability.scores
    assert len(shown) == 3 * COUNT
    assert shown.terminated[IDLE].all() and not shown.terminated[np.concatenate((GENUINE, REVERSED))].any()
    assert scores[GENUINE].min() > 0.05, scores
    assert scores[IDLE].max() < scores[GENUINE].min() / 2, scores
    assert sampling_mass(transferability.weights, shown)[IDLE].sum() < 0.05, scores


CURVE = GaussianPolicy(
    (np.zeros((5, 1), np.float32),),
    (np.full(1, 0.02, np.float32),),
    np.full(1, -10, np.float32),
    np.zeros(5, np.float32),
    np.ones(5, np.float32),
)
"""Drives on a wide curve to the left, wherever it is."""
NOTHING = {"of no use": np.zeros(1, np.float32)}
"""Instead of networks that nobody asks."""


def driven(path: Path, obstacle: float) -> Run:
    """Return a run on Driving whose demonstrations, all from one start and without an obstacle, its imitator drives."""
    free, start = {"obstacle_1": 0.05}, np.array([[-0.5, -0.8, 0, 0, np.pi / 2]], np.float32)
    cars = make_batch("oodil/Driving-v0", free, COUNT)
    episodes = run_episodes(cars, CURVE, numpy_rng((0,)), stochastic=False, starts=start)
    shown = Demonstrations.of([Episode(episode.states) for episode in episodes], "on a curve")
    environment = {"id": "oodil/Driving-v0", "dynamics": {"obstacle_1": obstacle}}
    reading = {"steps": 300, "repetitions": 1}
    run = prepared(path, shown, np.zeros(COUNT, np.int32), environment, reading=reading)
    reward = ClusterJob.of(run, "cluster-0").learner(run.config).reward_model
    distance, _ = distance_of(CURVE, reward, run.config.environment, COUNT, (0,), start)
    imitator = Imitator(CURVE, NOTHING, NOTHING, distance, env_steps=0)
    history = ScoreHistory(np.arange(COUNT), np.empty(0, np.int64), np.empty((0, COUNT)))
    job = write_artifact(run.directory.job("imitators", "cluster-0"), {}, imitator.files() | history.files())
    trained = TrainedImitators(env_steps=0, sha256={"cluster-0": job.sha256})
    write_artifact(run.directory.stage("imitators"), {}, trained.files())
    execute(run, [TransferabilityStage()], LocalEngine(0))
    return run


def test_nothing_of_what_follows_a_crash_is_reproduced(tmp_path: Path) -> None:
    """An imitator does exactly what was demonstrated. Where there is an obstacle it does half of it, and crashes.

    Read up to there, it could not be told from the demonstrations.
    """
    free, blocked = (
        TransferabilityStage().load(driven(tmp_path / name, obstacle)).scores
        for name, obstacle in (("free", 0.05), ("blocked", 0.4))
    )
    assert free.min() > 0.9, free
    assert blocked.max() < 0.1, blocked


def test_no_policy_goes_on_from_an_imitator_that_is_lost_where_the_environment_begins(tmp_path: Path) -> None:
    """From its one start it does exactly what was demonstrated; from the others it leaves the world."""
    run = driven(tmp_path / "run", obstacle=0.05)
    learner = ClusterJob.of(run, "cluster-0").learner(run.config)
    untrained = learner.behavior_policy().arrays()
    goes_on, steps = ImitationStage().begin(run, "training-1", learner)
    assert not goes_on and steps > 0
    assert all(np.array_equal(value, untrained[name]) for name, value in learner.behavior_policy().arrays().items())
