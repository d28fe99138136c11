"""Controls of the transferability itself, with real training in the demonstrator's own dynamics.

What an expert does there comes out as transferable. What a policy that does nothing leaves behind, a few steps and a
fall, does not, although standing still is the easiest thing to learn from a reward that pays for staying alive.
"""

from pathlib import Path

import numpy as np
import pytest

from pipeline.artifacts import RunDirectory, encode_arrays, write_artifact
from pipeline.data import Demonstrations
from pipeline.datasets import encode_demonstrations
from pipeline.environments import make_batch
from pipeline.evaluation import run_episodes
from pipeline.experts import load_expert
from pipeline.loading import parse_config
from pipeline.policy import GaussianPolicy
from pipeline.seeding import generator
from pipeline.stage import Run
from pipeline.stages.transferability import TransferabilityStage
from tests.runs import ROOT
from workers.engine import LocalEngine

pytestmark = pytest.mark.timeout(1200)

OWN = {"gravity": 9.8}
COUNT = 10


def shown_by(policy: GaussianPolicy, label: str) -> Demonstrations:
    simulators = make_batch("oodil/Hopper-v0", OWN, COUNT)
    return Demonstrations.of(run_episodes(simulators, policy, generator((0,)), stochastic=False), label)


def test_an_expert_of_the_own_dynamics_is_transferable_and_doing_nothing_is_not(tmp_path: Path) -> None:
    expert, _ = load_expert(ROOT / "configs" / "experts" / "hopper-gravity-9.8")
    idle = GaussianPolicy(
        weights=(np.zeros((12, 3), np.float32),),
        biases=(np.zeros(3, np.float32),),
        log_std=np.zeros(3, np.float32),
        input_mean=np.zeros(12, np.float32),
        input_scale=np.ones(12, np.float32),
    )
    parts = [shown_by(expert, "own dynamics"), shown_by(idle, "does nothing")]
    assert not parts[0].terminated.any() and parts[1].terminated.all()
    demonstrations = Demonstrations.joined(parts)
    file = tmp_path / "demonstrations.safetensors"
    file.write_bytes(encode_demonstrations(demonstrations, "oodil/Hopper-v0"))
    values = {
        "name": "controls",
        "environment": {"id": "oodil/Hopper-v0", "dynamics": OWN},
        "demonstrations": {"file": str(file)},
        "transferability": {"gail": {"total_steps": 1_000_000}},
        "imitation": {"gail": {"total_steps": 1}},
    }
    config = parse_config(values, "controls")
    run = Run(config, RunDirectory(tmp_path / "run"))
    run.directory.path.mkdir()
    run.directory.config.write_text(config.model_dump_json())
    write_artifact(run.directory.stage("demonstrations"), {}, {file.name: file.read_bytes()})
    labels = encode_arrays({"labels": demonstrations.sources})
    write_artifact(run.directory.stage("clustering"), {}, {"assignment.safetensors": labels})

    stage = TransferabilityStage()
    outcome = LocalEngine(2).run_jobs(stage, run, stage.jobs(run), lambda _: None, lambda: False)
    assert not outcome.failed, outcome.failed
    write_artifact(run.directory.stage(stage.name), {}, stage.combine(run))
    scores = run.artifact(stage.name).arrays("transferability.safetensors")["scores"]
    assert scores[:COUNT].min() > 0.1, scores
    assert scores[COUNT:].max() < 0.5 * scores[:COUNT].min(), scores
