"""Two controls of the transferability itself, with real training in a gravity that is not the demonstrators': what no
physics can do comes out far below what an expert did, and a robot that does nothing and falls weighs almost nothing."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from oodil.orchestrator import execute
from oodil.pipeline.algorithms.weights import sampling_mass
from oodil.pipeline.artifacts import RunDirectory, write_artifact
from oodil.pipeline.data import Demonstrations, Episode
from oodil.pipeline.datasets import encode_demonstrations
from oodil.pipeline.environments import make_batch
from oodil.pipeline.evaluation import run_episodes
from oodil.pipeline.loading import parse_config
from oodil.pipeline.results import Assignment, CollectedDemonstrations, Transferability
from oodil.pipeline.seeding import numpy_rng
from oodil.pipeline.stage import Run
from oodil.pipeline.stages.experts import load_expert
from oodil.pipeline.stages.imitators import ImitatorsStage
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


def weighted(path: Path, seed: int, budget: int = BUDGET) -> tuple[Demonstrations, Transferability]:
    """Train the imitators of both clusters and read them."""
    shown = demonstrations()
    path.mkdir()
    file = path / "demonstrations.safetensors"
    file.write_bytes(encode_demonstrations(shown, "oodil/Hopper-v0"))
    values = {
        "name": "controls",
        "seed": seed,
        "environment": {"id": "oodil/Hopper-v0", "dynamics": IMITATOR},
        "demonstrations": {"file": str(file)},
        "transferability": {"gail": {"total_steps": budget}},
        "imitation": {"gail": {"total_steps": 1}},
    }
    config = parse_config(values, "controls")
    run = Run(config, RunDirectory(path / "run"))
    run.directory.path.mkdir()
    run.directory.config.write_text(config.model_dump_json())
    write_artifact(
        run.directory.stage("demonstrations"), {}, CollectedDemonstrations(shown, (), "oodil/Hopper-v0").files()
    )
    assignment = Assignment(CLUSTERS, np.zeros((3 * COUNT, 2), np.float32))
    write_artifact(run.directory.stage("clustering"), {}, assignment.files())
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
